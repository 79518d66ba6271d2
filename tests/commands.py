"""Commands in processes of their own, that are interrupted or killed as a terminal and a user would."""

from __future__ import annotations

import json
import os
import random
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import warm_process

PATIENCE = 100.0  # [s]: the kernels may have to be compiled first, and others may be at work


class Ended(NamedTuple):
    """How a command ended."""

    code: int
    said: str  # on standard error
    seconds: float  # from the signal until the last of its processes was gone


class Commands:
    """Starts them, see `warm_process`; one at a time."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, warm_process.__file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            env={**os.environ, "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
            # A test run in the background hands down an ignored SIGINT.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )

    def close(self) -> None:
        """End the process that starts them."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()

    def ended_by(
        self,
        by: signal.Signals,
        words: list[str],
        folder: Path,
        when: Callable[[], bool],
        within: float = 0.0,
        seed: int = 0,
    ) -> Ended:
        """Start a command, and send a signal to its whole group a random moment after something is so.

        Args:
            by: the signal.
            words: of the command.
            folder: that it works in.
            when: what must be so first.
            within: [s] after that, at most.
            seed: of the moment.
        """
        said: list[str] = []
        pipe = folder / "stderr"
        os.mkfifo(pipe)
        reader = threading.Thread(target=lambda: said.append(pipe.read_text()), daemon=True)
        reader.start()  # until the last process has let go of it
        environment = {**os.environ, "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        request = {"words": words, "folder": str(folder), "environment": environment, "stderr": str(pipe)}
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(request).encode() + b"\n")
        number = self._number()
        done = False
        try:
            deadline = time.monotonic() + PATIENCE
            while not when():
                done = self._told_more()
                assert not done, f"{words}: was done before it could be stopped"
                assert time.monotonic() < deadline, f"{words}: nothing happened"
                time.sleep(0.005)
            time.sleep(random.Random(seed).uniform(0.0, within))
            begun = time.monotonic()
            os.killpg(number, by)
            reader.join(60.0)
            seconds = time.monotonic() - begun
            assert said, f"{words}: still at work a minute after {by.name}"
            code, done = self._number(), True
        finally:
            if not done:
                os.killpg(number, signal.SIGKILL)
                self._number()
            pipe.unlink()
        return Ended(code, said[0], seconds)

    def _told_more(self) -> bool:
        assert self._process.stdout is not None
        return bool(select.select([self._process.stdout], [], [], 0.0)[0])

    def _number(self) -> int:
        assert self._process.stdout is not None
        return int(self._process.stdout.readline())


def leftovers(folder: Path) -> list[Path]:
    """Files that were being written."""
    return list(folder.rglob("*.partial*"))
