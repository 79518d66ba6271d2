"""`outlap opponents train | verify | list | record`."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic.dataclasses import dataclass
from tyro.conf import Positional, arg

from outlap.cli.command import Command, Count, LongCommand, Positive
from outlap.cli.output import CommandResult, lines, table
from outlap.cli.work import WorkCommand
from outlap.drivers.population import read_manifest
from outlap.errors import OutlapError
from outlap.training.opponents import opponent_defaults
from outlap.training.ppo import PPOConfig

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class TrainOpponents(WorkCommand):
    """Train a population of opponents: one PPO policy for every top speed, verified before it may race.

    A population that was stopped goes on with the same command.
    """

    track: str
    """Name or map folder of the track to train on."""

    out: Path | None = None
    """The population's folder; by default populations/TRACK."""

    speeds: str = "2.0:6.0:0.5"
    """Top speeds [m/s] of those to train against: first:last:step."""

    held_out: tuple[float, ...] = (6.5, 7.0)
    """Top speeds [m/s] of those that training never meets."""

    settings: Annotated[PPOConfig, arg(name="")] = field(default_factory=opponent_defaults)

    laps: Count = 5
    """Consecutive laps that an opponent must complete from every start."""

    starts: Count = 20
    """Of its verification."""

    def run(self) -> CommandResult:
        from outlap.experiments.opponent_units import (
            OpponentUnit,
            enter_all,
            name_opponents,
            parse_speeds,
            verification_row,
        )
        from outlap.track import load_track

        self.check_flags()
        track = load_track(self.track)
        folder = self.out or Path("populations") / track.name
        units = [
            OpponentUnit(each.name, self.settings, self.track, each.max_speed_mps, each.split, self.laps, self.starts)
            for each in name_opponents(track.name, parse_speeds(self.speeds), self.held_out)
        ]
        self.do_units(units, folder / "work", "training")
        command = shlex.join(["outlap", *sys.argv[1:]])
        entered = enter_all(units, folder / "work", folder, command)
        rows = [verification_row(unit.opponent, found, member is not None) for unit, found, member in entered]
        data = {"folder": folder, "opponents": rows}
        return CommandResult(data, lambda console: _print(console, rows, folder))


@dataclass(frozen=True)
class RecordLap(Command):
    """Record a flying lap of a driver alone; the file is an opponent (a ghost) for that track."""

    driver: Annotated[Positional[str], arg(metavar="RUN")]
    """A run folder of `outlap train`, an opponent such as population/NAME, or a driver without one: pure-pursuit."""

    track: str
    """Name or map folder of the track."""

    out: Path
    """The csv file to write: t_s, x_m, y_m, yaw_rad, vx_mps."""

    v_max: Positive | None = None
    """[m/s] top speed of the car, in place of the driver's own."""

    seed: int = 0
    """Of the start."""

    def run(self) -> CommandResult:
        from outlap.drivers.ghost import Ghost
        from outlap.evaluation.protocol import with_top_speed
        from outlap.evaluation.recorder import record_lap
        from outlap.track import load_track
        from outlap.training.subject import find_subject

        if self.out.suffix != ".csv":
            raise OutlapError(f"--out is {self.out}; must end in .csv, by which a recorded lap is known")
        driver, env, _ = find_subject(self.driver)
        env = with_top_speed(env, self.v_max)
        lap = record_lap(driver, env, load_track(self.track), self.seed)
        try:
            path = Ghost(lap, self.out.stem).save(self.out)
        except OSError as error:
            raise OutlapError(f"--out {self.out}: cannot be written: {error.strerror}") from None
        data = {"lap": path, "lap_time_s": float(lap[-1, 0]), "points": len(lap)}
        return CommandResult(data, lines(f"{lap[-1, 0]:.2f} s, {len(lap)} points: {path}"))


@dataclass(frozen=True)
class ListOpponents(Command):
    """List the opponents of a population."""

    folder: Annotated[Positional[Path | None], arg(metavar="FOLDER")] = None
    """The population; by default the one that comes with outlap."""

    def run(self) -> CommandResult:
        from outlap.drivers.population import SHIPPED

        folder = self.folder or SHIPPED
        keys = ("name", "max_speed_mps", "split", "track", "verified_laps", "crash_rate", "lap_time_s")
        rows = [{key: getattr(member, key) for key in keys} for member in read_manifest(folder)]
        return CommandResult({"opponents": rows}, lambda console: _print(console, rows, folder))


@dataclass(frozen=True)
class VerifyOpponents(LongCommand):
    """Race every opponent of a population alone again, and take those that fail out of its manifest."""

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """The population."""

    laps: Count = 5
    """Consecutive laps that an opponent must complete from every start."""

    starts: Count = 20
    """Standing starts anywhere on the lap."""

    def run(self) -> CommandResult:
        from outlap.experiments.opponent_units import verify_population

        with self.progress("verifying", len(read_manifest(self.folder)), "opponents") as update:
            rows = verify_population(self.folder, self.laps, self.starts, update)
        data = {"folder": self.folder, "opponents": rows}
        return CommandResult(data, lambda console: _print(console, rows, self.folder))


def _print(console: Console, rows: Sequence[dict[str, Any]], folder: Path) -> None:
    cells = [
        (
            row["name"], f"{row['max_speed_mps']:.1f}", row["split"].replace("_", " "), row["verified_laps"],
            f"{row['crash_rate']:.0%}", "-" if row["lap_time_s"] is None else f"{row['lap_time_s']:.1f}",
            "" if row.get("verified", True) else "failed: left out",
        )
        for row in rows
    ]  # fmt: skip
    headings = ("opponent", "top speed [m/s]", "half", "laps", "crash rate", "lap time [s]", "")
    console.print(table(headings, cells, left=("opponent", "half", "")))
    console.print(f"population: {folder}")
