"""From the names of tables and figures to the units of work that they need."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from outlap.config import validate
from outlap.drivers.find import find_drivers
from outlap.envs.race_config import RaceConfig
from outlap.envs.rewards import RewardConfig
from outlap.errors import OutlapError
from outlap.experiments.definitions import Budget, Circuits, Method, TaskSetConfig, changed, find, merge, names_of
from outlap.experiments.opponent_units import OpponentUnit, PopulationUnit, name_opponents
from outlap.experiments.paper_units import POPULATION, ClippingUnit, RaceUnit, Task, TrainingUnit, adaptation_settings
from outlap.experiments.unit import Unit
from outlap.files import atomic_write, to_json
from outlap.track.catalog import find_entry, load_track
from outlap.training.ppo import PPOConfig
from outlap.training.run import ALGORITHMS

FIGURE_2, APPENDIX, ALL = "figure-2", "appendix", "all"
CLIPPING_TASKS = "tracks"  # the task set whose held-out circuits the clip rules are compared on
CLIPPING_METHOD = "mql-abc"  # whose meta-training they start from
APPENDIX_TASK_SETS = ("opponents", "tracks")  # whose learning curves the appendix shows,
APPENDIX_METHODS = ("vanilla-dr", "mql-abc")  # of these methods
TRAINING_SPEEDS = (2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5, 6.0)  # [m/s] of the paper's opponents
HELD_OUT_SPEEDS = (6.5, 7.0)
# Its authors left a crash's penalty at 1.
PAPER_REWARD = RewardConfig(preset="paper", collision_max=1.0)


@dataclass(frozen=True)
class TablePlan:
    """A table and the races that it is made of."""

    name: str
    task_set: str
    races: tuple[RaceUnit, ...]


@dataclass(frozen=True)
class Plan:
    """What is to be made."""

    budget_name: str
    budget: Budget
    methods: dict[str, Method]
    task_sets: dict[str, TaskSetConfig]
    circuits: dict[str, Circuits]  # that are used, by task set
    tables: tuple[TablePlan, ...]
    clipping: tuple[ClippingUnit, ...]  # of figure 2 and the appendix's histograms
    curves: dict[tuple[str, str], tuple[TrainingUnit, ...]]  # of the appendix, by task set and method
    opponents: tuple[OpponentUnit, ...]  # whose learning the appendix shows

    @property
    def tracks(self) -> list[str]:
        """Names of all tracks that anything is done on."""
        return sorted({name for unit in self.units for name in unit.tracks})

    @property
    def units(self) -> tuple[Unit, ...]:
        """All of them, each once, none before those that it needs."""
        found: dict[str, Unit] = {}

        def add(units: Iterable[Unit]) -> None:
            for unit in units:
                if unit.key not in found:
                    add(unit.needs)
                    found[unit.key] = unit

        trained = (unit for curve in self.curves.values() for unit in curve)
        add((*(race for table in self.tables for race in table.races), *self.clipping, *trained, *self.opponents))
        return tuple(found.values())


def artefacts() -> list[str]:
    """Names of everything that can be made."""
    tables = [name for each in names_of(TaskSetConfig) for name in find(TaskSetConfig, each)[1].tables]
    return [*sorted(tables), FIGURE_2, APPENDIX, ALL]


def make_plan(
    wanted: Sequence[str],
    budget_name: str,
    methods: Sequence[str] = (),
    seeds: int | None = None,
    run_code: bool = False,
) -> Plan:
    """What some tables and figures need.

    Args:
        wanted: names of `artefacts`, or files of task sets, whose tables are all made.
        budget_name: or its file.
        methods: names or files; none: all that come with outlap.
        seeds: in place of the budget's.
        run_code: import modules that a method's file names as its driver, which runs their code.

    Raises OutlapError for a name that is not known, and a definition that is not valid.
    """
    return _Planner(budget_name, methods, seeds, run_code).plan(wanted)


def remember_tracks(names: Iterable[str], work: Path) -> dict[str, str]:
    """Note in a folder of work which tracks it is about, since their names do not say; returns their fingerprints.

    Raises OutlapError for a track that is another one than when work was done there.
    """
    path = work / "tracks.json"
    known: dict[str, str] = json.loads(path.read_text()) if path.exists() else {}
    for name in names:
        fingerprint = load_track(name).fingerprint
        if known.setdefault(name, fingerprint) != fingerprint:
            raise OutlapError(f"{work}: was made with another track called {name}; give another --out, or remove it")
    atomic_write(path, to_json(known) + "\n")
    return known


class _Planner:
    def __init__(self, budget_name: str, methods: Sequence[str], seeds: int | None, run_code: bool) -> None:
        self.budget_name, budget = find(Budget, budget_name)
        self.budget = budget if seeds is None else budget.model_copy(update={"seeds": seeds})
        self.task_sets = dict(find(TaskSetConfig, name) for name in names_of(TaskSetConfig))
        self._trainings: dict[tuple[str, str, int], TrainingUnit] = {}
        # Those that the paper has come first.
        tables = [table for task_set in self.task_sets.values() for table in task_set.tables.values()]
        published = [name for table in tables for name in table.published]
        names = methods or list(dict.fromkeys([*published, *names_of(Method)]))
        self.methods: dict[str, Method] = {}
        for each in names:
            name, method = find(Method, each)
            if name in self.methods or (name != each and name in names_of(Method)):
                raise OutlapError(f"method {each}: another one is called {name}; rename the file")
            self.methods[name] = method
        for name, method in self.methods.items():
            if method.driver is not None:
                find_drivers([method.driver], PPOConfig().env.field_of_view, split=None, run_code=run_code)
            for other in method.against:
                if other not in (*self.methods, *names_of(Method)):
                    raise OutlapError(f"method {name}: is to be compared with {other!r}, and no method is called so")

    def plan(self, wanted: Sequence[str]) -> Plan:
        if not wanted:
            raise OutlapError(f"nothing to make; name some of {', '.join(artefacts())}, or a .yaml")
        files = [name for name in wanted if name.endswith((".yaml", ".yml"))]
        for file in files:
            name, task_set = find(TaskSetConfig, file)
            taken = [table for other in self.task_sets.values() for table in other.tables]
            for known_name in (name, *task_set.tables):
                if known_name in (*self.task_sets, *taken):
                    raise OutlapError(
                        f"{file}: a task set or table is called {known_name} already; give it another name"
                    )
            self.task_sets[name] = task_set
        own = {table for file in files for table in find(TaskSetConfig, file)[1].tables}
        known = [name for task_set in self.task_sets.values() for name in task_set.tables]
        for name in wanted:
            if name not in (*files, *known, FIGURE_2, APPENDIX, ALL):
                raise OutlapError(
                    f"{name!r} is no table or figure; must be one of {', '.join(artefacts())}, or a .yaml"
                )
        everything = ALL in wanted
        tables = [
            self._table(task_set, name)
            for task_set, definition in self.task_sets.items()
            for name in definition.tables
            if everything or name in wanted or name in own
        ]
        appendix = everything or APPENDIX in wanted
        curves = {
            (task_set, name): tuple(
                self._training(task_set, find(Method, name)[1], seed) for seed in range(self.budget.seeds)
            )
            for task_set in APPENDIX_TASK_SETS
            for name in APPENDIX_METHODS
            if appendix
        }
        population = self._population(self._circuits("opponents")) if appendix else None
        return Plan(
            self.budget_name,
            self.budget,
            self.methods,
            self.task_sets,
            {name: self._circuits(name) for name in self.task_sets},
            tuple(sorted(tables, key=lambda table: (not self._published(table), table.name))),
            self._clipping() if appendix or FIGURE_2 in wanted else (),
            curves,
            population.opponents if population else (),
        )

    def _published(self, table: TablePlan) -> bool:
        """Whether the paper has the table: those come first."""
        return bool(self.task_sets[table.task_set].tables[table.name].published)

    def _circuits(self, task_set: str) -> Circuits:
        return self.task_sets[task_set].find_circuits(self.budget.built_in)

    def _table(self, task_set: str, name: str) -> TablePlan:
        definition = self.task_sets[task_set]
        table, circuits = definition.tables[name], self._circuits(task_set)
        tracks = circuits.train if table.circuits == "train" else circuits.held_out
        tasks = tuple(
            Task(" ".join(filter(None, (track, task))), track, _with_track(changes, track))
            for track in tracks
            for task, changes in table.tasks.items()
        )
        if not tasks:
            raise OutlapError(f"table {name}: has no tasks; give the task set {task_set} {table.circuits} circuits")
        for task in tasks:
            find_entry(task.track)
            changed(self._env(task_set), task.changes)
        # As many on every task as make the budget's episodes, or a few more.
        episodes = -(-round(self.budget.episodes * table.share) // len(tasks))
        races = []
        for seed in range(self.budget.seeds):
            for method_name, method in self.methods.items():
                training = self._training(task_set, method, seed) if method.training else None
                adaptation = None
                if method.adaptation is not None:
                    adaptation = {**self.budget.adaptation, **method.adaptation}
                    adaptation_settings(adaptation)  # now, and not an hour later
                races.append(
                    RaceUnit(
                        name=f"{name}-{method_name}-{seed}",
                        method=method_name,
                        task_set=task_set,
                        table=name,
                        seed=seed,
                        env=self._env(task_set),
                        tasks=tasks,
                        episodes=episodes,
                        time_limit=table.time_limit,
                        score=PAPER_REWARD,
                        driver=method.driver,
                        training=training,
                        adaptation=adaptation,
                        population=self._population_of(task_set),
                    )
                )
        return TablePlan(name, task_set, tuple(races))

    def _env(self, task_set: str) -> RaceConfig:
        """The task set's cars and sensors, as every method is tested with them."""
        everywhere = self.budget.training.get("all", {}).get("env", {})
        return changed(PPOConfig().env, everywhere, self.task_sets[task_set].env)

    def _training(self, task_set: str, method: Method, seed: int) -> TrainingUnit:
        """The training of a method, the same unit for all that are trained alike."""
        asked = (task_set, to_json(method.training), seed)
        if asked not in self._trainings:
            self._trainings[asked] = self._make_training(task_set, method, seed)
        return self._trainings[asked]

    def _make_training(self, task_set: str, method: Method, seed: int) -> TrainingUnit:
        algorithm = method.training["algorithm"]
        circuits = self._circuits(task_set)
        cls = training_class(algorithm)
        of_budget = [self.budget.training.get(name, {}) for name in ("all", algorithm)]
        content = merge(
            cls().model_dump(mode="json"),
            *of_budget,
            {"env": {**self.task_sets[task_set].env, "tracks": circuits.train}},
            method.training,
            {"seed": seed, "threads": 1, "held_out_tracks": circuits.held_out},
        )
        config = validate(cls, content, f"training of {method.title} on {task_set}")
        return TrainingUnit(f"{task_set}-{algorithm}-{seed}", config, self._population_of(task_set))

    def _population_of(self, task_set: str) -> PopulationUnit | None:
        """The population that a task set's opponents come from, if it is to be trained."""
        names = self.task_sets[task_set].env.get("opponents", ())
        uses = any(str(name).partition("/")[0] == POPULATION for name in names)
        return self._population(self._circuits(task_set)) if uses else None

    def _population(self, circuits: Circuits) -> PopulationUnit | None:
        from outlap.training.opponents import opponent_defaults

        if self.budget.population is None:
            return None
        track = circuits.train[0]
        base = opponent_defaults()
        content = merge(base.model_dump(mode="json"), self.budget.population, {"threads": 1})
        settings = validate(type(base), content, "population")
        opponents = name_opponents(track, TRAINING_SPEEDS, HELD_OUT_SPEEDS)
        opponents.sort(key=lambda opponent: -opponent.max_speed_mps)  # if any fails its verification, it is a fast one
        units = tuple(
            OpponentUnit(each.name, settings, track, each.max_speed_mps, each.split, self.budget.population_laps)
            for each in opponents
        )
        return PopulationUnit(track, units)

    def _clipping(self) -> tuple[ClippingUnit, ...]:
        """Adaptations, spread over the trainings and the held-out circuits."""
        circuits = self._circuits(CLIPPING_TASKS)
        method = find(Method, CLIPPING_METHOD)[1]
        units = []
        for number in range(self.budget.clipping_seeds):
            seed = number % self.budget.seeds
            track = circuits.held_out[number % len(circuits.held_out)]
            units.append(
                ClippingUnit(
                    name=f"{track}-{number}",
                    task=Task(track, track),
                    seed=seed,
                    adaptation_seed=number,
                    settings=self.budget.adaptation,
                    batches=self.budget.gradient_batches,
                    training=self._training(CLIPPING_TASKS, method, seed),
                )
            )
        return tuple(units)


def training_class(algorithm: str) -> Any:
    """The configuration of an algorithm."""
    if algorithm not in ALGORITHMS:
        raise OutlapError(f"algorithm is {algorithm!r}; must be one of {', '.join(ALGORITHMS)}")
    return ALGORITHMS[algorithm]


def _with_track(changes: Any, track: str) -> Any:
    """Changes whose texts name the track in place of {track}."""
    match changes:
        case str():
            return changes.replace("{track}", track)
        case dict():
            return {key: _with_track(value, track) for key, value in changes.items()}
        case list() | tuple():
            return [_with_track(value, track) for value in changes]
    return changes
