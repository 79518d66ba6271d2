"""Engines do units of work. The local engine does them in processes of this machine, with one thread each."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from filelock import FileLock

from outlap.experiments.unit import DONE, Report, Unit, done_record
from outlap.experiments.workers import Workers, reporting
from outlap.files import atomic_write, remove_partials, to_json
from outlap.processes import process_environment

SECONDS = "seconds.txt"  # how long an unfinished unit has taken so far
NOTE_INTERVAL = 10.0  # [s] between two updates of that file
ONE_THREAD = {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # a unit keeps one core busy


@dataclass(frozen=True)
class Outcome:
    """How a unit ended: the seconds that it took in all sessions, or an error."""

    unit: Unit
    seconds: float = 0.0
    error: Exception | None = None


class Engine(Protocol):
    """Does units, several at a time. It retries a unit whose process or machine is lost."""

    @property
    def limit(self) -> int:
        """Units that may be submitted and unfinished now."""
        ...

    @property
    def slots(self) -> int:
        """Units that it does at a time, for an estimate of the time left."""
        ...

    def open(self, work: Path) -> None:
        """Prepare for units of a work folder."""
        ...

    def fetch(self, units: Sequence[Unit]) -> None:
        """Bring units that are finished elsewhere into the work folder."""
        ...

    def submit(self, unit: Unit) -> None:
        """Begin a unit whose requirements are all done."""
        ...

    def wait(self, timeout: float) -> list[Outcome]:
        """Return units that have ended, after at most `timeout` seconds."""
        ...

    def shares(self) -> Mapping[str, float]:
        """Return the finished share of the units that run, by key."""
        ...

    def close(self) -> None:
        """Let running units save and stop, and release what `open` acquired; safe if that failed."""
        ...


class LocalEngine:
    """Processes of this machine.

    Args:
        jobs: units at a time; 0: one for each core.
    """

    def __init__(self, jobs: int = 0) -> None:
        self.slots = jobs or os.cpu_count() or 1
        self._workers: Workers | None = None
        self._resources = ExitStack()
        self._running: dict[Future[float], tuple[Unit, int]] = {}  # with their slots
        # If a process dies, those beside it are lost too: each of their units is retried once, alone.
        self._lost: set[str] = set()  # keys
        self._retries: list[Unit] = []

    @property
    def limit(self) -> int:
        alone = self._retries or any(unit.key in self._lost for unit, _ in self._running.values())
        return 0 if alone else self.slots

    def open(self, work: Path) -> None:
        self._work = work
        self._resources.enter_context(process_environment(**ONE_THREAD))
        self._workers = Workers(self.slots)

    def fetch(self, units: Sequence[Unit]) -> None:
        pass

    def submit(self, unit: Unit) -> None:
        assert self._workers is not None
        slot = next(iter({*range(self.slots)} - {slot for _, slot in self._running.values()}))
        task = (slot, _do_in_worker, unit, self._work, slot)
        try:
            future = self._workers.submit(*task)
        except BrokenProcessPool:  # a process has died since the last `wait`
            if self._running:
                self._retries.append(unit)  # `wait` learns of the units that died with it
                return
            self._workers.restart()
            future = self._workers.submit(*task)
        self._running[future] = unit, slot

    def wait(self, timeout: float) -> list[Outcome]:
        assert self._workers is not None
        if not self._running and self._retries:
            self.submit(self._retries.pop(0))
        finished, _ = wait(self._running, timeout, FIRST_COMPLETED)
        if any(isinstance(future.exception(), BrokenProcessPool) for future in finished):
            finished, _ = wait(self._running)  # all of them have the same error
            self._workers.restart()
        outcomes = []
        for future in finished:
            unit, _ = self._running.pop(future)
            match future.exception():
                case None:
                    outcomes.append(Outcome(unit, future.result()))
                case BrokenProcessPool() if unit.key not in self._lost:
                    self._lost.add(unit.key)
                    self._retries.append(unit)
                case Exception() as error:
                    outcomes.append(Outcome(unit, error=error))
                case BaseException() as stop:
                    raise stop
        return outcomes

    def shares(self) -> Mapping[str, float]:
        progress = self._workers.progress if self._workers else ()
        return {unit.key: max(0.0, progress[slot]) for unit, slot in self._running.values()}

    def close(self) -> None:
        if self._workers is not None:
            self._workers.end([(future, slot) for future, (_, slot) in self._running.items()])
        self._resources.close()


def run_unit(unit: Unit, work: Path, report: Report) -> float:
    """Do or resume a unit, and mark it as done; return the seconds that it took in all sessions.

    Raise KeyboardInterrupt if `report` does, with the work saved.
    """
    folder = unit.folder(work)
    folder.mkdir(parents=True, exist_ok=True)
    # A process that has lost its parent may still be saving here.
    with FileLock(folder / ".lock"):
        remove_partials(folder)
        earlier, begun = _seconds_so_far(folder), time.monotonic()
        noted = begun

        def note(share: float) -> None:
            nonlocal noted
            now = time.monotonic()
            if now - noted > NOTE_INTERVAL:
                atomic_write(folder / SECONDS, f"{earlier + now - begun:.1f}\n")
                noted = now
            report(share)

        if not unit.is_done(work):
            unit.do(work, note)
            seconds = round(earlier + time.monotonic() - begun, 1)
            record = {"seconds": seconds, "name": unit.name, "key": unit.key}
            atomic_write(folder / DONE, to_json({**record, "category": unit.category, "size": unit.size}) + "\n")
        return float(done_record(unit, work)["seconds"])


def _seconds_so_far(folder: Path) -> float:
    try:
        return float((folder / SECONDS).read_text())
    except (OSError, ValueError):
        return 0.0


def _do_in_worker(unit: Unit, work: Path, slot: int) -> float:
    with reporting(slot) as report:
        return run_unit(unit, work, report)
