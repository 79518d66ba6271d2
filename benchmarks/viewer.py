"""Measure the viewers on a race: in a window that nobody sees, as a video, as a replay.

In the window the race is simulated too, as `outlap watch` does; pictures follow one another without a pause, until the
race is over.

    python benchmarks/viewer.py --json viewer.json
"""

from __future__ import annotations

import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from outlap.drivers.driver import Driver
from outlap.drivers.find import find_drivers
from outlap.envs.race_config import RaceConfig
from outlap.evaluation.protocol import standing_starts
from outlap.evaluation.recorder import record_episode
from outlap.files import atomic_write, to_json
from outlap.processes import in_new_process
from outlap.provenance import machine
from outlap.track import Track, load_track
from outlap.viewer.replay import write_replay
from outlap.viewer.video import count_pictures, write_video
from outlap.viewer.watch import Watch


@dataclass(frozen=True)
class Settings:
    """What is measured."""

    track: str = "Nightjar"
    """Name or map folder."""

    cars: int = 4
    """In the race, two or more."""

    beams: int = 540
    """LiDAR beams."""

    seconds: float = 60.0
    """Of the race."""

    size: tuple[int, int] = (1280, 720)
    """Of the pictures, width and height in pixels."""

    json: Path | None = None
    """Write the result as JSON to this file too."""


def race(settings: Settings) -> tuple[Driver, RaceConfig, Track]:
    """Return the driver, the task and the track of the race."""
    track = load_track(settings.track)
    config = RaceConfig(
        num_cars=settings.cars, opponents=("follow-the-gap",), beams=settings.beams, control_interval=4,
        speed_range=(0.0, 6.0),
    )  # fmt: skip
    task = standing_starts(config, [track], laps=0, time_limit=settings.seconds)
    (driver,) = find_drivers(["follow-the-gap"], task.field_of_view, split=None)
    return driver, task, track


def measure_window(settings: Settings) -> dict[str, Any]:
    """Return pictures per second of the window, simulation included."""
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    watch = Watch(*race(settings), seed=1, size=settings.size)
    watch.update(0.1)  # warm-up
    taken: list[float] = []
    while watch.episode == 1 and len(taken) < 60 * settings.seconds:
        begun = time.monotonic()
        watch.update(1 / 60)
        taken.append(time.monotonic() - begun)
    watch.window.close()
    return {
        "window_pictures": len(taken),
        "window_pictures_per_second": round(len(taken) / sum(taken), 1),
        "window_p99_ms": round(1000.0 * float(np.quantile(taken, 0.99)), 1),
    }


def measure_files(settings: Settings) -> dict[str, Any]:
    """Return how long a recording, a video and a replay page take."""
    driver, task, track = race(settings)
    begun = time.monotonic()
    recording = record_episode(driver, task, track, seed=1)
    row: dict[str, Any] = {"race_s": round(recording.seconds, 2), "recording_s": round(time.monotonic() - begun, 2)}
    with tempfile.TemporaryDirectory() as folder:
        begun = time.monotonic()
        write_video([recording], track, Path(folder) / "race.mp4", size=settings.size)
        seconds = time.monotonic() - begun
        row["video_pictures_per_second"] = round(count_pictures([recording], 30) / seconds, 1)
        row["video_times_real_time"] = round(recording.seconds / seconds, 2)
        begun = time.monotonic()
        path = write_replay([recording], track, Path(folder) / "race.html")
        row["replay_s"], row["replay_bytes"] = round(time.monotonic() - begun, 2), path.stat().st_size
    return row


def main() -> None:
    settings = tyro.cli(Settings, description=__doc__)
    row = {
        name: value
        for measure in (measure_window, measure_files)
        for name, value in in_new_process(measure, settings).items()
    }
    if settings.json:
        atomic_write(settings.json, to_json({**row, "machine": machine()}) + "\n")
    print(
        f"window: {row['window_pictures_per_second']} pictures/s, simulation included; 99 of 100 take "
        f"{row['window_p99_ms']} ms or less\n"
        f"video: {row['video_pictures_per_second']} pictures/s, {row['video_times_real_time']} times real time\n"
        f"replay: {row['replay_bytes'] / 1e6:.2f} MB for {row['race_s']} s, written in {row['replay_s']} s"
    )


if __name__ == "__main__":
    main()
