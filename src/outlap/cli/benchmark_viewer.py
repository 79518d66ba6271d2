"""`outlap benchmark viewer`."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from outlap.cli.arguments import check_least
from outlap.cli.command import LongCommand
from outlap.cli.output import CommandResult
from outlap.cli.races import check_positive
from outlap.processes import in_new_process
from outlap.provenance import machine

if TYPE_CHECKING:
    from rich.console import Console

    from outlap.drivers.driver import Driver
    from outlap.envs.race_config import RaceConfig
    from outlap.track import Track


@dataclass(frozen=True)
class BenchmarkViewer(LongCommand):
    """Measure the viewers on a race: in a window that nobody sees, as a video, as a replay.

    In the window the race is simulated too, as `outlap watch` does; pictures follow one another without a pause, until
    the race is over.
    """

    track: str = "Nightjar"
    """Name or map folder."""

    cars: int = 4
    """In the race."""

    beams: int = 540
    """LiDAR beams."""

    seconds: float = 60.0
    """Of the race."""

    size: tuple[int, int] = (1280, 720)
    """Of the pictures, width and height in pixels."""

    def run(self) -> CommandResult:
        check_least("--cars", self.cars, 2)
        check_least("--beams", self.beams, 1)
        check_least("--size", min(self.size), 64)
        check_positive("--seconds", self.seconds)
        row: dict[str, Any] = {}
        with self.progress("benchmark", len(MEASUREMENTS), "cases") as update:
            for number, measure in enumerate(MEASUREMENTS, start=1):
                row |= in_new_process(measure, self)
                update(number, measure.__name__.removeprefix("_measure_"))
        data = {**row, "machine": machine()}
        return CommandResult(data, lambda console: _print(console, row))


def _race(settings: BenchmarkViewer) -> tuple[Driver, RaceConfig, Track]:
    from outlap.drivers.find import find_drivers
    from outlap.envs.race_config import RaceConfig
    from outlap.evaluation.protocol import standing_starts
    from outlap.track import load_track

    track = load_track(settings.track)
    race = RaceConfig(
        num_cars=settings.cars, opponents=("follow-the-gap",), beams=settings.beams, control_interval=4,
        speed_range=(0.0, 6.0),
    )  # fmt: skip
    task = standing_starts(race, [track], laps=0, time_limit=settings.seconds)
    (driver,) = find_drivers(["follow-the-gap"], task.field_of_view, split=None)
    return driver, task, track


def _measure_window(settings: BenchmarkViewer) -> dict[str, Any]:
    from outlap.viewer.watch import Watch

    os.environ["SDL_VIDEODRIVER"] = "dummy"
    watch = Watch(*_race(settings), seed=1, size=settings.size)
    watch.update(0.1)  # what is made once
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


def _measure_files(settings: BenchmarkViewer) -> dict[str, Any]:
    from outlap.evaluation.recorder import record_episode
    from outlap.viewer.replay import write_replay
    from outlap.viewer.video import count_pictures, write_video

    driver, task, track = _race(settings)
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


MEASUREMENTS: tuple[Callable[[BenchmarkViewer], dict[str, Any]], ...] = (_measure_window, _measure_files)


def _print(console: Console, row: dict[str, Any]) -> None:
    lines = (
        f"window: {row['window_pictures_per_second']} pictures/s, simulation included; 99 of 100 take "
        f"{row['window_p99_ms']} ms or less",
        f"video: {row['video_pictures_per_second']} pictures/s, {row['video_times_real_time']} times real time",
        f"replay: {row['replay_bytes'] / 1e6:.2f} MB for {row['race_s']} s, written in {row['replay_s']} s",
    )
    for line in lines:
        console.print(line)
