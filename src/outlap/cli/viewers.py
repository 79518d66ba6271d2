"""`outlap watch | replay | video`."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Annotated, Literal

from pydantic.dataclasses import dataclass
from tyro.conf import Positional, arg

from outlap.cli.command import Command, Count, CountOrZero, LongCommand, Pixels, Positive
from outlap.cli.output import CommandResult, check_output_path
from outlap.cli.races import EpisodeFlags, Episodes, RaceFlags, shown
from outlap.errors import OutlapError

log = logging.getLogger(__name__)
STILL = ".png"


@dataclass(frozen=True, kw_only=True)
class WatchRaces(RaceFlags, Command):
    """Watch a driver race in a window, or take the wheel of any car: h lists the keys.

    Episodes follow one another, from --seed on, until the window is closed.
    """

    driver: Annotated[Positional[str], arg(metavar="RUN")]
    """A run folder of `outlap train`, an opponent such as population/NAME, or a driver without one: pure-pursuit."""

    track: str | None = None
    """Name or map folder; by default the run's first held-out track, or else a built-in one."""

    laps: CountOrZero = 3
    """Completed laps that end an episode; 0: none do."""

    time_limit: Positive | None = None
    """[s] of an episode; by default enough for one lap more than --laps at 1 m/s."""

    size: tuple[Pixels, Pixels] = (1280, 720)
    """Of the window, width and height in pixels."""

    def run(self) -> CommandResult:
        from outlap.evaluation.protocol import standing_starts
        from outlap.track import load_track
        from outlap.training.subject import held_out_tracks
        from outlap.viewer.watch import Watch

        found = self.subject(self.driver)
        track = load_track(self.track or held_out_tracks(found.task)[0])
        env = standing_starts(found.env, [track], self.laps, self.time_limit)
        log.info("preparing %s on %s; h in the window lists the keys", found.driver.name, track.name)
        watch = Watch(found.driver, env, track, self.seed, self.size)
        watch.run()
        data = {"driver": found.driver.name, "track": track.name, "episodes": watch.episode}
        return CommandResult(data, lambda console: None)


@dataclass(frozen=True, kw_only=True)
class Replay(EpisodeFlags, LongCommand):
    """Write races as one HTML file that plays in any browser, and needs nothing else.

    Several are laid over one another or shown side by side: before and after an adaptation, one driver and another.
    """

    names: Episodes
    """Recordings of `outlap evaluate --record` or `outlap adapt --record`, folders of them, or drivers (run folders,
    pure-pursuit, …), which race one episode now: the same one for all."""

    out: Path = Path("replay.html")
    """The file."""

    title: str = ""
    """Of the page; by default the drivers' names."""

    def run(self) -> CommandResult:
        from outlap.viewer.replay import write_replay

        check_output_path(self.out, (".html",))
        recordings, track = self.episodes(self.names, self.quiet)
        path = write_replay(recordings, track, self.out, self.title)
        return shown(recordings, path)


@dataclass(frozen=True, kw_only=True)
class Video(EpisodeFlags, LongCommand):
    """Write races as a video (.mp4), an animated picture (.gif) or a still one (.png). Needs no display."""

    names: Episodes
    """As of `outlap replay`; several are laid over one another."""

    out: Path = Path("race.mp4")
    """The file: .mp4, .gif or .png."""

    size: tuple[Pixels, Pixels] = (1280, 720)
    """Width and height in pixels."""

    fps: Count = 30
    """Pictures a second."""

    speed: Positive = 1.0
    """Times real time."""

    view: Literal["follow", "track"] = "follow"
    """Follow the first race's car, or show the whole track."""

    at: float | None = None
    """[s] of the race that a .png shows; by default its end."""

    def run(self) -> CommandResult:
        from outlap.viewer.video import ENDINGS, check_video, count_pictures, write_picture, write_video

        check_output_path(self.out, (*ENDINGS, STILL))
        still = self.out.suffix.lower() == STILL
        if self.at is not None and not still:
            raise OutlapError(f"--at is for a {STILL}; {self.out} shows the whole race")
        if not still:
            check_video(self.out, self.size, self.fps)
        recordings, track = self.episodes(self.names, self.quiet)
        if still:
            return shown(
                recordings, write_picture(recordings, track, self.out, at=self.at, size=self.size, view=self.view)
            )
        begun = time.monotonic()
        count = count_pictures(recordings, self.fps, self.speed)
        with self.progress("drawing", count, "pictures") as update:
            path = write_video(
                recordings, track, self.out, size=self.size, frames_per_second=self.fps, view=self.view,
                speed=self.speed, on_progress=lambda done: update(done, ""),
            )  # fmt: skip
        return shown(recordings, path, time.monotonic() - begun)
