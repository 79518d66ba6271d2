"""What does units of work: an engine. The local one does them in processes of this machine, one thread each."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from filelock import FileLock

from outlap.experiments.unit import DONE, Report, Unit, done_record
from outlap.files import atomic_write, remove_partials, to_json
from outlap.processes import Workers, at_work, import_learning, process_environment, report_share, start_worker

SECONDS = "seconds.txt"  # how long an unfinished unit has taken so far
NOTE_EVERY = 10.0  # [s] between two notes of that
ONE_THREAD = {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # a unit keeps one core busy


@dataclass(frozen=True)
class Outcome:
    """How a unit ended: the seconds that it took, earlier sessions included, or what went wrong."""

    unit: Unit
    seconds: float = 0.0
    error: Exception | None = None


class Engine(Protocol):
    """Does units, several at a time. A unit whose process or machine is lost is tried again by the engine itself."""

    @property
    def limit(self) -> int:
        """Units that may be with the engine now."""
        ...

    @property
    def slots(self) -> int:
        """Units that it does at a time, for an estimate of the time that is left."""
        ...

    def open(self, units: Sequence[Unit], work: Path) -> None:
        """Get ready for some units, whose folders are in a folder of work."""
        ...

    def submit(self, unit: Unit) -> None:
        """Begin a unit, all that it needs being done."""
        ...

    def wait(self, timeout: float) -> list[Outcome]:
        """Units that have ended, after so many seconds at most."""
        ...

    def shares(self) -> Mapping[str, float]:
        """How far the units that run are, by their keys."""
        ...

    def close(self) -> None:
        """Let the units that still run save and stop, and give back what `open` took; safe where that failed."""
        ...


class LocalEngine:
    """Processes of this machine.

    Args:
        jobs: units at a time; 0: one a core.
    """

    def __init__(self, jobs: int = 0) -> None:
        self.slots = jobs or os.cpu_count() or 1
        self._resources = ExitStack()
        self._running: dict[Future[float], Unit] = {}
        # Where a process dies, those beside it are lost too: each is tried once more, alone.
        self._lost: set[str] = set()  # keys
        self._again: list[Unit] = []

    @property
    def limit(self) -> int:
        alone = self._again or any(unit.key in self._lost for unit in self._running.values())
        return 0 if alone else self.slots

    def open(self, units: Sequence[Unit], work: Path) -> None:
        self._work = work
        self._context = multiprocessing.get_context("spawn")
        self._workers = Workers(self._context, len(units))
        self._numbers = {unit.key: number for number, unit in enumerate(units)}
        self._resources.enter_context(process_environment(**ONE_THREAD))
        self._pool = self._new_pool()
        self._resources.callback(lambda: self._pool.shutdown(wait=True))

    def _new_pool(self) -> ProcessPoolExecutor:
        shared = self._workers.initializer_arguments
        return ProcessPoolExecutor(self.slots, mp_context=self._context, initializer=start_worker, initargs=shared)

    def _renew_pool(self) -> None:
        self._pool.shutdown()
        self._pool = self._new_pool()

    def submit(self, unit: Unit) -> None:
        number = self._numbers[unit.key]
        try:
            future = self._workers.submit(self._pool, number, _do_in_worker, unit, self._work, number)
        except BrokenProcessPool:  # a process has died since the last `wait`
            if self._running:
                self._again.append(unit)  # for `wait`, which hears of those that died with it
                return
            self._renew_pool()
            future = self._workers.submit(self._pool, number, _do_in_worker, unit, self._work, number)
        self._running[future] = unit

    def wait(self, timeout: float) -> list[Outcome]:
        if not self._running and self._again:
            self.submit(self._again.pop(0))
        finished, _ = wait(self._running, timeout, FIRST_COMPLETED)
        if any(isinstance(future.exception(), BrokenProcessPool) for future in finished):
            finished, _ = wait(self._running)  # all of them have the same error
            self._renew_pool()
        outcomes = []
        for future in finished:
            unit = self._running.pop(future)
            match future.exception():
                case None:
                    outcomes.append(Outcome(unit, future.result()))
                case BrokenProcessPool() if unit.key not in self._lost:
                    self._lost.add(unit.key)
                    self._again.append(unit)
                case Exception() as error:
                    outcomes.append(Outcome(unit, error=error))
                case BaseException() as stop:
                    raise stop
        return outcomes

    def shares(self) -> Mapping[str, float]:
        return {unit.key: self._workers.share[self._numbers[unit.key]] for unit in self._running.values()}

    def close(self) -> None:
        if self._running:  # after an error or Ctrl-C
            self._workers.end([(future, self._numbers[unit.key]) for future, unit in self._running.items()])
        self._resources.close()


def do_unit(unit: Unit, work: Path, report: Report) -> float:
    """Do a unit, or go on with it, and note that it is done; returns the seconds it took, earlier sessions included.

    Where `report` raises KeyboardInterrupt, so does this, once what is done is saved.
    """
    folder = unit.folder(work)
    folder.mkdir(parents=True, exist_ok=True)
    # Whoever was at work here before, and has lost its parent, may still be saving.
    with FileLock(folder / ".lock"):
        remove_partials(folder)
        before, begun = _seconds_before(folder), time.monotonic()
        noted = begun

        def note(share: float) -> None:
            nonlocal noted
            now = time.monotonic()
            if now - noted > NOTE_EVERY:
                atomic_write(folder / SECONDS, f"{before + now - begun:.1f}\n")
                noted = now
            report(share)

        if not unit.is_done(work):
            unit.do(work, note)
            seconds = round(before + time.monotonic() - begun, 1)
            atomic_write(folder / DONE, to_json({"seconds": seconds, "name": unit.name, "key": unit.key}) + "\n")
        return float(done_record(unit, work)["seconds"])


def _seconds_before(folder: Path) -> float:
    try:
        return float((folder / SECONDS).read_text())
    except (OSError, ValueError):
        return 0.0


def _do_in_worker(unit: Unit, work: Path, number: int) -> float:
    if unit.learns:
        import_learning()
    with at_work(number):
        return do_unit(unit, work, lambda share: report_share(number, share))
