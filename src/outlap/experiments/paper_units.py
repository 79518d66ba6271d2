"""The units of work that tables and figures are made of: trainings, races, comparisons of clip rules."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from outlap.config import save_config, validate
from outlap.drivers.driver import Driver
from outlap.envs.race_config import RaceConfig
from outlap.envs.rewards import RewardConfig
from outlap.evaluation.results import ROWS, write_rows
from outlap.experiments.definitions import changed
from outlap.experiments.opponent_units import PopulationUnit
from outlap.experiments.unit import Report, Unit
from outlap.mql.config import AdaptationConfig
from outlap.training.config import TrainingConfig
from outlap.training.run import load_meta

if TYPE_CHECKING:
    from outlap.envs.sb3_vec_env import SB3VecEnv
    from outlap.mql.mql import MQL
    from outlap.training.run import Run

POPULATION = "population"  # stands for the population that an experiment trained, or the one that comes with outlap
COLLECTING_WORLDS = 8  # cars that collect the transitions of a new task
COLLECTING_SEED = 10_000  # apart from those of races


@dataclass(frozen=True, eq=False)
class TrainingUnit(Unit):
    """One policy; its folder is a run folder."""

    kind = "trainings"
    config: TrainingConfig
    population: PopulationUnit | None = None

    @property
    def tracks(self) -> tuple[str, ...]:
        return self.config.env.tracks

    @property
    def uses_gpu(self) -> bool:
        return self.config.device.startswith("cuda")

    @property
    def category(self) -> str:
        return f"{self.kind}/{self.config.algorithm}"

    @property
    def size(self) -> float:
        return self.config.total_steps

    def do(self, work: Path, report: Report) -> None:
        from outlap.training.run import load_run
        from outlap.training.session import train

        folder, begun = self.folder(work), None
        config = self.config.model_copy(update={"env": self.resolved(work)})
        if (folder / "config.yaml").is_file():
            save_config(config, folder / "config.yaml")  # the opponents may be elsewhere on this machine
            begun = load_run(folder)
        train(config, folder, resume=begun, on_progress=lambda progress: report(progress.steps / progress.total_steps))

    def resolved(self, work: Path) -> RaceConfig:
        """The environment, with the opponents where they are."""
        return resolve(self.config.env, self.population, work)

    def run(self, work: Path) -> Run:
        """The run, once it is done."""
        from outlap.training.run import load_run

        return load_run(self.folder(work))


def resolve(env: RaceConfig, population: PopulationUnit | None, work: Path) -> RaceConfig:
    """An environment whose opponents are those of an experiment."""
    if population is None:
        return env
    folder = str(population.folder(work).absolute())
    opponents = tuple(
        folder + name.removeprefix(POPULATION) if name.partition("/")[0] == POPULATION else name
        for name in env.opponents
    )
    return env.model_copy(update={"opponents": opponents})


@dataclass(frozen=True)
class Task:
    """What a policy is tested on: a circuit, and what differs from the training's environment there."""

    name: str
    track: str
    changes: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RaceUnit(Unit):
    """A method raced on the tasks of a table, adapted to each of them if it adapts: rows, one an episode."""

    kind = "races"
    method: str
    task_set: str
    table: str
    seed: int
    env: RaceConfig  # of the task set; a method's observation takes the place of its own
    tasks: tuple[Task, ...]
    episodes: int  # on every task
    time_limit: float
    score: RewardConfig  # that rewards and returns are told in, whatever a method was trained with
    driver: str | None = None
    training: TrainingUnit | None = None
    adaptation: Mapping[str, Any] | None = None
    population: PopulationUnit | None = None

    @property
    def tracks(self) -> tuple[str, ...]:
        return tuple(task.track for task in self.tasks)

    @property
    def uses_gpu(self) -> bool:
        return self.adaptation is not None and self.training is not None and self.training.uses_gpu

    @property
    def category(self) -> str:
        return f"{self.kind}/{'adapted' if self.adaptation is not None else 'not adapted'}"

    @property
    def size(self) -> float:
        return len(self.tasks) * self.episodes * self.time_limit

    def do(self, work: Path, report: Report) -> None:
        from outlap.evaluation.protocol import standing_starts
        from outlap.evaluation.rollout import EvaluationProgress, evaluate
        from outlap.track.catalog import load_track

        meta = load_meta(self.training.run(work)) if self.adaptation is not None and self.training else None
        rows = []
        for number, task in enumerate(self.tasks):
            track = load_track(task.track)
            env = resolve(changed(self.env, task.changes), self.population, work)
            env = env.model_copy(update={"reward": self.score})
            races = standing_starts(env, [track], laps=0, time_limit=self.time_limit)

            def progress(now: EvaluationProgress, number: int = number) -> None:
                share = 0.5 + 0.5 * now.done / now.total
                report((number + share) / len(self.tasks))

            driver = self._driver(
                work, meta, task, lambda share, number=number: report((number + 0.5 * share) / len(self.tasks))
            )
            raced = evaluate(driver, races, [track], self.episodes, self.seed, on_progress=progress)
            rows.append(raced.assign(driver=self.method, task=task.name))
        everything = pd.concat(rows, ignore_index=True)
        facts = {"method": self.method, "task_set": self.task_set, "table": self.table, "training_seed": self.seed}
        write_rows(everything.assign(**facts), self.folder(work) / ROWS)

    def _driver(self, work: Path, meta: MQL | None, task: Task, report: Report) -> Driver:
        """What drives on a task."""
        from outlap.drivers.find import find_drivers
        from outlap.drivers.policy import PolicyDriver
        from outlap.mql.adaptation import adapt

        if self.training is None:
            assert self.driver is not None
            return find_drivers([self.driver], self.env.field_of_view, split=None, run_code=True)[0]
        if meta is None or self.adaptation is None:
            return self.training.run(work).driver()
        settings = adaptation_settings(self.adaptation)
        adapted, _ = adapt(
            meta, collecting(self.training, task, work, self.seed), settings, seed=self.seed,
            on_iteration=lambda done, _: report((done + 1) / settings.iterations),
        )  # fmt: skip
        trained = self.training.config.env
        return PolicyDriver(adapted, scale_observations=trained.scale_observations, reward=trained.reward)


@dataclass(frozen=True, eq=False)
class ClippingUnit(Unit):
    """What clip rules do to the weights and the losses of an adaptation: same transitions, same batches for all."""

    kind = "clipping"
    task: Task
    seed: int  # of the training
    adaptation_seed: int
    settings: Mapping[str, Any]
    batches: int  # for the variance of the gradient
    training: TrainingUnit

    @property
    def tracks(self) -> tuple[str, ...]:
        return (self.task.track,)

    @property
    def uses_gpu(self) -> bool:
        return self.training.uses_gpu

    def do(self, work: Path, report: Report) -> None:
        from outlap.experiments.clipping import compare_rules
        from outlap.mql.adaptation import collect

        meta = load_meta(self.training.run(work))
        base = adaptation_settings({"clip": "abc", **self.settings})
        task = collecting(self.training, self.task, work, self.adaptation_seed)
        new = collect(meta, task, base, seed=self.adaptation_seed)
        found = compare_rules(meta, new, base, self.adaptation_seed, self.batches, report)
        facts = {"seed": self.seed, "adaptation_seed": self.adaptation_seed, "task": self.task.name}
        for name, rows in found.items():
            write_rows(rows.assign(**facts), self.folder(work) / f"{name}.parquet")


def collecting(unit: TrainingUnit, task: Task, work: Path, seed: int) -> SB3VecEnv:
    """Return the environment that an adaptation collects from: as in training, but for the task."""
    env = changed(unit.config.env, task.changes, {"tracks": [task.track], "augment_tracks": False})
    return collecting_env(resolve(env, unit.population, work), COLLECTING_WORLDS, 1.0, seed)


def collecting_env(env: RaceConfig, worlds: int, training_progress: float, seed: int) -> SB3VecEnv:
    """Return an environment to collect from, whose curricula are where the training ended, 0 … 1."""
    from outlap.envs.race_vector_env import RaceVectorEnv
    from outlap.envs.sb3_vec_env import SB3VecEnv

    collecting = SB3VecEnv(RaceVectorEnv(worlds, env))
    collecting.env.training_progress = training_progress
    collecting.seed(COLLECTING_SEED + seed)
    return collecting


def adaptation_settings(changes: Mapping[str, Any]) -> AdaptationConfig:
    """Return the constants with a method's and a budget's changes. Raises OutlapError for a wrong one."""
    return validate(AdaptationConfig, changes, "adaptation")
