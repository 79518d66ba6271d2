"""Recordings that are made up: cars on a ring, whose every number is known."""

from __future__ import annotations

import math

import numpy as np

from outlap.evaluation.frame import SPEED, YAW, Cast, X, Y
from outlap.evaluation.recording import Event, Recording, RecordingInfo
from outlap.track.track import Track


def straight_on(observation: dict[str, np.ndarray]) -> np.ndarray:
    """A driver that never steers."""
    return np.tile(np.array([0.0, 0.5], np.float32), (len(next(iter(observation.values()))), 1))


def circling(
    track: Track,
    *,
    radius: float = 8.0,
    speed: float = 4.0,
    seconds: float = 4.0,
    cars: int = 1,
    beams: int = 0,
    title: str = "circling",
    drivers: tuple[str, ...] | None = None,
    context: np.ndarray | None = None,
    events: tuple[Event, ...] = (),
    outcome: str = "timeout",
    interval: float = 0.04,
) -> Recording:
    """Cars that go round a track about the origin at a constant speed, two metres apart."""
    time = np.arange(0.0, seconds + 0.5 * interval, interval)
    frames = len(time)
    distance = speed * time[:, None] - 2.0 * np.arange(cars)
    angle = distance / radius
    motion = np.zeros((frames, cars, 6), np.float32)
    motion[..., X], motion[..., Y] = radius * np.cos(angle), radius * np.sin(angle)
    motion[..., YAW] = angle + 0.5 * math.pi
    motion[..., SPEED] = speed
    laps = np.floor(np.maximum(distance, 0.0) / (2.0 * math.pi * radius)).astype(np.int16)
    cast = Cast(
        drivers=drivers or tuple(f"car {car}" for car in range(cars)), sizes=((0.58, 0.31),) * cars, field_of_view=4.7,
        max_range=30.0, mount_x=0.27, mu=1.0,
    )  # fmt: skip
    rewards = np.column_stack([np.full(frames, 0.1 * speed * interval), np.zeros(frames)]).astype(np.float32)
    info = RecordingInfo(
        title=title, track=track.name, track_fingerprint=track.fingerprint, seed=0, cast=cast, outcome=outcome,
        events=events, terms=("progress", "collision"),
    )  # fmt: skip
    return Recording(
        info,
        time=time.astype(np.float32),
        motion=motion,
        distance=distance.astype(np.float32),
        laps=laps,
        lap_time=np.full((frames, cars), np.nan, np.float32),
        contact=np.zeros((frames, cars), np.uint8),
        scan=np.full((frames, beams), 2.0, np.float16),
        action=np.zeros((frames, 2), np.float32),
        rewards=rewards,
        context=np.zeros((0, 0), np.float32) if context is None else context.astype(np.float32),
    )
