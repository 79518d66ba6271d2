"""Units of work: a folder each, written once and used again by everything that needs it.

A unit's folder is named by a hash of what it is made of, the units that it needs included: whatever changes gets a
new folder, and nothing else is done again. A unit is done when its `done.json` is there.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import pandas as pd

from outlap.drivers.driver import Driver
from outlap.envs.race_config import RaceConfig
from outlap.envs.rewards import RewardConfig
from outlap.errors import OutlapError
from outlap.evaluation.results import ROWS, write_rows
from outlap.experiments.definitions import changed
from outlap.files import atomic_write, to_json
from outlap.training.mql import MQLConfig
from outlap.training.ppo import PPOConfig
from outlap.training.session import TrainingConfig

if TYPE_CHECKING:
    from outlap.mql.adaptation import AdaptationSettings
    from outlap.mql.mql import MQL
    from outlap.training.run import Run

VERSION = 1  # of what units write; another one does everything again
DONE = "done.json"
POPULATION = "population"  # stands for the population that an experiment trained, or the one that comes with outlap
COLLECTING_WORLDS = 8  # cars that collect the transitions of a new task
COLLECTING_SEED = 10_000  # apart from those of races
Report = Callable[[float], None]  # called with the share that is done, now and then


@dataclass(frozen=True, eq=False)
class Unit:
    """A piece of work. Fields say what it is made of; those that are units are what it needs."""

    name: str
    kind: ClassVar[str]

    @cached_property
    def needs(self) -> tuple[Unit, ...]:
        """Units that must be done before."""
        found: list[Unit] = []
        for each in fields(self):
            value = getattr(self, each.name)
            found += [one for one in (value if isinstance(value, tuple) else (value,)) if isinstance(one, Unit)]
        return tuple(found)

    @cached_property
    def key(self) -> str:
        """The hash."""
        made_of: dict[str, Any] = {"version": VERSION, "kind": self.kind, "needs": [unit.key for unit in self.needs]}
        for each in fields(self):
            value = getattr(self, each.name)
            needed = isinstance(value, Unit) or (isinstance(value, tuple) and any(isinstance(v, Unit) for v in value))
            if not needed:
                made_of[each.name] = value
        return hashlib.sha256(to_json(made_of).encode()).hexdigest()[:12]

    @property
    def seconds(self) -> float:
        """About how long it takes on one core."""
        raise NotImplementedError

    def folder(self, work: Path) -> Path:
        """Where it is, in a folder of work."""
        return work / self.kind / f"{self.name}-{self.key}"

    def is_done(self, work: Path) -> bool:
        """Whether nothing is left to do."""
        return (self.folder(work) / DONE).is_file()

    def do(self, work: Path, report: Report) -> None:
        """Do it, or go on with it, in its folder. Raises KeyboardInterrupt where `report` does, its work saved."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class OpponentUnit(Unit):
    """One opponent, trained and verified."""

    kind = "opponents"
    settings: TrainingConfig
    track: str
    max_speed_mps: float
    split: str
    laps: int
    starts: int = 20

    @property
    def seconds(self) -> float:
        return 5.0 + self.settings.total_steps / 11_000

    def do(self, work: Path, report: Report) -> None:
        from outlap.track.track import Track
        from outlap.training.population import Opponent, Plan, train_opponent

        track = Track.load(self.track)
        opponent = Opponent(self.name, self.max_speed_mps, self.split)  # type: ignore[arg-type]
        plan = Plan(
            self.settings,  # type: ignore[arg-type]
            self.folder(work), track, self.track, [opponent], self.laps, self.starts, command="outlap reproduce",
        )  # fmt: skip
        total = self.settings.total_steps
        rows = train_opponent(plan, opponent, lambda steps: report(0.95 * steps / total))
        write_rows(rows, self.folder(work) / ROWS)


@dataclass(frozen=True, eq=False)
class PopulationUnit(Unit):
    """The opponents that passed their verification, as a population."""

    kind = "populations"
    opponents: tuple[OpponentUnit, ...]

    @property
    def seconds(self) -> float:
        return 1.0

    def do(self, work: Path, report: Report) -> None:
        from outlap.drivers.population import file_names
        from outlap.training.population import Opponent, enter

        folder = self.folder(work)
        passed: list[OpponentUnit] = []
        for unit in self.opponents:
            source = unit.folder(work)
            rows = pd.read_parquet(source / ROWS)
            folder.mkdir(parents=True, exist_ok=True)
            for file in file_names(unit.name):
                shutil.copyfile(source / file, folder / file)
            opponent = Opponent(unit.name, unit.max_speed_mps, unit.split)  # type: ignore[arg-type]
            if enter(folder, opponent, rows, unit.track, unit.laps, "outlap reproduce"):
                passed.append(unit)
        failed = [unit.name for unit in self.opponents if unit not in passed]
        atomic_write(folder / "failed.json", to_json(failed))
        held_out = [unit.name for unit in self.opponents if unit.split == "held_out" and unit not in passed]
        if held_out or all(unit.split == "held_out" for unit in passed):
            raise OutlapError(
                f"opponents {', '.join(failed)}: did not complete {self.opponents[0].laps} laps from every start; "
                "give the budget's population more total_steps"
            )


@dataclass(frozen=True, eq=False)
class TrainingUnit(Unit):
    """One policy; its folder is a run folder."""

    kind = "trainings"
    config: TrainingConfig
    population: PopulationUnit | None = None

    @property
    def seconds(self) -> float:
        config = self.config
        rate = {"ppo": 11_000, "recurrent-ppo": 3_500}.get(config.algorithm, 30_000)  # actions a second
        beams = (1.0 + config.env.beams / 540) * (1.5 if config.env.num_cars > 1 else 1.0)
        seconds = config.total_steps / rate * beams / 1.2
        if isinstance(config, MQLConfig):
            updates = config.total_steps / config.num_envs * config.updates_per_step * config.batch_size / 256
            each = {"fast": 0.027, "paper": 0.12}[config.preset] * (1.0 if config.uses_context else 0.65)
            seconds += updates * each
        elif isinstance(config, PPOConfig):  # many small batches cost more than few large ones
            seconds += config.total_steps / config.batch_size * config.n_epochs * 0.003
        return 2.0 + seconds

    def do(self, work: Path, report: Report) -> None:
        from outlap.training.run import load_run
        from outlap.training.session import train

        folder = self.folder(work)
        begun = load_run(folder) if (folder / "config.yaml").is_file() else None
        config = begun.config if begun else self.config.model_copy(update={"env": self.resolved(work)})
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
    def seconds(self) -> float:
        steps = len(self.tasks) * self.episodes * self.time_limit / 0.04
        each = 0.4
        if self.adaptation is not None:
            settings = adaptation_settings(self.adaptation)
            each += 0.5 + _seconds_of_adaptation(settings) + 0.004 * settings.iterations * settings.collect_steps
        return 1.0 + steps / 8_000 * (1.5 if self.env.num_cars > 1 else 1.0) + each * len(self.tasks)

    def do(self, work: Path, report: Report) -> None:
        from outlap.evaluation.rollout import EvaluationProgress, evaluate, standing_starts
        from outlap.track.track import Track

        meta = load_meta(self.training, work) if self.adaptation is not None and self.training else None
        rows = []
        for number, task in enumerate(self.tasks):
            track = Track.load(task.track)
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
    def seconds(self) -> float:
        return 5.0 + 3 * _seconds_of_adaptation(adaptation_settings({"clip": "abc", **self.settings}))

    def do(self, work: Path, report: Report) -> None:
        from outlap.experiments.clipping import compare_rules
        from outlap.mql.adaptation import collect

        meta = load_meta(self.training, work)
        base = adaptation_settings({"clip": "abc", **self.settings})
        task = collecting(self.training, self.task, work, self.adaptation_seed)
        new = collect(meta, task, base, seed=self.adaptation_seed)
        found = compare_rules(meta, new, base, self.adaptation_seed, self.batches, report)
        facts = {"seed": self.seed, "adaptation_seed": self.adaptation_seed, "task": self.task.name}
        for name, rows in found.items():
            write_rows(rows.assign(**facts), self.folder(work) / f"{name}.parquet")


def _seconds_of_adaptation(settings: AdaptationSettings) -> float:
    """About how long its updates take."""
    updates = settings.iterations * (settings.on_task_steps + settings.replay_steps)
    return 0.025 * updates * settings.batch_size / 256


def load_meta(unit: TrainingUnit, work: Path) -> MQL:
    """A meta-trained policy with its replay."""
    from outlap.mql.mql import MQL

    run = unit.run(work)
    meta = MQL.load(run.policy_path, device=run.config.device)
    meta.load_replay_buffer(run.replay_path)
    return meta


def collecting(unit: TrainingUnit, task: Task, work: Path, seed: int):
    """The environment that an adaptation collects from: as in training, but for the task."""
    from outlap.envs.sb3_vec_env import SB3VecEnv

    env = changed(unit.config.env, task.changes, {"tracks": [task.track], "augment_tracks": False})
    worlds = SB3VecEnv(COLLECTING_WORLDS, **dict(resolve(env, unit.population, work)))
    worlds.env.training_steps = unit.config.total_steps  # curricula go on where training ended
    worlds.seed(COLLECTING_SEED + seed)
    return worlds


def adaptation_settings(changes: Mapping[str, Any]) -> AdaptationSettings:
    """Settings from a method's and a budget's changes. Raises OutlapError for a field that is not known."""
    from outlap.mql.adaptation import AdaptationSettings
    from outlap.mql.propensity import CLIP_RULES

    base = AdaptationSettings()
    constants = {each.name: getattr(base, each.name) for each in fields(base) if each.name != "clip"}
    wanted = dict(changes)
    clip = wanted.pop("clip", {"rule": "abc"})
    rule = dict(clip) if isinstance(clip, Mapping) else {"rule": clip}
    name = rule.pop("rule", None)
    if name not in CLIP_RULES:
        raise OutlapError(
            f"adaptation: clip is {clip!r}; must be, or have a rule that is, one of {', '.join(CLIP_RULES)}"
        )
    clipping = CLIP_RULES[name]()
    of_rule = {each.name: getattr(clipping, each.name) for each in fields(clipping)}
    _check_numbers("adaptation", wanted, constants)
    _check_numbers(f"adaptation: clip {name}", rule, of_rule)
    return replace(base, **wanted, clip=replace(clipping, **rule))


def _check_numbers(where: str, changes: Mapping[str, Any], defaults: Mapping[str, Any]) -> None:
    """Raises OutlapError for a field that is not known, or not a number of its default's kind."""
    for name, value in changes.items():
        if name not in defaults:
            known = ", ".join(defaults) or "none"
            raise OutlapError(f"{where}: {name} is not a known field; the fields are {known}")
        whole = isinstance(defaults[name], int)
        if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)) or value < 0:
            kind = "a whole number" if whole else "a number"
            raise OutlapError(f"{where}: {name} is {value!r}; must be {kind}, 0 or more")


def done_record(unit: Unit, work: Path) -> dict[str, Any]:
    """What was noted when a unit was done."""
    return json.loads((unit.folder(work) / DONE).read_text())
