"""Search for hyper-parameters with Optuna; trials are trained and raced as units of work, and may be stopped early."""

from __future__ import annotations

import hashlib
import itertools
import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from outlap.config import save_config
from outlap.envs.terminations import CRASH
from outlap.errors import OutlapError
from outlap.evaluation.results import ROWS
from outlap.experiments.engine import SECONDS
from outlap.experiments.paper_units import RaceUnit, Task, TrainingUnit
from outlap.experiments.plan import PAPER_REWARD
from outlap.experiments.search import Range, SearchConfig
from outlap.experiments.unit import DONE, Report, Unit
from outlap.files import atomic_write, make_folder, to_json
from outlap.track.generate import BUILTIN_TRAIN
from outlap.training.checkpoints import TrainingDiverged
from outlap.training.config import TrainingConfig
from outlap.training.run import Run, load_run
from outlap.training.session import Progress, train

if TYPE_CHECKING:
    from optuna import Study
    from optuna.trial import Trial as OptunaTrial

DIVERGED = "diverged.txt"  # in the folder of a training that diverged, with the reason


class _RungReached(KeyboardInterrupt):
    """Stops a training with a checkpoint, as Ctrl-C does."""


@dataclass(frozen=True, eq=False)
class RungUnit(TrainingUnit):
    """A training up to some of its steps, from where the rung before ended."""

    kind = "rungs"
    steps: int = 0
    previous: RungUnit | None = None

    @property
    def size(self) -> float:
        return self.steps - self.first_step

    @property
    def first_step(self) -> int:
        """Steps of the rung before."""
        return self.previous.steps if self.previous else 0

    def diverged(self, work: Path) -> bool:
        """Return whether the training diverged, which ends the trial."""
        return (self.folder(work) / DIVERGED).is_file()

    def do(self, work: Path, report: Report) -> None:
        folder = self.folder(work)
        begun = self._begun(folder, work)

        def on_progress(progress: Progress) -> None:
            report(min(1.0, max(0.0, (progress.steps - self.first_step) / self.size)))
            if self.steps <= progress.steps < progress.total_steps:
                raise _RungReached

        try:
            if begun is None or not self._is_reached(begun):
                train(self.config, folder, resume=begun, on_progress=on_progress)
        except _RungReached:
            pass
        except TrainingDiverged as error:
            atomic_write(folder / DIVERGED, f"{error}\n")

    def _begun(self, folder: Path, work: Path) -> Run | None:
        """Return the run to continue: that of this unit, or a copy of that of the rung before."""
        if not (folder / "config.yaml").is_file():
            if self.previous is None:
                return None
            unfinished = shutil.ignore_patterns(".*", DONE, SECONDS, "config.yaml")
            shutil.copytree(self.previous.folder(work), folder, ignore=unfinished, dirs_exist_ok=True)
            save_config(self.config, folder / "config.yaml")  # last: it marks a whole run
        return load_run(folder)

    def _is_reached(self, run: Run) -> bool:
        steps = [int(path.stem.removeprefix("step_")) for path in run.checkpoints()]
        return self.steps < self.config.total_steps and max(steps, default=0) >= self.steps


@dataclass
class Trial:
    """Values to train with, and how far their trainings have come."""

    number: int
    values: Mapping[str, Any]
    rungs: tuple[tuple[RungUnit, ...], ...]  # of each rung, one unit a seed
    races: tuple[tuple[RaceUnit, ...], ...]  # likewise
    rung: int = 0  # the present one
    is_open: bool = True

    @property
    def stopped_early(self) -> bool:
        """Whether it was closed before its last rung."""
        return not self.is_open and self.rung < len(self.rungs) - 1


class Tuner:
    """A search. Optuna draws trials and stops those that fall behind; it keeps them in `study.db`.

    Args:
        config: what is varied.
        folder: of the search; units are in `folder/work`.
        parallel: trials that are open at a time, if values depend on results (tpe).

    Raises OutlapError if Optuna is not installed, or a trial is not valid.
    """

    def __init__(self, config: SearchConfig, folder: Path, parallel: int = 1) -> None:
        self.config, self.work = config, folder / "work"
        self._parallel = parallel if config.sampler == "tpe" else math.inf
        self._combinations = None if config.trials else _combinations(config)
        self._total = config.trials or len(self._combinations or ())
        self._study = _open_study(config, make_folder(folder))
        self._finished: set[str] = set()  # keys
        self._failed: set[str] = set()  # likewise, in this session
        drawn = [known for known in self._study.trials if known.state.name != "WAITING"]
        self.trials = [self._trial(self._live(known.number)) for known in drawn]
        for trial, known in zip(self.trials, drawn, strict=True):
            trial.is_open = not known.state.is_finished()
            if not trial.is_open:  # Optuna has a value of each rung that it compared
                last = len(trial.rungs) - 1
                trial.rung = last if known.state.name == "COMPLETE" else max(0, len(known.intermediate_values) - 1)

    def first_units(self) -> list[Unit]:
        """Return the units to begin or resume with."""
        known = [unit for trial in self.trials for unit in self._units(trial)]
        return [*known, *self._draw()]

    def on_done(self, unit: Unit) -> list[Unit]:
        """Return the units that follow from a finished one, see `run_units`."""
        self._finished.add(unit.key)
        return self._follow(unit)

    def on_failed(self, unit: Unit) -> list[Unit]:
        """Close the trials of a unit that failed, and return the units to do in their place, see `run_units`.

        Optuna keeps these trials as running, so that the next session of the search tries them again.
        """
        self._failed.add(unit.key)
        return self._follow(unit)

    def _follow(self, unit: Unit) -> list[Unit]:
        """Advance the trials of a unit that has ended; return the units to do next."""
        found: list[Unit] = []
        for trial in list(self.trials):
            present = (*trial.rungs[trial.rung], *trial.races[trial.rung])
            if any(unit.key == each.key for each in present):
                found += self._advance(trial) if trial.is_open else self._units(trial)
        return [*found, *self._draw()]

    def results(self) -> pd.DataFrame:
        """Return a row for each trial, the best first; those that were stopped early come after the others.

        Columns: trial, every varied field, progress_m (mean over seeds and episodes), progress_low_m and
        progress_high_m (the worst and the best seed), crash_rate, mean_speed_mps, steps, stopped_early. A trial that
        diverged has NaN.
        """
        rows = []
        for trial in self.trials:
            result = {"trial": trial.number, **trial.values}
            if not any(rung.diverged(self.work) for rung in trial.rungs[trial.rung]):
                result |= _judge([race.folder(self.work) for race in trial.races[trial.rung]])
            steps = trial.rungs[trial.rung][0].steps
            rows.append({**result, "steps": steps, "stopped_early": trial.stopped_early})
        found = pd.DataFrame(rows)
        if "progress_m" not in found:
            raise OutlapError(f"{self.work}: the trainings of all trials diverged; lower learning_rate")
        order = ["stopped_early", "progress_m"]
        return found.sort_values(order, ascending=[True, False], kind="stable", ignore_index=True)

    def _draw(self) -> list[Unit]:
        """Draw trials, as many as may be open now; return their first units."""
        units: list[Unit] = []
        while len(self.trials) < self._total and sum(trial.is_open for trial in self.trials) < self._parallel:
            if self._combinations is not None and len(self._study.trials) == len(self.trials):
                self._study.enqueue_trial(self._combinations[len(self.trials)])
            self.trials.append(self._trial(self._study.ask()))
            units += self._advance(self.trials[-1])  # values that repeat have finished units
        return units

    def _trial(self, drawn: OptunaTrial) -> Trial:
        values = {name: _suggest(drawn, name, each) for name, each in self.config.search.items()}
        configs = [self.config.trial_config(values, seed) for seed in range(self.config.seeds)]
        # Named by its content, not its number: a file with other values before it reuses the unit.
        name = f"trial-{hashlib.sha256(to_json(configs[0]).encode()).hexdigest()[:8]}"
        by_seed = [_rungs(f"{name}-{seed}", config, self.config.rungs) for seed, config in enumerate(configs)]
        rungs = tuple(zip(*by_seed, strict=True))
        races = tuple(tuple(self._race(name, *each) for each in enumerate(rung)) for rung in rungs)
        return Trial(drawn.number, values, rungs, races)

    def _race(self, trial: str, seed: int, rung: RungUnit) -> RaceUnit:
        tracks = self.config.tracks or rung.config.env.tracks or BUILTIN_TRAIN
        return RaceUnit(
            name=rung.name,
            method=trial,
            task_set="tune",
            table="tune",
            seed=seed,
            env=rung.config.env,
            tasks=tuple(Task(track, track) for track in tracks),
            episodes=-(-self.config.episodes // len(tracks)),
            time_limit=self.config.time_limit,
            score=PAPER_REWARD,
            training=rung,
        )

    def _units(self, trial: Trial) -> list[Unit]:
        """Return the units of a trial that can begin: trainings to its present rung, and races of those that ended."""
        known: list[Unit] = [unit for rung in trial.rungs[: trial.rung + 1] for unit in rung]
        for rung, race in zip(trial.rungs[trial.rung], trial.races[trial.rung], strict=True):
            if rung.key in self._finished and not rung.diverged(self.work):
                known.append(race)
        return known

    def _advance(self, trial: Trial) -> list[Unit]:
        """Close a trial, or return the units to do next for it."""
        from optuna.trial import TrialState

        if any(rung.diverged(self.work) for rung in trial.rungs[trial.rung]):
            self._study.tell(trial.number, state=TrialState.FAIL)
            trial.is_open = False
            return []
        races = trial.races[trial.rung]
        if any(each.key in self._failed for each in (*trial.rungs[trial.rung], *races)):
            trial.is_open = False
            return []
        if not all(race.key in self._finished for race in races):
            return self._units(trial)
        score = _judge([race.folder(self.work) for race in races])["progress_m"]
        live, step = self._live(trial.number), self.config.reduction_factor**trial.rung  # the pruner's rungs
        if trial.rung == len(trial.rungs) - 1:
            self._study.tell(trial.number, score)
            trial.is_open = False
            return []
        if step not in self._study.trials[trial.number].intermediate_values:
            live.report(score, step)
        if live.should_prune():
            self._study.tell(trial.number, state=TrialState.PRUNED)
            trial.is_open = False
            return []
        trial.rung += 1
        return self._advance(trial)

    def _live(self, number: int) -> OptunaTrial:
        """Return a trial that values can be drawn for, from an earlier session as well."""
        from optuna.trial import Trial as OptunaTrial

        return OptunaTrial(self._study, self._study.trials[number]._trial_id)


def _open_study(config: SearchConfig, folder: Path) -> Study:
    """Return the study of a search, from an earlier session if there was one."""
    try:
        import optuna
    except ImportError:
        raise OutlapError("Optuna is not installed; get it with pip install 'outlap[tune]'") from None
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    content = to_json(config.model_copy(update={"trials": 0}))  # more trials continue a search
    study = optuna.create_study(
        storage=f"sqlite:///{folder.absolute()}/study.db",
        study_name=hashlib.sha256(content.encode()).hexdigest()[:12],
        direction="maximize",
        pruner=optuna.pruners.SuccessiveHalvingPruner(min_resource=1, reduction_factor=config.reduction_factor),
        load_if_exists=True,
    )
    seed = int(np.random.SeedSequence([config.seed, len(study.trials)]).generate_state(1)[0])
    samplers = optuna.samplers
    study.sampler = samplers.TPESampler(seed=seed) if config.sampler == "tpe" else samplers.RandomSampler(seed=seed)
    return study


def _combinations(config: SearchConfig) -> list[dict[str, Any]]:
    """Return the numbers of the values of every combination. Raise OutlapError for a range."""
    counts = {}
    for name, each in config.search.items():
        if isinstance(each, Range):
            raise OutlapError(f"search.{name} is a range, of which trials are drawn; say how many by trials")
        counts[name] = len(each)
    return [dict(zip(counts, each, strict=True)) for each in itertools.product(*map(range, counts.values()))]


def _suggest(trial: OptunaTrial, name: str, values: Sequence[Any] | Range) -> Any:
    """Draw a value, or return the one that was drawn before."""
    if not isinstance(values, Range):
        return values[trial.suggest_categorical(name, range(len(values)))]
    match values.distribution:
        case "integer":
            return trial.suggest_int(name, int(values.low), int(values.high))
        case _:
            return trial.suggest_float(name, values.low, values.high, log=values.distribution == "log_uniform")


def _rungs(name: str, config: TrainingConfig, shares: Sequence[float]) -> list[RungUnit]:
    """Return the units of a training, each up to a share of its steps."""
    units: list[RungUnit] = []
    for share in (*shares, 1.0):
        steps = math.ceil(share * config.total_steps)
        units.append(RungUnit(f"{name}-{steps}", config, steps=steps, previous=units[-1] if units else None))
    return units


def _judge(folders: Sequence[Path]) -> dict[str, float]:
    """Return what the races of a trial say, one folder a seed."""
    raced = [pd.read_parquet(folder / ROWS) for folder in folders]
    progress = np.array([rows["progress_m"].to_numpy().mean() for rows in raced])
    everything = pd.concat(raced)
    return {
        "progress_m": float(progress.mean()),
        "progress_low_m": float(progress.min()),
        "progress_high_m": float(progress.max()),
        "crash_rate": float(np.mean(everything["outcome"].to_numpy() == CRASH)),
        "mean_speed_mps": float(everything["mean_speed_mps"].to_numpy().mean()),
    }
