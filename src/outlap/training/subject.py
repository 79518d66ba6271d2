"""The driver that a name stands for, with the task and the tracks that it is evaluated on."""

from __future__ import annotations

from outlap.drivers.driver import Driver
from outlap.drivers.find import find_drivers
from outlap.envs.race_config import RaceConfig
from outlap.errors import OutlapError
from outlap.evaluation.protocol import made_for
from outlap.track.generate import BUILTIN_HELD_OUT
from outlap.training.ppo import PPOConfig
from outlap.training.run import Run, is_run, load_run


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
