"""Simulator: owns the arrays of all worlds, checks what comes in, calls the kernels."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from numpy.typing import DTypeLike
from pydantic import Field

from outlap.config import Config
from outlap.errors import OutlapError
from outlap.simulator import kernels
from outlap.simulator.atlas import build_atlas
from outlap.simulator.collision import REMOVED
from outlap.simulator.dynamics import DRIFT, EULER, KINEMATIC, NONLINEAR_SINGLE_TRACK, RK4, SINGLE_TRACK
from outlap.simulator.lidar import beam_directions
from outlap.simulator.vehicle import PARAMETERS, accepted_bounds, parameter_names, to_values
from outlap.simulator.worlds import ACCELERATION, FULL, SPEED, VESC, Constants, allocate_worlds
from outlap.track.track import Track

Model = Literal["kinematic", "single_track", "nonlinear_single_track", "drift"]
MODELS = {
    "kinematic": KINEMATIC,
    "single_track": SINGLE_TRACK,
    "nonlinear_single_track": NONLINEAR_SINGLE_TRACK,
    "drift": DRIFT,
}
COMMANDS = {"speed": SPEED, "acceleration": ACCELERATION}
ODOMETRIES = {"full": FULL, "vesc": VESC}
INTEGRATORS = {"euler": EULER, "rk4": RK4}
MAX_DELAY_STEPS = 1000
MAX_COMMAND = 1e6  # beyond any stop and any speed, and far from where single precision ends


class SimulatorConfig(Config):
    """Physics and scanner that all worlds share."""

    model: Model = "single_track"
    integrator: Literal["euler", "rk4"] = "rk4"
    timestep: float = Field(default=0.01, gt=0, le=0.1)  # of physics [s]
    substeps: int = Field(default=1, ge=1)  # integrator steps per physics step
    command: Literal["speed", "acceleration"] = "speed"
    """What a car's second command is: a speed that a controller follows, or a share of the largest drive or brake."""
    odometry: Literal["full", "vesc"] = "full"
    """How a car measures its motion; `vesc`: no lateral speed, yaw rate from the steering command, as a stock VESC."""
    beams: int = Field(default=540, ge=0, le=1080)
    field_of_view: float = Field(default=4.7, gt=0, le=2 * np.pi)  # between the outermost beams [rad]


class Simulator:
    """Worlds × cars in lock-step.

    The arrays of `worlds` are live: they change with every `step` and `reset`. Copy what is to be kept.
    """

    def __init__(
        self,
        tracks: Sequence[Track],
        num_worlds: int,
        num_cars: int = 1,
        config: SimulatorConfig | None = None,
        max_delay: float = 0.0,
        max_latency: float = 0.0,
        road_bins: int = 0,
    ) -> None:
        """Allocate the worlds; `reset` each before the first `step`.

        Args:
            tracks: what `reset` refers to by number.
            num_worlds, num_cars: at least 1 each.
            config: physics and scanner.
            max_delay: the longest actuator delay that will occur [s].
            max_latency: the longest latency of a scan that will occur [s].
            road_bins: equal parts of the lap, each of which `reset` gives a friction.

        Raises OutlapError for a value out of range.
        """
        config = config or SimulatorConfig()
        _check(len(tracks) >= 1, "tracks", len(tracks), "at least one track is needed")
        _check(num_worlds >= 1, "num_worlds", num_worlds, "it must be at least 1")
        _check(num_cars >= 1, "num_cars", num_cars, "it must be at least 1")
        _check(0.0 <= max_delay < np.inf, "max_delay", max_delay, "it must be 0 s or more")
        _check(0.0 <= max_latency < np.inf, "max_latency", max_latency, "it must be 0 s or more")
        _check(road_bins >= 0, "road_bins", road_bins, "it must be 0 or more")
        slots, pose_slots = (round(longest / config.timestep) + 1 for longest in (max_delay, max_latency))
        _check(slots <= MAX_DELAY_STEPS, "max_delay", max_delay, f"at most {MAX_DELAY_STEPS} steps are kept")
        _check(pose_slots <= MAX_DELAY_STEPS, "max_latency", max_latency, f"at most {MAX_DELAY_STEPS} steps are kept")
        self.config = config
        self.tracks = tuple(tracks)
        self.num_worlds = num_worlds
        self.num_cars = num_cars
        self.atlas = build_atlas(self.tracks)
        self.worlds = allocate_worlds(num_worlds, num_cars, slots, config.beams, pose_slots, road_bins)
        self._constants = Constants(
            MODELS[config.model], INTEGRATORS[config.integrator], config.timestep, config.substeps,
            COMMANDS[config.command], ODOMETRIES[config.odometry], *beam_directions(config.beams, config.field_of_view),
        )  # fmt: skip
        cars = (num_worlds, num_cars)
        self._commands = np.zeros((*cars, 2), np.float32)
        self._started = np.zeros(num_worlds, bool)
        self._called: set[Callable[..., None]] = set()  # kernels that have run
        self.compile_seconds: float | None = None  # of the first call of each kernel, load from cache included

    def reset(
        self,
        which: np.ndarray,
        *,
        keys: np.ndarray,
        tracks: np.ndarray,
        params: np.ndarray,
        starts: np.ndarray,
        road: np.ndarray | None = None,
    ) -> None:
        """Begin an episode in some worlds; their scans are ready afterwards.

        Args:
            which: (n,) indices of worlds.
            keys: uint64 (n,), the key of each world's sensor noise.
            tracks: (n,) positions in `tracks`.
            params: (n, cars) records of `vehicle.PARAMETERS`, within `vehicle.accepted_bounds`.
            starts: (n, cars, 4) arc length [m], offset to the left [m], heading error [rad], speed [m/s].
            road: (n, road_bins) friction of equal parts of the lap / mu, in (0, 1]; None: 1 everywhere.
        """
        which = np.asarray(which)
        _check(which.ndim == 1 and which.dtype != bool, "which", which, "it must be (n,) indices of worlds")
        which = which.astype(np.int64)
        n, cars = len(which), self.num_cars
        keys = _writeable(keys, np.uint64)
        tracks = _writeable(tracks, np.int32)
        if params.dtype != PARAMETERS:  # a record's dtype takes longer to print than to compare
            _check(False, "params", f"of type {params.dtype}", "it must be vehicle.PARAMETERS")
        params = _writeable(params, PARAMETERS)
        starts = _writeable(starts, np.float64)
        _check_shape("keys", keys, (n,))
        _check_shape("tracks", tracks, (n,))
        _check_shape("params", params, (n, cars))
        _check_shape("starts", starts, (n, cars, 4))
        road_bins = self.worlds.road.shape[1]
        road = np.ones((n, road_bins), np.float32) if road is None else _writeable(road, np.float32)
        _check_shape("road", road, (n, road_bins))
        if n == 0:
            return
        # Few worlds end at a time: plain Python checks a handful sooner than NumPy.
        worlds = which.tolist()
        _check(min(worlds) >= 0 and max(worlds) < self.num_worlds, "which", which, "no such world")
        _check(len(set(worlds)) == n, "which", which, "each world may be named once")
        numbers = tracks.tolist()
        _check(min(numbers) >= 0 and max(numbers) < len(self.tracks), "tracks", tracks, "no such track")
        _check_rows(params)
        _check(bool(np.isfinite(starts).all()), "starts", "NaN or infinity", "it must be finite")
        slots = self.worlds.delayed.shape[2]
        late = max(params["steer_delay"].max(), params["speed_delay"].max()) / self.config.timestep
        if late >= slots - 0.5 + 1e-3:
            _check(False, "params", f"a delay of {late:.1f} steps", "raise max_delay")
        _check(bool(((road > 0.0) & (road <= 1.0)).all()), "road", "out of range", "it must be in (0, 1]")
        pose_slots = self.worlds.poses.shape[2]
        late = float(params["latency"].max()) / self.config.timestep
        _check(late < pose_slots - 0.5 + 1e-3, "params", f"a latency of {late:.1f} steps", "raise max_latency")
        self._timed(
            kernels.reset_worlds, self.atlas, self._constants, self.worlds, which,
            keys, tracks, params, starts, road,
        )  # fmt: skip
        self._started[which] = True

    def step(self, commands: np.ndarray, repeats: int = 1) -> None:
        """Advance every world by `repeats` physics steps under constant commands, then scan.

        Args:
            commands: (worlds, cars, 2) steering angle [rad], left positive, and speed [m/s]; where `config.command` is
                `acceleration`, a share of the largest driving (positive) or braking (negative) force in place of speed.
            repeats: physics steps.

        Raises OutlapError where a command is not a number within 1e6 or a world was never reset.
        """
        commands = np.asarray(commands)
        _check(commands.dtype.kind in "fiub", "commands", f"of type {commands.dtype}", "they must be numbers")
        _check_shape("commands", commands, self._commands.shape)
        _check(repeats >= 1, "repeats", repeats, "it must be at least 1")
        sane = np.abs(commands) <= MAX_COMMAND  # which NaN is not
        if not sane.all():
            world, car, _ = np.argwhere(~sane)[0]
            raise OutlapError(
                f"commands: that of car {car} in world {world} is {commands[world, car].tolist()}; "
                f"a steering angle [rad] and a speed [m/s], both within {MAX_COMMAND:g}, are needed"
            )
        if not self._started.all():
            raise OutlapError(f"world {np.argmin(self._started)} was never reset; call reset before step")
        self._commands[:] = commands
        self._timed(kernels.step_worlds, self.atlas, self._constants, self.worlds, self._commands, repeats)

    def remove(self, cars: np.ndarray) -> None:
        """Take cars, bool (worlds, cars), off the track: nobody sees or touches them until `respawn` or `reset`."""
        _check_shape("cars", np.asarray(cars), (self.num_worlds, self.num_cars))
        self.worlds.contact[cars] = REMOVED

    def respawn(self, clearance: float) -> None:
        """Put removed cars back on the centreline where they left it, at rest; laps and distance go on.

        Args:
            clearance: [m] to the middle of every other car, without which a car stays off the track.
        """
        self._timed(kernels.respawn_cars, self.atlas, self._constants, self.worlds, float(clearance))

    def _timed(self, kernel: Callable[..., None], *arguments: object) -> None:
        """Call a kernel; note how long its first call takes, which compiles it or loads it from the cache."""
        if kernel in self._called:
            kernel(*arguments)
            return
        begin = time.perf_counter()
        kernel(*arguments)
        self.compile_seconds = (self.compile_seconds or 0.0) + time.perf_counter() - begin
        self._called.add(kernel)


def _writeable(values: np.ndarray, dtype: DTypeLike) -> np.ndarray:
    """Return an array for a kernel, which Numba would compile once more for one that is read-only."""
    array = np.ascontiguousarray(values, dtype)
    return array if array.flags.writeable else array.copy()


def _check(holds: bool, name: str, value: object, remedy: str) -> None:
    if not holds:
        raise OutlapError(f"simulator: {name} is {value}; {remedy}")


def _check_shape(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise OutlapError(f"simulator: {name} has shape {array.shape}; it must be {shape}")


def _check_rows(params: np.ndarray) -> None:
    """Refuse what no configuration gives: a car without mass or wheelbase is nowhere, and its scan reads anywhere."""
    values = to_values(params)
    low, high = accepted_bounds()
    accepted = (values >= low) & (values <= high)
    if not accepted.all():
        world, car, column = (int(number) for number in np.argwhere(~accepted)[0])
        name, value = parameter_names()[column], values[world, car, column]
        raise OutlapError(
            f"simulator: params: {name} of car {car} in row {world} is {value:g}; "
            f"it must be in [{low[column]:g}, {high[column]:g}]"
        )
