"""RaceConfig: everything that makes an environment, as one typed configuration."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator, Field, field_validator

from outlap.config import Config, Number, bounded
from outlap.envs.rewards import RewardConfig
from outlap.envs.terminations import TerminationConfig
from outlap.simulator.simulator import SimulatorConfig
from outlap.simulator.vehicle import PRESETS, ActuatorParams, LidarParams, VehicleParams

PAPER_OBSERVATION = ("scan", "pose", "vel", "heading")


class StartConfig(Config):
    """Where and how cars are put on the track."""

    anywhere: bool = True  # at a random arc length; otherwise the ego is put on the start line
    speed: Number = 0.0  # of every car [m/s]
    offset: float = Field(default=0.5, ge=0, le=1)  # largest, as a share of the room to the track's edge
    heading_error: float = Field(default=0.1, ge=0)  # largest [rad]
    gap: Annotated[Number, bounded(at_least=0)] = (1.5, 4.0)  # between one car and the next along the track [m]


def _vehicle_preset(value: Any) -> Any:
    """A preset's name, or a mapping with `preset` and what differs from it, as a vehicle."""
    if isinstance(value, str):
        value = {"preset": value}
    if isinstance(value, dict) and "preset" in value:
        changes = dict(value)
        name = changes.pop("preset")
        if not isinstance(name, str) or name not in PRESETS:
            raise ValueError(f"preset {name!r} is unknown; there are {', '.join(PRESETS)}")
        return {**PRESETS[name].model_dump(), **changes}
    return value


class RaceConfig(SimulatorConfig):
    """An environment. The same names are keywords of `gymnasium.make` and flags of the commands."""

    tracks: tuple[str, ...] = ()  # names or paths, one drawn at each reset; none: the built-in training set
    augment_tracks: bool = False  # race each track also the other way round, mirrored, and both
    num_cars: int = Field(default=1, ge=1, le=64)  # the ego and its opponents
    opponent_speed: Annotated[Number, bounded(at_least=0)] = 3.0  # their top speed, drawn per opponent [m/s]
    control_interval: int = Field(default=1, ge=1, le=100)  # physics steps per action
    speed_range: tuple[float, float | None] | None = None  # [m/s] commanded by -1, 1; None: v_min, v_max
    vehicle: Annotated[VehicleParams, BeforeValidator(_vehicle_preset)] = VehicleParams()
    actuators: ActuatorParams = ActuatorParams()
    lidar: LidarParams = LidarParams()
    observation: tuple[str, ...] = PAPER_OBSERVATION  # terms, see envs.observations
    scale_observations: bool = False  # divide every term by its declared scale
    reward: RewardConfig = RewardConfig()
    termination: TerminationConfig = TerminationConfig()
    start: StartConfig = StartConfig()

    @field_validator("tracks", "observation", mode="before")
    @classmethod
    def _one_name_is_a_list(cls, value: Any) -> Any:
        return (value,) if isinstance(value, str) else value

    @field_validator("observation")
    @classmethod
    def _known_terms(cls, terms: tuple[str, ...]) -> tuple[str, ...]:
        from outlap.envs.observations import OBSERVATION_TERMS

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
