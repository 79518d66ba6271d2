"""RaceConfig: everything that makes an environment, as one typed configuration."""

from __future__ import annotations

from typing import Annotated, Any, Literal, cast

from pydantic import BeforeValidator, Field, field_validator

from outlap.config import Number, bounded, bounds
from outlap.envs.observations import OBSERVATION_TERMS
from outlap.envs.racing_line import RacingLine
from outlap.envs.rewards import RewardConfig
from outlap.envs.road import RoadConfig
from outlap.envs.starts import StartConfig
from outlap.envs.terminations import TerminationConfig
from outlap.envs.wrecks import CrashRule
from outlap.simulator.simulator import SimulatorConfig
from outlap.simulator.vehicle import PRESETS, ActuatorParams, LidarParams, SensorParams, VehicleParams

PAPER_OBSERVATION = ("scan", "pose", "vel", "heading")


def _vehicle_preset(value: Any) -> Any:
    """A preset's name, or a mapping with `preset` and what differs from it, as a vehicle."""
    fields: Any = {"preset": value} if isinstance(value, str) else value
    if not isinstance(fields, dict) or "preset" not in fields:
        return value
    changes = cast("dict[str, Any]", fields).copy()
    name = changes.pop("preset")
    if not isinstance(name, str) or name not in PRESETS:
        raise ValueError(f"preset {name!r} is unknown; there are {', '.join(PRESETS)}")
    return {**PRESETS[name].model_dump(), **changes}


class RaceConfig(SimulatorConfig):
    """An environment. The same names are keywords of `gymnasium.make` and flags of the commands."""

    tracks: tuple[str, ...] = ()  # names or paths, one drawn at each reset; none: the built-in training set
    augment_tracks: bool = False  # race each track also the other way round, mirrored, and both
    num_cars: int = Field(default=1, ge=1, le=64)  # the ego and its opponents
    opponents: tuple[str, ...] = ("pure-pursuit",)  # see drivers.find; one driver is drawn per opponent and reset
    opponent_split: Literal["train", "held_out"] = "train"  # the half of a population; training takes no other
    opponent_code: bool = False  # whether modules may be imported for opponents, module:function
    opponent_crash: CrashRule = "park"  # what becomes of an opponent that crashed
    opponent_speed: Annotated[Number, bounded(at_least=0)] | None = None  # their cars' top speed [m/s], drawn likewise
    opponent_noise: Annotated[Number, bounded(at_least=0)] = 0.0  # standard deviation of their actions, likewise
    control_interval: int = Field(default=1, ge=1, le=100)  # physics steps per action
    speed_range: tuple[float, float | None] | None = None  # [m/s] commanded by -1, 1; None: v_min, v_max
    vehicle: Annotated[VehicleParams, BeforeValidator(_vehicle_preset)] = VehicleParams()
    actuators: ActuatorParams = ActuatorParams()
    sensors: SensorParams = SensorParams()
    lidar: LidarParams = LidarParams()
    cars: str = ""  # draw cars from this set, see envs.car_sets: training, outside:40, a csv file; none: as above
    road: RoadConfig = RoadConfig()
    observation: tuple[str, ...] = PAPER_OBSERVATION  # terms, see envs.observations
    racing_line: RacingLine = "track"  # to which `line_ahead` leads, see envs.racing_line
    nearby_cars: int = Field(default=3, ge=1)  # of which the term of that name tells
    scale_observations: bool = False  # divide every term by its declared scale
    reward: RewardConfig = RewardConfig()
    termination: TerminationConfig = TerminationConfig()
    start: StartConfig = StartConfig()

    @field_validator("tracks", "observation", "opponents", mode="before")
    @classmethod
    def _one_name_is_a_list(cls, value: Any) -> Any:
        return (value,) if isinstance(value, str) else value

    @field_validator("observation")
    @classmethod
    def _known_terms(cls, terms: tuple[str, ...]) -> tuple[str, ...]:
        for name in terms:
            if name not in OBSERVATION_TERMS:
                raise ValueError(f"{name!r} is not an observation term; there are {', '.join(OBSERVATION_TERMS)}")
        if not terms or len(set(terms)) < len(terms):
            raise ValueError("must name at least one term, and none twice")
        return terms

    @field_validator("speed_range")
    @classmethod
    def _ordered(cls, speeds: tuple[float, float | None] | None) -> tuple[float, float | None] | None:
        if speeds is not None and speeds[1] is not None and not speeds[0] < speeds[1]:
            raise ValueError("must be (slowest, fastest) [m/s] with slowest < fastest")
        return speeds

    @property
    def commanded_speeds(self) -> tuple[float, float]:
        """[m/s] that the actions -1 and 1 command; of cars that are drawn, those of the fastest either way."""
        slowest, fastest = self.speed_range or (bounds(self.vehicle.v_min)[0], None)
        return slowest, bounds(self.vehicle.v_max)[1] if fastest is None else fastest
