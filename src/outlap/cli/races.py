"""What a command races: drivers found by name, in the task that its flags ask for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from outlap.cli.arguments import check_least
from outlap.cli.command import Flag
from outlap.errors import OutlapError

if TYPE_CHECKING:
    from outlap.drivers.driver import Driver
    from outlap.envs.race_config import RaceConfig
    from outlap.training.run import Run


@dataclass(frozen=True, kw_only=True)
class RaceFlags:
    """Flags of commands that race a driver."""

    task: str | None = None
    """A run folder: race as in its training, its cars with their ranges, on its held-out tracks; of a driver that has a
    scanner and a top speed of its own, those stay. By default the driver's own task."""

    v_max: float | None = None
    """[m/s] top speed of the cars, in place of the run's; what the policy commands stays within what it learnt."""

    num_cars: int | None = None
    """The driver's car and opponents; by default as many as the run was trained with."""

    opponents: tuple[str, ...] = ()
    """Drivers and populations to draw opponents from, in place of the run's; one where the run had none."""

    opponent_code: Flag = False
    """Import modules for opponents, module:function, which runs their code; no run's configuration allows it."""

    opponent_split: Literal["train", "held_out"] = "held_out"
    """The half of a population that opponents are drawn from."""

    racing_line: Literal["track", "min-curvature", "min-time"] | None = None
    """That pure pursuit follows, in place of the run's: the track's own, or one planned for the car."""

    formation: Literal["queue", "behind", "grid", "scattered"] | None = None
    """In which the cars start, in place of the run's; behind: the driver's car is the last."""

    seed: int = 0
    """Of the episodes."""

    def check_races(self) -> None:
        """Raises OutlapError for a flag that is out of its range."""
        check_least("--seed", self.seed, 0)
        check_least("--num-cars", 1 if self.num_cars is None else self.num_cars, 1)
        check_positive("--v-max", self.v_max)

    def subject(self, name: str, *, deterministic: bool = True) -> Subject:
        """A driver, and what it is to race in. Raises what `find_subject` does."""
        from outlap.evaluation.protocol import made_for, with_top_speed
        from outlap.training.run import load_run
        from outlap.training.subject import find_subject

        driver, env, run = find_subject(name, deterministic=deterministic, seed=self.seed)
        task = run
        if self.task is not None:
            task = load_run(self.task)
            env = made_for(driver, task.config.env)
        env = self._as_asked(with_top_speed(env, self.v_max))
        if self.racing_line and env.num_cars == 1 and "line_ahead" not in driver.observation_terms:
            raise OutlapError(f"--racing-line is {self.racing_line}; {driver.name} follows no line")
        return Subject(driver, env, run, task)

    def _as_asked(self, env: RaceConfig) -> RaceConfig:
        changes: dict[str, Any] = {"opponent_split": self.opponent_split, "opponent_code": self.opponent_code}
        if self.num_cars is not None:
            changes["num_cars"] = self.num_cars
        if self.opponents:
            changes |= {"num_cars": max(2, env.num_cars), **changes, "opponents": self.opponents}
        if self.racing_line is not None:
            changes["racing_line"] = self.racing_line
        if self.formation:
            changes["start"] = env.start.model_copy(update={"formation": self.formation})
        return env.model_copy(update=changes)


@dataclass(frozen=True)
class Subject:
    """A driver, and what it races in."""

    driver: Driver
    env: RaceConfig
    run: Run | None  # the driver's, if it was trained
    task: Run | None  # that the environment is of


def check_positive(flag: str, value: float | None) -> None:
    """Raises OutlapError for a number that is given, and not above 0 and finite."""
    if value is not None and not 0.0 < value < float("inf"):
        raise OutlapError(f"{flag} is {value}; must be > 0")


def unused(folder: Path) -> Path:
    """This folder, or one numbered like it where two evaluations begin in the same second."""
    numbered = (folder.with_name(f"{folder.name}-{i}") for i in range(2, 1000))
    return next(path for path in (folder, *numbered) if not path.exists())
