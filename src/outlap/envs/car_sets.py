"""Sets of cars: the distribution from which trainings draw, and lists of test cars.

A set names some parameters of `simulator.vehicle.PARAMETERS` and gives their values; all others stay those of the
configuration.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import NamedTuple

import numpy as np

from outlap.errors import OutlapError
from outlap.simulator.vehicle import (
    DERIVED,
    NAMES,
    ActuatorParams,
    LidarParams,
    SensorParams,
    VehicleParams,
    accepted_bounds,
    parameter_bounds,
)


class TrainingRange(NamedTuple):
    """A parameter that trainings draw uniformly, and on which side driving is harder."""

    low: float
    high: float
    difficult: int  # -1: small values are harder to drive, 1: large ones


TRAINING_RANGES = {
    "mu": TrainingRange(0.4, 1.1, -1),  # slippery
    "m": TrainingRange(2.5, 5.0, 1),  # heavy [kg]
    "I": TrainingRange(0.03, 0.065, 1),  # [kg m^2]
    "motor_force": TrainingRange(22.0, 45.0, -1),  # weak [N]
    "brake_force": TrainingRange(25.0, 50.0, -1),  # [N]
    "lf": TrainingRange(0.14, 0.18, 1),  # tail-heavy [m]
    "lr": TrainingRange(0.15, 0.19, -1),  # [m]
    "front_B": TrainingRange(2.8, 4.2, 1),  # oversteering [1/rad]
    "rear_B": TrainingRange(3.2, 4.8, -1),  # [1/rad]
    "steer_delay": TrainingRange(0.0, 0.08, 1),  # late [s]
    "speed_delay": TrainingRange(0.0, 0.08, 1),  # [s]
    "steer_trim": TrainingRange(-0.04, 0.04, 1),  # [rad]
}
"""What differs between cars: the parameters of `training` and of the test cars, scaled by which they are in -1 … 1."""

MIDDLES = np.array([0.5 * (each.low + each.high) for each in TRAINING_RANGES.values()])  # of the training ranges
HALVES = np.array([0.5 * (each.high - each.low) for each in TRAINING_RANGES.values()])  # half their widths

NO_CAR = -1  # the number of a car that is drawn from ranges
TEST_SPLITS = ("inside", "edge", "outside", "hard")
TRAINING = "training"


@dataclass(frozen=True, eq=False)
class CarSet:
    """A distribution of cars, uniform between `low` and `high`, or a list of cars of which each is as likely."""

    name: str
    parameters: tuple[str, ...]
    values: np.ndarray  # float32 (cars, parameters); of a distribution the two rows low and high
    listed: bool  # whether it is a list

    @property
    def size(self) -> int:
        """The cars of a list; 0 for a distribution."""
        return len(self.values) if self.listed else 0

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """The smallest and the largest value of each parameter: float32 (parameters,) each."""
        return self.values.min(axis=0), self.values.max(axis=0)

    @property
    def columns(self) -> list[int]:
        """The places of the parameters in `NAMES`."""
        return [NAMES.index(name) for name in self.parameters]


def scaled(values: np.ndarray) -> np.ndarray:
    """Return the parameters of TRAINING_RANGES, (..., parameters), as multiples of half their range from its middle."""
    return (values - MIDDLES) / HALVES


def parameter_ends(
    vehicle: VehicleParams, actuators: ActuatorParams, lidar: LidarParams, sensors: SensorParams, cars: CarSet | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest value of each parameter of a car: float32 (N_PARAMS,) each.

    Args:
        vehicle, actuators, lidar, sensors: the ranges.
        cars: in place of the values above; None: these.
    """
    low, high = parameter_bounds(vehicle, actuators, lidar, sensors)
    if cars is not None:
        low[cars.columns], high[cars.columns] = cars.bounds
    return low, high


def find_cars(name: str) -> CarSet:
    """Return the set of cars that a name stands for.

    Args:
        name: `training`; one of TEST_SPLITS, also with the number of cars to take, such as `outside:40`; or a csv file
            whose header names parameters and whose rows are cars.

    Raises OutlapError for a name that is none of these, and for a file that holds no cars.
    """
    if name == TRAINING:
        ends = np.array([(each.low, each.high) for each in TRAINING_RANGES.values()], np.float32).T
        return CarSet(name, tuple(TRAINING_RANGES), ends, listed=False)
    split, _, count = name.partition(":")
    if split in TEST_SPLITS:
        with resources.as_file(resources.files("outlap.envs") / "cars" / f"{split}.csv") as path:
            cars = _read(path, name)
        if not count:
            return cars
        if not count.isdigit() or not 1 <= int(count) <= cars.size:
            raise OutlapError(f"cars is {name!r}; {split} has 1 to {cars.size} cars")
        return CarSet(name, cars.parameters, cars.values[: int(count)], listed=True)
    if Path(name).suffix.lower() == ".csv":
        return _read(Path(name), name)
    raise OutlapError(f"cars is {name!r}; must be {TRAINING}, one of {', '.join(TEST_SPLITS)} (:N), or a csv file")


def is_test_split(name: str) -> bool:
    """Return whether a set of cars is held out from training."""
    return name.partition(":")[0] in TEST_SPLITS


def _read(path: Path, name: str) -> CarSet:
    """Read a csv file of cars.

    Raises OutlapError with the file, the row, the parameter and what is wrong.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = list(csv.reader(line for line in file if line.strip() and not line.startswith("#"))) or [[]]
    except (OSError, UnicodeDecodeError) as error:
        raise OutlapError(f"{path}: cannot be read: {error}") from None
    for parameter in header:
        if parameter not in NAMES or parameter in DERIVED:
            raise OutlapError(f"{path}: {parameter!r} is not a parameter of a car; see simulator.vehicle")
    if not header or not rows or len(set(header)) < len(header):
        raise OutlapError(f"{path}: must have a header of different parameters and a row for each car")
    try:
        values = np.array([[float(cell) for cell in row] for row in rows], np.float32)
    except ValueError as error:
        raise OutlapError(f"{path}: {error}; every row must have {len(header)} numbers") from None
    if values.shape != (len(rows), len(header)):
        raise OutlapError(f"{path}: every row must have {len(header)} numbers")
    columns = [NAMES.index(parameter) for parameter in header]
    low, high = (ends[columns] for ends in accepted_bounds())
    bad = np.argwhere(~((values >= low) & (values <= high)))
    if len(bad):
        row, column = bad[0]
        raise OutlapError(
            f"{path}: {header[column]} of car {row} is {values[row, column]:g}; "
            f"must be in [{low[column]:g}, {high[column]:g}]"
        )
    return CarSet(name, tuple(header), values, listed=True)
