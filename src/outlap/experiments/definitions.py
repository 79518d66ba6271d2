"""What an experiment is made of: methods, task sets and budgets, a small YAML file each, found by name.

`methods/mql-abc.yaml` is the method `mql-abc`. A file of one's own is named by its path instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

from pydantic import Field, model_validator

from outlap.config import Config, load_config, validate
from outlap.envs.race_config import RaceConfig
from outlap.errors import OutlapError
from outlap.mql.propensity import CLIP_RULES
from outlap.track.catalog import list_tracks, name_key

HERE = Path(__file__).parent
# What of an environment belongs to a method; the rest is the task's, and the same for all.
METHODS_OWN = ("observation", "scale_observations", "reward", "augment_tracks", "termination")


class Method(Config):
    """How a driver comes about: it is there already, or it is trained, and may adapt to each task."""

    title: str
    driver: str | None = None  # that needs no training, see `drivers.find`
    training: dict[str, Any] = Field(default={})  # `algorithm`, and what differs from its defaults
    # Of MQL: `clip`, a rule's name or {rule: abc, k: 2.0}, and what differs from the budget's.
    adaptation: dict[str, Any] | None = None
    against: tuple[str, ...] = ()  # methods that a report compares it with

    @model_validator(mode="after")
    def _is_one_of_both(self) -> Self:
        if (self.driver is None) == (not self.training):
            raise ValueError("must have either a driver or a training")
        if self.training and "algorithm" not in self.training:
            raise ValueError("training must name an algorithm")
        if self.adaptation is not None:
            if self.training.get("algorithm") != "mql":
                raise ValueError("adaptation is of algorithm mql alone; leave it out, or train with it")
            if "clip" not in self.adaptation:
                raise ValueError(f"adaptation must have a clip, one of {', '.join(CLIP_RULES)}")
        for name in self.training.get("env", {}):
            if name not in METHODS_OWN:
                own = ", ".join(METHODS_OWN)
                raise ValueError(f"training may not change env.{name}, which is the task set's; it may change {own}")
        return self


class Circuits(Config):
    """Tracks by name."""

    title: str
    train: tuple[str, ...] = Field(min_length=1)
    held_out: tuple[str, ...] = ()


class Published(Config):
    """What a paper reports of a method: a number, or (mean, standard deviation)."""

    overtakes: float | None = None
    crashes: float | None = None
    episode_length: tuple[float, float] | None = None
    reward: tuple[float, float] | None = None


class Table(Config):
    """On which tasks methods are raced, and for how long."""

    title: str
    circuits: Literal["train", "held_out"]  # those of the task set
    tasks: dict[str, dict[str, Any]] = Field(
        default={"": {}}
    )  # on each circuit: what differs from the training's environment
    time_limit: float = Field(default=5.0, gt=0)  # [s] of an episode
    share: float = Field(default=1.0, gt=0)  # of the budget's episodes
    published: dict[str, Published] = Field(default={})  # by method


class TaskSetConfig(Config):
    """What is trained on, and the tables of what is tested."""

    title: str
    circuits: tuple[Circuits, ...] = Field(min_length=1)  # the first whose tracks are all there, else the last
    env: dict[str, Any] = Field(default={})  # of training: what differs from the algorithm's own environment
    tables: dict[str, Table] = Field(min_length=1)

    def find_circuits(self, built_in: bool) -> Circuits:
        """The circuits to use here: those that a budget forces, or the first that can be found."""
        if built_in:
            return self.circuits[-1]
        there = {name_key(entry.name) for entry in list_tracks()}
        whole = (each for each in self.circuits if {*map(name_key, (*each.train, *each.held_out))} <= there)
        return next(whole, self.circuits[-1])


class Budget(Config):
    """How much of everything."""

    title: str
    built_in: bool = False  # take the last circuits of every task set, which come with outlap
    seeds: int = Field(ge=1)  # trainings of every method
    episodes: int = Field(ge=1)  # of a table, method and seed, all tasks together
    training: dict[str, dict[str, Any]] = Field(
        default={}
    )  # by algorithm, `all` for each: what differs from the defaults
    population: dict[str, Any] | None = None  # of the opponents' trainings; none: the population of outlap is used
    population_laps: int = Field(default=5, ge=1)  # that an opponent must complete from every start
    adaptation: dict[str, Any] = Field(default={})  # what differs from `AdaptationConfig`
    clipping_seeds: int = Field(default=10, ge=1)  # adaptations that clip rules are compared on
    gradient_batches: int = Field(default=32, ge=2)  # over which the variance of the gradient is taken


DefinitionT = TypeVar("DefinitionT", Method, TaskSetConfig, Budget)
FOLDERS: dict[type[Config], Path] = {
    Method: HERE / "methods",
    TaskSetConfig: HERE / "task_sets",
    Budget: HERE / "budgets",
}


def names_of(kind: type[Config]) -> list[str]:
    """Those that come with outlap."""
    return sorted(path.stem for path in FOLDERS[kind].glob("*.yaml"))


def find(kind: type[DefinitionT], name: str) -> tuple[str, DefinitionT]:
    """A definition by its name or the path of its file, and the name that results have it under.

    Raises OutlapError where there is none, or it is not valid.
    """
    path = Path(name)
    if path.suffix in (".yaml", ".yml"):
        return path.stem, load_config(kind, path)
    packaged = FOLDERS[kind] / f"{name}.yaml"
    if not packaged.is_file():
        known = ", ".join(names_of(kind))
        what = FOLDERS[kind].name.removesuffix("s").replace("_", " ")
        raise OutlapError(f"{what} is {name!r}; must be a .yaml file, or one of {known}")
    return name, load_config(kind, packaged)


def merge(base: Mapping[str, Any], *changes: Mapping[str, Any]) -> dict[str, Any]:
    """A mapping with changes, those of mappings inside it merged likewise; later ones win."""
    merged = dict(base)
    for each in changes:
        for key, value in each.items():
            inside = merged.get(key)
            merged[key] = merge(inside, value) if isinstance(inside, Mapping) and isinstance(value, Mapping) else value
    return merged


def changed(env: RaceConfig, *changes: Mapping[str, Any]) -> RaceConfig:
    """An environment with changes. Raises OutlapError that names a field which is wrong."""
    return validate(RaceConfig, merge(env.model_dump(mode="json"), *changes), "env")
