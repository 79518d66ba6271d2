"""The out-lap benchmark: drivers live in cars and on circuits that none of them was trained on."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd

from outlap.envs.car_sets import find_cars
from outlap.envs.race_config import RaceConfig
from outlap.errors import OutlapError
from outlap.evaluation.lives import LAPS, PROTOCOL, Protocol, Yardstick, live
from outlap.evaluation.recovered_gap import summarise_lives
from outlap.evaluation.results import write_rows
from outlap.experiments.unit import Report, Unit
from outlap.files import atomic_write, to_json
from outlap.provenance import provenance
from outlap.track.catalog import load_track
from outlap.training.run import is_run, load_run
from outlap.training.subject import find_subject

LIVES, SUMMARY, RECORD = "lives.parquet", "summary.json", "benchmark.json"
COLUMNS = (
    "method", "training_seed", "car", "split", "track", "lap", "survived", "lap_time_s", "lap_time_ratio", "distance_m",
    "max_slip_rad", "crash_s_m", "min_lap_time_s", "practice_crashes",
)  # fmt: skip
NEEDED = COLUMNS[:10]  # of a file of somebody else's lives


@dataclass(frozen=True, eq=False)
class LivesUnit(Unit):
    """The lives of one driver on one track, in all cars of a split."""

    kind = "lives"
    packages = ("outlap", "torch", "stable-baselines3")
    driver: str = field(compare=False)  # a run folder or the name of a driver
    identity: str  # SHA-256 of its policy, or its name
    method: str
    training_seed: int
    task: RaceConfig
    track: str
    split: str  # a set of cars
    protocol: Protocol
    seed: int

    @property
    def tracks(self) -> tuple[str, ...]:
        return (self.track,)

    def do(self, work: Path, report: Report) -> None:
        driver, _, _ = find_subject(self.driver)
        track, cars = load_track(self.track), find_cars(self.split)
        yardstick = Yardstick.of(track, self.task, cars)
        rows = live(driver, self.task, track, cars, yardstick, self.protocol, self.seed, report)
        rows = rows.assign(method=self.method, training_seed=self.training_seed)
        rows = rows.assign(split=self.split.partition(":")[0])
        write_rows(rows.loc[:, list(COLUMNS)], self.folder(work) / LIVES)


def lives_units(
    drivers: Sequence[str], task: RaceConfig, tracks: Sequence[str], split: str, protocol: Protocol, seed: int
) -> list[LivesUnit]:
    """Return the units of a benchmark.

    Args:
        drivers: run folders and names of drivers. Runs that differ in nothing but their seed are one method, named
            after the folder without its number.
        task: of drivers that are no runs.
        tracks: names or map folders.
        split: a list of cars, see `envs.car_sets`.
        protocol, seed: see `lives.live`.

    Raises OutlapError for a driver that is none, two runs of one seed, a run that was trained on a track.
    """
    units: list[LivesUnit] = []
    names: dict[str, str] = {}  # of methods, by what identifies them
    seen: set[tuple[str, int]] = set()
    for name in drivers:
        driver, _, _ = find_subject(name)
        env, identity, method, training_seed = task, name, driver.name, 0
        if is_run(name):
            run = load_run(name)
            for track in run.trained_on(tracks):
                raise OutlapError(f"{name}: was trained on {track}; lives need circuits that nobody was trained on")
            env, training_seed = run.config.env, run.config.seed
            identity = hashlib.sha256(run.policy_path.read_bytes()).hexdigest()
            label = re.sub(r"[\W_]*\d+$", "", Path(name).resolve().name) or Path(name).resolve().name
            method = names.setdefault(run.method, label if label not in names.values() else Path(name).resolve().name)
        if (method, training_seed) in seen:
            raise OutlapError(f"{name}: another run of {method} has the seed {training_seed}; each seed counts once")
        seen.add((method, training_seed))
        units += [
            LivesUnit(
                name=re.sub(r"[^\w.-]+", "-", f"{method}-{training_seed}-{load_track(track).name}"),
                driver=name,
                identity=identity,
                method=method,
                training_seed=training_seed,
                task=env,
                track=track,
                split=split,
                protocol=protocol,
                seed=seed,
            )
            for track in tracks
        ]
    return units


def foreign_lives(path: Path, split: str) -> pd.DataFrame:
    """Read the lives of a method from elsewhere.

    Raises OutlapError for a file that cannot be read, lacks columns, or is of another split.
    """
    try:
        rows = pd.read_parquet(path)
    except (OSError, ValueError) as error:
        raise OutlapError(f"{path}: cannot be read as Parquet: {error}") from None
    missing = [name for name in NEEDED if name not in rows]
    if missing:
        raise OutlapError(f"{path}: has no column {missing[0]}; must have {', '.join(NEEDED)}")
    others = set(rows["split"]) - {split}
    if others:
        raise OutlapError(f"{path}: is of the split {sorted(map(str, others))[0]}; must be {split}")
    return rows


def write_benchmark(
    units: Sequence[LivesUnit], folder: Path, blind: str, oracle: str | None, seed: int, foreign: Sequence[Path] = ()
) -> dict[str, Any]:
    """Collect the lives of finished units and of files from elsewhere; write rows and summary, and return the summary.

    Args:
        units: see `lives_units`.
        folder: for the results; `folder/work` holds the units.
        blind, oracle: names of methods.
        seed: of the bootstrap.
        foreign: files of `lives.parquet`.

    Raises OutlapError for methods whose cars or tracks differ.
    """
    split = units[0].split.partition(":")[0]
    parts = [pd.read_parquet(unit.folder(folder / "work") / LIVES) for unit in units]
    lives = pd.concat([*parts, *(foreign_lives(path, split) for path in foreign)], ignore_index=True)
    wanted = set(map(tuple, parts[0][["car", "track", "lap"]].to_numpy().tolist()))
    for name, rows in lives.groupby(["method", "training_seed"]):
        method, training = cast("tuple[str, int]", name)
        if len(rows) != len(wanted) or set(map(tuple, rows[["car", "track", "lap"]].to_numpy().tolist())) != wanted:
            raise OutlapError(f"{method}, training {training}: has other cars, tracks or laps than {units[0].method}")
    write_rows(lives, folder / LIVES)
    summary: dict[str, Any] = {
        "protocol": PROTOCOL,
        "split": split,
        "cars": len(np.unique(lives["car"])),
        "tracks": sorted(map(str, lives["track"].unique())),
        "methods": summarise_lives(lives, blind, oracle, seed),
    }
    record: Mapping[str, Any] = {**provenance(), "life": units[0].protocol, "laps": LAPS, "seed": seed}
    for name, content in ((SUMMARY, summary), (RECORD, record)):
        atomic_write(folder / name, to_json(content) + "\n")
    return {**summary, "folder": folder}
