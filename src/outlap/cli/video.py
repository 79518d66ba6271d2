"""`outlap video`."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from outlap.cli.arguments import check_least
from outlap.cli.command import LongCommand
from outlap.cli.output import CommandResult, check_output_path
from outlap.cli.races import check_positive
from outlap.cli.recordings import EpisodeFlags, Episodes, shown
from outlap.errors import OutlapError

STILL = ".png"


@dataclass(frozen=True, kw_only=True)
class Video(EpisodeFlags, LongCommand):
    """Write races as a video (.mp4), an animated picture (.gif) or a still one (.png). Needs no display."""

    names: Episodes
    """As of `outlap replay`; several are laid over one another."""

    out: Path = Path("race.mp4")
    """The file: .mp4, .gif or .png."""

    size: tuple[int, int] = (1280, 720)
    """Width and height in pixels."""

    fps: int = 30
    """Pictures a second."""

    speed: float = 1.0
    """Times real time."""

    view: Literal["follow", "track"] = "follow"
    """Follow the first race's car, or show the whole track."""

    at: float | None = None
    """[s] of the race that a .png shows; by default its end."""

    def run(self) -> CommandResult:
        from outlap.viewer.video import ENDINGS, check_video, count_pictures, write_picture, write_video

        check_least("--fps", self.fps, 1)
        check_positive("--speed", self.speed)
        check_output_path(self.out, (*ENDINGS, STILL))
        still = self.out.suffix.lower() == STILL
        if self.at is not None and not still:
            raise OutlapError(f"--at is for a {STILL}; {self.out} shows the whole race")
        check_least("--size", min(self.size), 64)
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
