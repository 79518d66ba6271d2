"""The driver that a name stands for, with the task and the tracks that it is evaluated on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from outlap.config import load_config
from outlap.drivers.driver import Driver
from outlap.drivers.find import find_drivers
from outlap.envs.race_config import RaceConfig
from outlap.errors import OutlapError
from outlap.evaluation.protocol import made_for, with_top_speed
from outlap.planning.limits import CarLimits
from outlap.simulator.vehicle import PRESETS, VehicleParams
from outlap.track.generate import BUILTIN_HELD_OUT
from outlap.track.track import Track
from outlap.training.ppo import PPOConfig
from outlap.training.run import Run, is_run, load_run


@dataclass(frozen=True)
class Subject:
    """A driver, and what it races in."""

    driver: Driver
    env: RaceConfig
    run: Run | None  # the driver's, if it was trained
    task: Run | None  # that the environment is of


def find_subject(name: str, *, deterministic: bool = True, seed: int = 0) -> tuple[Driver, RaceConfig, Run | None]:
    """Return the driver that a name stands for, the task that it was made for, and its run if it was trained.

    Args:
        name: a run folder, or a name that `drivers.find` knows.
        deterministic, seed: see `PolicyDriver`; of a run's policy.

    Raises OutlapError for a name that stands for no driver, or for several.
    """
    if is_run(name):
        run = load_run(name)
        return run.driver(deterministic=deterministic, seed=seed), run.config.env, run
    env = PPOConfig().env
    drivers = find_drivers([name], env.field_of_view, split=None, run_code=True)
    if len(drivers) > 1:
        names = ", ".join(driver.name for driver in drivers)
        raise OutlapError(f"{name}: is a population; name one of its drivers, {name}/NAME: {names}")
    return drivers[0], made_for(drivers[0], env), None


def held_out_tracks(run: Run | None) -> tuple[str, ...]:
    """Return the names of the tracks that a run was not trained on; without a run, the built-in held-out ones."""
    return (run.config.held_out_tracks if run else ()) or BUILTIN_HELD_OUT


def subject_in_race(
    name: str,
    *,
    deterministic: bool = True,
    seed: int = 0,
    task: str | None = None,
    v_max: float | None = None,
    num_cars: int | None = None,
    opponents: Sequence[str] = (),
    opponent_code: bool = False,
    opponent_split: Literal["train", "held_out"] = "held_out",
    racing_line: str | None = None,
    formation: str | None = None,
) -> Subject:
    """Return the driver that a name stands for, in its own task or another one, with some changes.

    Args:
        name, deterministic, seed: see `find_subject`.
        task: a run folder, whose task it races in; if None, its own.
        v_max: top speed of the cars [m/s].
        num_cars, opponents, opponent_code, opponent_split, racing_line: of `RaceConfig`; None or empty: as in the task.
        formation: in which the cars start; None: as in the task.

    Raises what `find_subject` does, and OutlapError for a racing line that nobody follows.
    """
    driver, env, run = find_subject(name, deterministic=deterministic, seed=seed)
    task_run = run
    if task is not None:
        task_run = load_run(task)
        env = made_for(driver, task_run.config.env)
    env = with_top_speed(env, v_max)
    changes: dict[str, Any] = {"opponent_split": opponent_split, "opponent_code": opponent_code}
    if num_cars is not None:
        changes["num_cars"] = num_cars
    if opponents:
        changes = {"num_cars": max(2, env.num_cars), **changes, "opponents": tuple(opponents)}
    if racing_line is not None:
        changes["racing_line"] = racing_line
    if formation is not None:
        changes["start"] = env.start.model_copy(update={"formation": formation})
    env = env.model_copy(update=changes)
    if racing_line and env.num_cars == 1 and "line_ahead" not in driver.observation_terms:
        raise OutlapError(f"--racing-line is {racing_line}; {driver.name} follows no line")
    return Subject(driver, env, run, task_run)


def find_vehicle(name: str) -> VehicleParams:
    """Return the car that a preset, a yaml file or a run folder has.

    Raises OutlapError for a name that is none of these.
    """
    if name in PRESETS:
        return PRESETS[name]
    path = Path(name)
    if path.suffix.lower() in (".yaml", ".yml"):
        return load_config(VehicleParams, path)
    if is_run(name):
        return load_run(path).config.env.vehicle
    raise OutlapError(f"--vehicle is {name!r}; must be one of {', '.join(PRESETS)}, a yaml file, a run folder or track")


def find_limits(vehicle: str, track: Track, **changes: float | None) -> CarLimits:
    """Return the limits of a car for planning.

    Args:
        vehicle: see `find_vehicle`; `track`: what the track's own racing line asks of a car.
        track: to plan on.
        changes: of fields of `CarLimits`; None: as the car has it.

    Raises OutlapError for a track without a racing line, and what `find_vehicle` raises.
    """
    if vehicle == "track":
        if track.raceline is None:
            raise OutlapError(f"--vehicle is 'track'; {track.name} has no raceline that could ask anything")
        limits = CarLimits.of(VehicleParams()).implied_by(track.raceline)
    else:
        limits = CarLimits.of(find_vehicle(vehicle), "nonlinear_single_track")
    return replace(limits, **{name: value for name, value in changes.items() if value is not None})
