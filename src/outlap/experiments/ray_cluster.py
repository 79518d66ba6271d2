"""Being in a Ray cluster: one that is there, or one of this machine, which begins and ends with the work."""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

from outlap.errors import OutlapError
from outlap.processes import process_environment

MARK = "OUTLAP_CLUSTER"  # a variable in the environment of all processes that a cluster is begun with
PATIENCE = 5.0  # [s] for killed processes to be gone


def import_ray() -> Any:
    """The package. Raises OutlapError where it is not installed."""
    try:
        import ray
    except ImportError:
        raise OutlapError("Ray is not installed; get it with pip install 'outlap[distributed]'") from None
    return ray


@contextmanager
def ray_cluster(address: str | None) -> Iterator[None]:
    """Be in a Ray cluster: the one that this process is in already, or else join one, or begin one of this machine.

    One that was begun here ends with all its processes (on Linux; elsewhere Ray itself sees to them), after Ctrl-C as
    well, which comes at any moment. Raises OutlapError where Ray is not installed, or none answers.
    """
    for stay in _LEFT_BEHIND:
        stay.join()  # what it ends is of the whole process
    _LEFT_BEHIND.clear()
    if import_ray().is_initialized():
        yield
        return
    stay = _Stay(address)
    try:
        stay.start()
        try:
            stay.begun.result()
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise OutlapError(f"--address {address}: no Ray cluster answers there: {error}") from None
        yield
    finally:
        stay.leave()


class _Stay(threading.Thread):
    """In a cluster, from `ray.init` to `ray.shutdown`.

    Ctrl-C interrupts the main thread alone, where Ray would hear of it only after seconds, or never in a fork. And the
    thread lives as long as the cluster does: Linux ends the processes of Ray with the thread that began them.
    """

    def __init__(self, address: str | None) -> None:
        super().__init__(daemon=True)
        self.begun: Future[None] = Future()
        self._address, self._name, self._over = address, uuid4().hex, threading.Event()

    def run(self) -> None:
        ray = import_ray()
        try:
            with process_environment(**{MARK: self._name}):
                ray.init(address=self._address, logging_level=logging.WARNING, log_to_driver=False)
            self.begun.set_result(None)
        except BaseException as error:
            self.begun.set_exception(error)
        self._over.wait()
        try:
            with suppress(AttributeError):  # not begun, or a version of Ray whose `shutdown` takes longer
                ray._private.worker._global_node.kill_monitor(check_alive=False)  # else it is waited for, over a second
            ray.shutdown()
        finally:
            self._kill_processes()

    def leave(self) -> None:
        """End what began; where it has not begun yet, its processes at once, and the rest when Ray hears of it."""
        self._over.set()
        if self.begun.done():
            self.join()
        else:
            _LEFT_BEHIND.append(self)
            self._kill_processes()

    def _kill_processes(self) -> None:
        """Those that were begun here and are left, such as workers that had just been started."""
        until = time.monotonic() + PATIENCE
        while (left := _processes(self._name)) and time.monotonic() < until:  # again, for what they began meanwhile
            for number in left:
                with suppress(OSError):  # gone, or another user's
                    os.kill(number, signal.SIGKILL)
            time.sleep(0.01)


_LEFT_BEHIND: list[_Stay] = []  # Ctrl-C came while Ray began, which nothing interrupts


def _processes(name: str) -> set[int]:
    """Processes of a cluster that was begun here, by the environment that they or their parents have."""
    found: set[int] = set()
    for environment in Path("/proc").glob("[0-9]*/environ"):
        with suppress(OSError):  # another's, or gone
            if f"{MARK}={name}".encode() in environment.read_bytes():
                found.add(int(environment.parent.name))
                for children in environment.parent.glob("task/*/children"):  # some write a title over it
                    found |= set(map(int, children.read_text().split()))
    return found
