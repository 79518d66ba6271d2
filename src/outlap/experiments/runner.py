"""Doing units of work on an engine: each when what it needs is done, and none twice.

Killed at any moment, the same units go on where they were. A unit that fails stops only those that need it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from outlap.errors import OutlapError
from outlap.experiments.engine import Engine, LocalEngine
from outlap.experiments.unit import Unit, done_record

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
    units: Sequence[Unit],
    work: Path,
    engine: Engine | None = None,
    on_status: Callable[[Status], None] | None = None,
) -> None:
    """Do all units that are not done yet.

    Args:
        units: none before those that it needs.
        work: the folder for their folders.
        engine: what does them; by default one unit a core of this machine. It is closed at the end.
        on_status: called now and then.

    Raises OutlapError that names the units that failed, once all the others are done. A KeyboardInterrupt passes
    through once every running unit has saved what it has.
    """
    work.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(work / ".lock", timeout=0):
            _run_units(units, work, engine or LocalEngine(), on_status)
    except Timeout:
        raise OutlapError(f"{work}: another process is at work there; wait for it, or give another --out") from None


def _run_units(units: Sequence[Unit], work: Path, engine: Engine, on_status: Callable[[Status], None] | None) -> None:
    missing = [unit for unit in units if not unit.is_done(work)]
    if not missing:
        return
    failed: dict[str, tuple[Unit, str]] = {}  # by key, with the reason
    running: dict[str, Unit] = {}
    try:
        engine.open(missing, work)  # which may find some of them done elsewhere
        pace = _Pace(units, work)
        done = {unit.key for unit in units if unit.is_done(work)}
        waiting = [unit for unit in missing if unit.key not in done]
        while waiting or running:
            for unit in list(waiting):
                if len(running) >= engine.limit:
                    break
                if any(needed.key in failed for needed in unit.needs):
                    waiting.remove(unit)
                    failed[unit.key] = unit, "needs one that failed"
                elif all(needed.key in done for needed in unit.needs):
                    waiting.remove(unit)
                    running[unit.key] = unit
                    engine.submit(unit)
            if not running:
                continue
            for outcome in engine.wait(POLL):
                unit = running.pop(outcome.unit.key)
                if outcome.error is None:
                    done.add(unit.key)
                    pace.note(unit, outcome.seconds)
                else:
                    log.warning("%s failed: %s", unit.name, outcome.error)
                    failed[unit.key] = unit, f"{type(outcome.error).__name__}: {outcome.error}"
            if on_status is not None:
                on_status(pace.status(len(done), engine.shares(), [*running.values(), *waiting], engine.slots))
    finally:
        engine.close()  # after an error or Ctrl-C, units that still run save and go
    if failed:
        unit, reason = next(iter(failed.values()))
        raise OutlapError(
            f"{len(failed)} of {len(units)} units of work failed, {unit.name} first ({reason}); what is done is kept: "
            "the same command tries again, and other --methods or tables go without it"
        )


class _Pace:
    """How long units take, from estimates that are corrected by the units of the same kind that are done."""

    def __init__(self, units: Sequence[Unit], work: Path) -> None:
        self.units = units
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

    def status(self, done: int, shares: Mapping[str, float], to_do: Sequence[Unit], slots: int) -> Status:
        """Where things stand, with the shares that are done of those units that run, by their keys."""
        left = [self.expected(unit) * (1.0 - shares.get(unit.key, 0.0)) for unit in to_do]
        total = sum(self.expected(unit) for unit in self.units)
        # Where few units are left, not all slots have work.
        seconds = max(sum(left) / slots, max(left, default=0.0))
        names = tuple(sorted(unit.name for unit in to_do if unit.key in shares))
        return Status(len(self.units), done, total, total - sum(left), seconds, names)
