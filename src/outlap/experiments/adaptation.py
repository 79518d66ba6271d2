"""Adapt a meta-trained policy to tracks with several clip rules and seeds, and race it before and after."""

from __future__ import annotations

import hashlib
import re
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from outlap.envs.race_config import RaceConfig
from outlap.evaluation import protocol, rollout
from outlap.evaluation.metrics import summarise_methods
from outlap.evaluation.recorder import record_episodes
from outlap.evaluation.recording import RECORDINGS, SUFFIX
from outlap.evaluation.results import ROWS, UPDATES, prepare_folder, save_results, write_rows
from outlap.experiments.paper_units import adaptation_settings, collecting_env
from outlap.experiments.unit import Report, Unit
from outlap.files import make_folder
from outlap.provenance import provenance
from outlap.track.catalog import load_track
from outlap.training.run import Run, load_meta, load_run

if TYPE_CHECKING:
    from outlap.mql.mql import MQL
    from outlap.mql.policies import MQLPolicy

BEFORE, NO_SEED = "before", -1  # in place of a clip rule, and of an adaptation's seed


@dataclass(frozen=True)
class Races:
    """The races before an adaptation and after it."""

    episodes: int  # on each track
    time_limit: float  # [s]
    seed: int
    recorded: int = 0  # first episodes that are raced again and recorded


@dataclass(frozen=True, eq=False)
class AdaptationUnit(Unit):
    """A policy adapted to a track, unless it is the one before, and its races there: a row an episode."""

    kind = "adaptations"
    packages = ("outlap", "torch", "stable-baselines3")
    run_folder: Path = field(compare=False)
    device: str = field(compare=False)
    policy: str  # SHA-256 of its file
    env: RaceConfig  # of the meta-training
    track: str
    method: str  # a clip rule, or BEFORE
    seed: int  # of the adaptation, or NO_SEED
    settings: Mapping[str, Any]  # what differs from the defaults of an adaptation
    worlds: int  # that collect
    races: Races

    @property
    def tracks(self) -> tuple[str, ...]:
        return (self.track,)

    @property
    def uses_gpu(self) -> bool:
        return self.device.startswith("cuda")

    @property
    def category(self) -> str:
        return f"{self.kind}/{'before' if self.method == BEFORE else 'after'}"

    @property
    def size(self) -> float:
        return self.races.episodes * self.races.time_limit

    def do(self, work: Path, report: Report) -> None:
        from outlap.drivers.policy import PolicyDriver

        folder, track = self.folder(work), load_track(self.track)
        policy = self._policy(folder, report)
        env = protocol.standing_starts(self.env, [track], 0, self.races.time_limit)
        driver = PolicyDriver(policy, scale_observations=env.scale_observations, name=self.method)
        rows = rollout.evaluate(
            driver, env, [track], self.races.episodes, self.races.seed,
            on_progress=lambda now: report(0.5 + 0.5 * now.done / now.total),
        )  # fmt: skip
        if self.races.recorded:
            recordings = folder / RECORDINGS
            record_episodes(driver, env, track, self.races.seed, self.races.recorded, recordings, self.method)
        write_rows(rows.assign(method=self.method, adaptation_seed=self.seed), folder / ROWS)

    def _policy(self, folder: Path, report: Report) -> MQL | MQLPolicy:
        """Return the policy to race; note the updates of its adaptation."""
        from outlap.mql.adaptation import adapt

        meta = _load_meta(self.run_folder, self.device, self.policy)
        if self.method == BEFORE:
            return meta
        settings = adaptation_settings(self.settings)
        env = self.env.model_copy(update={"tracks": (self.track,), "augment_tracks": False})
        progress = min(1.0, meta.num_timesteps / load_run(self.run_folder).config.total_steps)
        adapted, record = adapt(
            meta, collecting_env(env, self.worlds, progress, self.seed), settings, seed=self.seed,
            on_iteration=lambda done, _: report(0.5 * (done + 1) / settings.iterations),
        )  # fmt: skip
        updates = pd.DataFrame(record.updates)
        name = load_track(self.track).name
        write_rows(updates.assign(method=self.method, seed=self.seed, track=name), folder / UPDATES)
        return adapted


@lru_cache(maxsize=1)
def _load_meta(folder: Path, device: str, policy: str) -> MQL:
    """Return the meta-policy with its replay; adaptations leave it as it is."""
    run = load_run(folder)
    return load_meta(replace(run, config=run.config.model_copy(update={"device": device})))


def adaptation_units(
    run: Run,
    tracks: Sequence[str],
    rules: Sequence[str],
    seeds: Sequence[int],
    settings: Mapping[str, Any],
    worlds: int,
    races: Races,
) -> list[AdaptationUnit]:
    """Return the units of an experiment: for each track the races before, then each seed with each clip rule.

    Args:
        run: of the meta-training.
        tracks: names or map folders.
        rules: clip rules, see `mql.propensity.CLIP_RULES`.
        seeds: of the adaptations; only those of the first are recorded.
        settings: what differs from the defaults of an adaptation, but the clip rule.
        worlds: cars that collect transitions.
        races: of every policy.

    Raises OutlapError for a run without a replay, and a wrong setting.
    """
    device = str(load_meta(run).device)  # what is wrong with the run is said now
    policy = hashlib.sha256(run.policy_path.read_bytes()).hexdigest()
    methods = [(BEFORE, NO_SEED), *((rule, seed) for seed in seeds for rule in rules)]
    units = []
    for name in tracks:
        label = re.sub(r"[^\w.-]+", "-", load_track(name).name)
        for method, seed in methods:
            changes = {} if method == BEFORE else {**settings, "clip": method}
            adaptation_settings(changes)
            units.append(
                AdaptationUnit(
                    name=f"{label}-{method}-{seed}" if seed != NO_SEED else f"{label}-{method}",
                    run_folder=run.folder.absolute(),
                    device=device,
                    policy=policy,
                    env=run.config.env,
                    track=name,
                    method=method,
                    seed=seed,
                    settings=changes,
                    worlds=worlds,
                    races=races if seed in (NO_SEED, seeds[0]) else replace(races, recorded=0),
                )
            )
    return units


def prepare_adaptations(folder: Path) -> None:
    """Make the folder of an experiment, unless one was begun there. Raise OutlapError if it holds something else."""
    if not (folder / "work").is_dir():
        prepare_folder(folder)


def write_adaptations(
    units: Sequence[AdaptationUnit], folder: Path, settings: Any, fingerprints: Mapping[str, str]
) -> dict[str, Any]:
    """Collect the results of finished units; return their summary.

    Args:
        units: see `adaptation_units`.
        folder: for the results; `folder/work` holds the units.
        settings: for the record.
        fingerprints: of the tracks, by name, for the record.
    """
    folders = [unit.folder(folder / "work") for unit in units]
    rows = pd.concat([pd.read_parquet(each / ROWS) for each in folders], ignore_index=True)
    updates = [pd.read_parquet(each / UPDATES) for each in folders if (each / UPDATES).is_file()]
    write_rows(pd.concat(updates, ignore_index=True), folder / UPDATES)
    _copy_recordings(units, folder)
    summary = summarise_methods(rows)
    save_results(folder, rows, summary, {**provenance(), "settings": settings, "tracks": fingerprints})
    return summary


def _copy_recordings(units: Sequence[AdaptationUnit], folder: Path) -> None:
    """Copy the recordings of units in place of those of an earlier run, named in the order of each track's units."""
    shutil.rmtree(folder / RECORDINGS, ignore_errors=True)
    numbers: Counter[str] = Counter()
    for unit in units:
        for path in sorted((unit.folder(folder / "work") / RECORDINGS).glob(f"*{SUFFIX}")):
            name = f"{path.stem}-{numbers[unit.track]}-{unit.method}{SUFFIX}"
            shutil.copyfile(path, make_folder(folder / RECORDINGS) / name)
        numbers[unit.track] += 1
