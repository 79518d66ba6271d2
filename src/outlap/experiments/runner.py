"""Do units of work on an engine, in order of their requirements, each once.

A killed command resumes by running again. A failed unit stops only the units that need it.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from outlap.errors import OutlapError
from outlap.experiments.engine import Engine, LocalEngine
from outlap.experiments.unit import DONE, Unit

log = logging.getLogger(__name__)

POLL_INTERVAL = 0.5  # [s] between two status reports

Follow = Callable[[Unit], Sequence[Unit]]  # returns units to do next


@dataclass(frozen=True)
class Status:
    """How far the work is."""

    units: int
    done: int
    share: float  # of the units, with the finished shares of those that run
    seconds_left: float | None  # None: unknown until a unit of each category has finished
    running: tuple[str, ...]


def run_units(
    units: Sequence[Unit],
    work: Path,
    engine: Engine | None = None,
    on_status: Callable[[Status], None] | None = None,
    on_done: Follow | None = None,
    on_failed: Follow | None = None,
) -> None:
    """Do all units that are not done yet.

    Args:
        units: each after those that it needs.
        work: the folder of their folders.
        engine: what does them, by default one unit on each core of this machine. It is closed at the end.
        on_status: called repeatedly.
        on_done: called once with each finished unit, earlier sessions included; returns units to do next.
        on_failed: called once with each unit that fails, or needs one that failed; returns units to do next.

    Raises OutlapError that names the units that failed, after all others are done. A KeyboardInterrupt passes through
    after every running unit has saved its work.
    """
    work.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(work / ".lock", timeout=0):
            _Session(work, engine or LocalEngine(), on_done, on_failed).run(units, on_status)
    except Timeout:
        raise OutlapError(f"{work}: another process is at work there; wait for it, or give another --out") from None


class _Session:
    """One call of `run_units`."""

    def __init__(self, work: Path, engine: Engine, on_done: Follow | None, on_failed: Follow | None) -> None:
        self._work, self._engine, self._on_done, self._on_failed = work, engine, on_done, on_failed
        self._units: dict[str, Unit] = {}  # all of them, by key, as below
        self._done: set[str] = set()
        self._waiting: list[Unit] = []
        self._running: dict[str, Unit] = {}
        self._failed: dict[str, str] = {}  # reasons
        self._rates: dict[str, float] = {}
        self._rated = -1  # units that were done at that time

    def run(self, units: Sequence[Unit], on_status: Callable[[Status], None] | None) -> None:
        if self._on_done is None and all(unit.is_done(self._work) for unit in units):
            return
        try:
            self._engine.open(self._work)
            self._add(units)
            while self._waiting or self._running:
                self._submit()
                if not self._running:
                    continue
                for outcome in self._engine.wait(POLL_INTERVAL):
                    unit = self._running.pop(outcome.unit.key)
                    if outcome.error is None:
                        self._finish(unit)
                    else:
                        log.warning("%s failed: %s", unit.name, outcome.error)
                        self._fail(unit, f"{type(outcome.error).__name__}: {outcome.error}")
                if on_status is not None:
                    on_status(self._status())
        finally:
            self._engine.close()
        if self._failed:
            key, reason = next(iter(self._failed.items()))
            raise OutlapError(
                f"{len(self._failed)} of {len(self._units)} units of work failed, {self._units[key].name} first "
                f"({reason}); what is done is kept: the same command tries again"
            )

    def _add(self, units: Sequence[Unit]) -> None:
        new = {unit.key: unit for unit in units if unit.key not in self._units}
        self._units |= new
        self._engine.fetch([unit for unit in new.values() if not unit.is_done(self._work)])
        done = [unit for unit in new.values() if unit.is_done(self._work)]
        self._waiting += [unit for unit in new.values() if unit not in done]
        for unit in done:
            self._finish(unit)

    def _finish(self, unit: Unit) -> None:
        self._done.add(unit.key)
        if self._on_done is not None:
            self._add(self._on_done(unit))

    def _fail(self, unit: Unit, reason: str) -> None:
        self._failed[unit.key] = reason
        if self._on_failed is not None:
            self._add(self._on_failed(unit))

    def _submit(self) -> None:
        """Submit units that can begin."""
        for unit in list(self._waiting):
            if len(self._running) >= self._engine.limit:
                break
            if any(needed.key in self._failed for needed in unit.needs):
                self._waiting.remove(unit)
                self._fail(unit, "needs one that failed")
            elif all(needed.key in self._done for needed in unit.needs):
                self._waiting.remove(unit)
                self._running[unit.key] = unit
                self._engine.submit(unit)

    def _status(self) -> Status:
        shares = self._engine.shares()
        if len(self._done) != self._rated:
            self._rates, self._rated = finished_rates(self._work), len(self._done)
        unfinished = [*self._running.values(), *self._waiting]
        seconds = estimate_seconds(unfinished, self._rates, self._engine.slots, shares)
        names = tuple(sorted(unit.name for unit in self._running.values() if unit.key in shares))
        share = (len(self._done) + sum(shares.get(key, 0.0) for key in self._running)) / len(self._units)
        return Status(len(self._units), len(self._done), share, seconds, names)


def finished_rates(work: Path) -> dict[str, float]:
    """Return the mean seconds for a size of one that the finished units of a work folder took, by category."""
    totals: dict[str, list[float]] = {}
    for path in work.glob(f"*/*/{DONE}"):
        with suppress(OSError, ValueError, KeyError):
            record = json.loads(path.read_text())
            total = totals.setdefault(record["category"], [0.0, 0.0])
            total[0] += float(record["seconds"])
            total[1] += float(record["size"])
    return {category: seconds / max(size, 1e-9) for category, (seconds, size) in totals.items()}


def estimate_seconds(
    units: Iterable[Unit], rates: Mapping[str, float], slots: int, shares: Mapping[str, float]
) -> float | None:
    """Estimate how long units take.

    Args:
        units: those that are not done.
        rates: see `finished_rates`.
        slots: units at a time.
        shares: finished shares of units that run, by key.

    Returns:
        Seconds; None if no unit of a category has finished.
    """
    left = []
    for unit in units:
        if unit.category not in rates:
            return None
        left.append(unit.size * rates[unit.category] * (1.0 - shares.get(unit.key, 0.0)))
    return max(sum(left) / slots, max(left, default=0.0))  # the last units do not fill all slots


def missing_work(units: Sequence[Unit], work: Path, slots: int) -> tuple[dict[str, int], float | None]:
    """Return how many units of each kind are not done, and how long they take [s]; None if that cannot be estimated.

    Args:
        units: to count.
        work: their folder.
        slots: units at a time.
    """
    missing = [unit for unit in units if not unit.is_done(work)]
    counts = {kind: sum(unit.kind == kind for unit in missing) for kind in dict.fromkeys(unit.kind for unit in units)}
    return counts, estimate_seconds(missing, finished_rates(work), slots, {})
