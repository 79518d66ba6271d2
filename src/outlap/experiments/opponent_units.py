"""The units of work that a population of opponents is made of, and the population that they make."""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from outlap.drivers.population import Member, Split, file_names, load_population, read_manifest
from outlap.errors import OutlapError
from outlap.evaluation.results import ROWS, write_rows
from outlap.experiments.unit import Report, Unit
from outlap.files import replacing
from outlap.track.catalog import load_track
from outlap.training.opponents import SLOWEST, Opponent, crash_rate, enter, train_opponent, verify
from outlap.training.ppo import PPOConfig

COMMAND = "outlap reproduce"  # for the manifest of a population that an experiment trains


@dataclass(frozen=True, eq=False)
class OpponentUnit(Unit):
    """One opponent, trained and verified."""

    kind = "opponents"
    settings: PPOConfig
    track: str
    max_speed_mps: float
    split: str
    laps: int
    starts: int = 20

    @property
    def size(self) -> float:
        return self.settings.total_steps

    @property
    def tracks(self) -> tuple[str, ...]:
        return (self.track,)

    @property
    def uses_gpu(self) -> bool:
        return self.settings.device.startswith("cuda")

    @property
    def opponent(self) -> Opponent:
        """What is trained."""
        return Opponent(self.name, self.max_speed_mps, self.split)  # type: ignore[arg-type]

    def run_folder(self, work: Path) -> Path:
        """Of its training."""
        return self.folder(work) / "runs" / self.name

    def do(self, work: Path, report: Report) -> None:
        folder, total = self.folder(work), self.settings.total_steps
        driver = train_opponent(
            self.opponent, self.settings, self.track, self.run_folder(work), lambda steps: report(0.95 * steps / total)
        )
        driver.save(folder / self.name)
        track = load_track(self.track)
        write_rows(verify(driver, self.settings.env, track, self.laps, self.starts), folder / ROWS)


@dataclass(frozen=True, eq=False)
class PopulationUnit(Unit):
    """The opponents that passed their verification, as a population."""

    kind = "populations"
    opponents: tuple[OpponentUnit, ...]

    def do(self, work: Path, report: Report) -> None:
        passed = [unit for unit, _, member in enter_all(self.opponents, work, self.folder(work), COMMAND) if member]
        failed = [unit for unit in self.opponents if unit not in passed]
        if any(unit.split == "held_out" for unit in failed) or all(unit.split == "held_out" for unit in passed):
            raise OutlapError(
                f"opponents {', '.join(unit.name for unit in failed)}: did not complete {self.opponents[0].laps} laps "
                "from every start; give the budget's population more total_steps"
            )


def enter_all(
    units: Sequence[OpponentUnit], work: Path, folder: Path, command: str
) -> list[tuple[OpponentUnit, pd.DataFrame, Member | None]]:
    """Copy opponents that are done into a population's folder, and enter those that passed into its manifest.

    Args:
        units: the opponents.
        work: where they are.
        folder: of the population; others that are in it stay.
        command: that trained them.

    Returns:
        Each with the rows of its verification, and what the manifest says; None of one that failed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    for unit in units:
        for file in file_names(unit.name):
            with replacing(folder / file) as partial:
                shutil.copyfile(unit.folder(work) / file, partial)
        rows = pd.read_parquet(unit.folder(work) / ROWS)
        found.append((unit, rows, enter(folder, unit.opponent, rows, str(rows["track"].iloc[0]), unit.laps, command)))
    return found


def parse_speeds(text: str) -> list[float]:
    """Return the top speeds [m/s] of a text first:last:step. Raise OutlapError for any other text."""
    try:
        first, last, step = (float(word) for word in text.split(":"))
        count = math.floor((last - first) / step + 1e-6)
        if step <= 0.0 or count < 0:
            raise ValueError
    except (ValueError, ArithmeticError):
        raise OutlapError(f"--speeds is {text!r}; must be first:last:step, such as 2.0:6.0:0.5") from None
    return [round(first + i * step, 6) for i in range(count + 1)]


def name_opponents(track: str, speeds: Sequence[float], held_out: Sequence[float]) -> list[Opponent]:
    """Return the opponents to train, named after their track and top speed.

    Args:
        track: its name.
        speeds: top speeds [m/s] of those that training meets.
        held_out: top speeds [m/s] of the others.

    Raises OutlapError for a top speed that is not possible, or is there twice.
    """
    halves: tuple[tuple[Split, Sequence[float]], ...] = (("train", speeds), ("held_out", held_out))
    prefix = re.sub(r"[^\w.-]+", "-", track)
    opponents = [Opponent(f"{prefix}-{speed:.1f}", speed, split) for split, half in halves for speed in half]
    names = [opponent.name for opponent in opponents]
    for opponent in opponents:
        if not SLOWEST < opponent.max_speed_mps < math.inf:
            raise OutlapError(f"a top speed is {opponent.max_speed_mps}; must be more than {SLOWEST} m/s")
        if names.count(opponent.name) > 1:
            raise OutlapError(
                f"two opponents would be called {opponent.name}; name each top speed once, in --speeds or --held-out, "
                "0.1 m/s or more apart"
            )
    return opponents


def verify_population(
    folder: Path, laps: int, starts: int, on_verified: Callable[[int, str], None]
) -> list[dict[str, Any]]:
    """Verify the opponents of a population again, and remove those that fail from its manifest.

    Args:
        folder: of the population.
        laps: see `verify`, as `starts`.
        on_verified: called with the number of opponents that are verified, and the last one's name.

    Returns:
        See `verification_row`.
    """
    members = {member.name: member for member in read_manifest(folder)}
    rows = []
    for driver in load_population(folder, split=None):
        member = members[driver.name]
        found = verify(driver, PPOConfig().env, load_track(member.track), laps, starts)
        opponent = Opponent(member.name, member.max_speed_mps, member.split)
        kept = enter(folder, opponent, found, member.track, laps, member.command)
        rows.append(verification_row(opponent, found, kept is not None))
        on_verified(len(rows), driver.name)
    return rows


def verification_row(opponent: Opponent, rows: pd.DataFrame, verified: bool) -> dict[str, Any]:
    """Return the numbers of a verification."""
    lap_times = rows["lap_time_s"].to_numpy()
    return {
        **asdict(opponent),
        "verified": verified,
        "verified_laps": int(rows["completed_laps"].to_numpy().min()),
        "crash_rate": crash_rate(rows),
        "lap_time_s": None if np.isnan(lap_times).all() else float(np.nanmean(lap_times)),
    }
