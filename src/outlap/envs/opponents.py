"""Who drives the other cars: a driver, a top speed and an unsteadiness drawn for each of them in every episode."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import cast

import numpy as np

from outlap.config import Number, bounds
from outlap.drivers.driver import Driver, DriverStack
from outlap.envs.actions import driver_actions
from outlap.envs.observations import check_terms, observe
from outlap.envs.race import Race
from outlap.errors import OutlapError
from outlap.simulator.seeding import DRIVER_STREAM, NOISE_STREAM, uniform

LONGEST_EPISODE = 1 << 32  # steps: apart by so many, the noise of two episodes never meets


class Opponents:
    """The cars behind the ego's in the arrays of a `Race`, (worlds, cars - 1) here.

    Perceptrons of one architecture are asked as one batch. Any other driver is asked about all cars, its own or not:
    so it has each in the same row from step to step, and one that remembers is told whose episode begins.
    """

    def __init__(self, drivers: Sequence[Driver], race: Race, top_speed: Number | None, noise: Number) -> None:
        """Put them into the cars of a race.

        Args:
            drivers: to draw from.
            race: whose cars they drive.
            top_speed: [m/s] of their cars; (low, high) is drawn, None leaves them as they are.
            noise: standard deviation of their actions, drawn likewise.
        """
        worlds, cars = race.speeds.shape[:2]
        self.drivers = drivers
        self.race = race
        self._top_speed = (np.inf, np.inf) if top_speed is None else bounds(top_speed)
        self._noise = bounds(noise)
        self.number = np.zeros((worlds, cars - 1), np.int64)  # of its driver in `drivers`
        self.top_speed = np.zeros((worlds, cars - 1), np.float32)  # [m/s]
        self.noise = np.zeros((worlds, cars - 1))
        self._keys = np.zeros(worlds, np.uint64)
        self._step = np.zeros(worlds, np.uint64)
        self._begins = np.ones((worlds, cars - 1), bool)
        spans = [driver.speeds or (0.0, np.nan) for driver in drivers]
        self._spans = np.array(spans, np.float32).reshape(-1, 2)
        self._names = np.array([driver.name for driver in drivers] or [""], dtype=object)
        self._groups = _groups(drivers)
        for driver in drivers:
            if driver.beams is not None and driver.beams > race.worlds.scan.shape[2]:
                raise OutlapError(
                    f"driver {driver.name}: looks with {driver.beams} beams, and the cars have "
                    f"{race.worlds.scan.shape[2]}; set beams to {driver.beams} or more"
                )
            check_terms(driver.observation_terms, driver.name)

    def names(self) -> np.ndarray:
        """Of the drivers at work: object (worlds, cars - 1)."""
        return self._names[self.number]

    def draw(self, which: np.ndarray, keys: np.ndarray, episodes: np.ndarray, params: np.ndarray) -> np.ndarray:
        """Draw those of some worlds, (n,) numbers, whose keys and episodes are these.

        Args:
            params: PARAMETERS (n, cars - 1) of their cars, whose top speeds are lowered to what is drawn, and to the
                driver's own.

        Returns:
            The speeds that their actions -1 and 1 command [m/s]: float32 (n, cars - 1, 2).
        """
        cars = self.number.shape[1]
        share = uniform(keys, episodes, DRIVER_STREAM, 3 * cars).reshape(len(which), 3, cars)
        (slow, fast), (calm, wild) = self._top_speed, self._noise
        cap = np.full_like(share[:, 0], slow) if slow == fast else slow + share[:, 0] * (fast - slow)
        self.number[which] = (share[:, 1] * len(self.drivers)).astype(np.int64)
        self.noise[which] = calm + share[:, 2] * (wild - calm)
        self._keys[which] = keys
        self._step[which] = np.asarray(episodes, np.uint64) * np.uint64(LONGEST_EPISODE)
        self._begins[which] = True
        spans = self._spans[self.number[which]]
        # A trained driver gets the car that it was trained in: how hard a car accelerates goes by its top speed too.
        params["v_max"] = np.fmin(np.minimum(params["v_max"], cap), spans[..., 1])
        spans[..., 1] = np.where(np.isnan(spans[..., 1]), params["v_max"], spans[..., 1])
        self.top_speed[which] = params["v_max"]
        return spans

    def act(self) -> np.ndarray:
        """Their actions: float32 (worlds, cars - 1, 2) in [-1, 1].

        Raises OutlapError that names a driver whose actions are not finite, or of a wrong shape.
        """
        worlds, cars = self.number.shape
        out = np.zeros((worlds, cars, 2), np.float32)
        for numbers, driver, stack in self._groups:
            mine = np.isin(self.number, numbers)
            if not mine.any():
                continue
            observation = self._observe(driver)
            if stack is not None:
                which = np.searchsorted(numbers, self.number[mine])
                out[mine] = stack.act(which, {name: value[mine] for name, value in observation.items()})
                continue
            driver.begin(self._begins.ravel())
            flat = {name: value.reshape(worlds * cars, -1) for name, value in observation.items()}
            out[mine] = driver_actions(driver, flat, worlds * cars).reshape(worlds, cars, 2)[mine]
        self._begins[:] = False
        if self.noise.any():
            out += self.noise[..., None] * self._normal(2 * cars).reshape(worlds, cars, 2)
        self._step += np.uint64(1)
        return np.clip(out, -1.0, 1.0)

    def _observe(self, driver: Driver) -> dict[str, np.ndarray]:
        """Return the observation of a driver in every car: (worlds, cars - 1, size) of its terms.

        A driver with fewer beams than the cars have gets the nearest ones.
        """
        terms, scaled = driver.observation_terms, driver.scale_observations
        seen = [observe(self.race, car, terms, scaled) for car in range(1, self.number.shape[1] + 1)]
        observation = {name: np.stack([each[name] for each in seen], axis=1) for name in seen[0]}
        if "scan" in observation and driver.beams is not None and driver.beams != observation["scan"].shape[2]:
            evenly = cast("np.ndarray", np.linspace(0, observation["scan"].shape[2] - 1, driver.beams))  # pyright: ignore[reportUnknownMemberType]
            chosen = np.rint(evenly).astype(np.int64)
            observation["scan"] = observation["scan"][..., chosen]
        return observation

    def _normal(self, count: int) -> np.ndarray:
        """Standard normal numbers of this step (worlds, count), by Box and Muller."""
        share = uniform(self._keys, self._step, NOISE_STREAM, 2 * count)
        radius = np.sqrt(-2.0 * np.log(1.0 - share[:, :count]))
        return radius * np.cos(2.0 * np.pi * share[:, count:])


def _groups(drivers: Sequence[Driver]) -> list[tuple[np.ndarray, Driver, DriverStack | None]]:
    """Return the drivers that act together: their numbers, ascending, the first of them, and their stack if any."""
    alike: dict[Hashable, list[int]] = {}
    for number, driver in enumerate(drivers):
        alike.setdefault(number if driver.architecture is None else driver.architecture, []).append(number)
    groups: list[tuple[np.ndarray, Driver, DriverStack | None]] = []
    for numbers in alike.values():
        members = [drivers[number] for number in numbers]
        first = members[0]
        groups.append((np.array(numbers), first, None if first.architecture is None else first.stack(members)))
    return groups
