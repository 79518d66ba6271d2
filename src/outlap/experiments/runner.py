"""Doing units of work on all cores: each when what it needs is done, in worker processes of one thread each.

Killed at any moment, the same units go on where they were. A unit that fails stops only those that need it.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from outlap.errors import OutlapError
from outlap.experiments.units import DONE, Unit, done_record
from outlap.files import atomic_write, to_json
from outlap.processes import process_environment

log = logging.getLogger(__name__)

POLL = 0.5  # [s] between two looks at how far units are


@dataclass(frozen=True)
class Status:
    """How far the work is."""

    units: int
    done: int
    work: float  # [s] all units together, as they were estimated
    work_done: float
    seconds_left: float
    running: tuple[str, ...]


def run_units(
    units: Sequence[Unit], work: Path, jobs: int = 0, on_status: Callable[[Status], None] | None = None
) -> None:
    """Do all units that are not done yet.

    Args:
        units: none before those that it needs.
        work: the folder for their folders.
        jobs: units at a time; 0: one a core.
        on_status: called now and then.

    Raises OutlapError that names the units that failed, once all the others are done. A KeyboardInterrupt passes
    through once every running unit has saved what it has.
    """
    work.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(work / ".lock", timeout=0):
            _run_units(units, work, jobs or os.cpu_count() or 1, on_status)
    except Timeout:
        raise OutlapError(f"{work}: another process is at work there; wait for it, or give another --out") from None


def _run_units(units: Sequence[Unit], work: Path, jobs: int, on_status: Callable[[Status], None] | None) -> None:
    pace = _Pace(units, work, jobs)
    waiting = [unit for unit in units if not unit.is_done(work)]
    done = {unit.key for unit in units if unit.is_done(work)}
    failed: dict[str, tuple[Unit, str]] = {}  # by key, with the reason
    suspects: set[str] = set()  # keys of units whose process died, or one beside it: each is tried once more, alone
    if not waiting:
        return
    context = multiprocessing.get_context("spawn")
    shares, stop = context.Array("d", len(units)), context.Event()
    numbers = {unit.key: number for number, unit in enumerate(units)}

    def new_pool() -> ProcessPoolExecutor:
        return ProcessPoolExecutor(jobs, mp_context=context, initializer=_start_worker, initargs=(shares, stop))

    with process_environment(NUMBA_NUM_THREADS="1", OMP_NUM_THREADS="1"):
        pool = new_pool()
        running: dict[Future[float], Unit] = {}
        try:
            while waiting or running:
                for unit in list(waiting):
                    if len(running) == jobs or any(other.key in suspects for other in running.values()):
                        break
                    if unit.key in suspects and running:
                        continue
                    if any(needed.key in failed for needed in unit.needs):
                        waiting.remove(unit)
                        failed[unit.key] = unit, "needs one that failed"
                    elif all(needed.key in done for needed in unit.needs):
                        waiting.remove(unit)
                        running[pool.submit(_do, unit, work, numbers[unit.key])] = unit
                if not running:
                    continue
                finished, _ = wait(running, POLL, FIRST_COMPLETED)
                for future in finished:
                    unit = running.pop(future)
                    error = future.exception()
                    if error is None:
                        done.add(unit.key)
                        pace.note(unit, future.result())
                    elif isinstance(error, BrokenProcessPool) and unit.key not in suspects:
                        suspects.add(unit.key)
                        waiting.insert(0, unit)
                    elif isinstance(error, Exception):
                        log.warning("%s failed: %s", unit.name, error)
                        failed[unit.key] = unit, f"{type(error).__name__}: {error}"
                    else:
                        raise error
                if any(isinstance(future.exception(), BrokenProcessPool) for future in finished):
                    wait(running)  # all of them have the same error
                    suspects |= {unit.key for unit in running.values()}
                    waiting[:0] = running.values()
                    running.clear()
                    pool.shutdown()
                    pool = new_pool()
                if on_status is not None:
                    under_way = {unit: shares[numbers[unit.key]] for unit in running.values()}
                    on_status(pace.status(under_way, len(done), [*waiting, *running.values()]))
        finally:
            stop.set()  # after an error or Ctrl-C, those that still work save and go
            pool.shutdown(wait=True)
    if failed:
        unit, reason = next(iter(failed.values()))
        raise OutlapError(
            f"{len(failed)} of {len(units)} units of work failed, {unit.name} first ({reason}); what is done is kept: "
            "the same command tries again, and other --methods or tables go without it"
        )


class _Pace:
    """How long units take, from estimates that are corrected by the units of the same kind that are done."""

    def __init__(self, units: Sequence[Unit], work: Path, jobs: int) -> None:
        self.units, self.jobs = units, jobs
        self.ratios: dict[str, list[tuple[float, float]]] = {}
        for unit in units:
            if unit.is_done(work):
                self.note(unit, float(done_record(unit, work).get("seconds", unit.seconds)))

    def note(self, unit: Unit, seconds: float) -> None:
        """A unit took so long."""
        self.ratios.setdefault(unit.kind, []).append((seconds, unit.seconds))

    def expected(self, unit: Unit) -> float:
        """[s] that a unit should take."""
        known = self.ratios.get(unit.kind, [])
        # One unit's worth of the estimate itself, so that the first one that is done does not decide alone.
        taken = sum(seconds for seconds, _ in known) + unit.seconds
        return unit.seconds * taken / (sum(estimate for _, estimate in known) + unit.seconds)

    def status(self, running: dict[Unit, float], done: int, to_do: Sequence[Unit]) -> Status:
        """Where things stand, with the share of each running unit that is done."""
        left = sum(self.expected(unit) * (1.0 - running.get(unit, 0.0)) for unit in to_do)
        # Where few units are left, not all jobs have work.
        longest = max((self.expected(unit) * (1.0 - running.get(unit, 0.0)) for unit in to_do), default=0.0)
        total = sum(self.expected(unit) for unit in self.units)
        names = tuple(sorted(unit.name for unit in running))
        return Status(len(self.units), done, total, total - left, max(left / self.jobs, longest), names)


_shares: Any = None  # of every unit, shared by the processes of a pool
_stop: Any = None  # set when all units are to end, shared likewise


def _start_worker(shares: Any, stop: Any) -> None:
    global _shares, _stop
    _shares, _stop = shares, stop
    # Ctrl-C reaches every process of a terminal; workers hear of it from the one that started them.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _do(unit: Unit, work: Path, number: int) -> float:
    """Do a unit in a worker; returns the seconds that it took, earlier sessions included."""
    folder = unit.folder(work)
    folder.mkdir(parents=True, exist_ok=True)
    # Whoever was at work here before, and has lost its parent, may still be saving.
    with FileLock(folder / ".lock"):
        return _do_locked(unit, work, number)


def _do_locked(unit: Unit, work: Path, number: int) -> float:
    parent = multiprocessing.parent_process()
    folder = unit.folder(work)
    before = _seconds_before(folder)
    begun = time.monotonic()
    noted = begun

    def report(share: float) -> None:
        nonlocal noted
        _shares[number] = share
        now = time.monotonic()
        if now - noted > 10.0:
            atomic_write(folder / "seconds.txt", f"{before + now - begun:.1f}\n")
            noted = now
        if parent is not None and not parent.is_alive():
            raise KeyboardInterrupt  # nobody waits for this any more: save and go
        if _stop.is_set():
            raise KeyboardInterrupt

    try:
        unit.do(work, report)
    except KeyboardInterrupt:
        if parent is not None and not parent.is_alive():
            os._exit(1)
        raise
    seconds = round(before + time.monotonic() - begun, 1)
    atomic_write(folder / DONE, to_json({"seconds": seconds, "name": unit.name, "key": unit.key}) + "\n")
    return seconds


def _seconds_before(folder: Path) -> float:
    try:
        return float((folder / "seconds.txt").read_text())
    except (OSError, ValueError):
        return 0.0
