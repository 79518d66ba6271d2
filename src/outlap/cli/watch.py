"""`outlap watch`."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Annotated

from tyro.conf import Positional, arg

from outlap.cli.arguments import check_least
from outlap.cli.command import Command
from outlap.cli.output import CommandResult
from outlap.cli.races import RaceFlags, check_positive

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class WatchRaces(RaceFlags, Command):
    """Watch a driver race in a window, or take the wheel of any car: h lists the keys.

    Episodes follow one another, from --seed on, until the window is closed.
    """

    driver: Annotated[Positional[str], arg(metavar="RUN")]
    """A run folder of `outlap train`, an opponent such as population/NAME, or a driver without one: pure-pursuit."""

    track: str | None = None
    """Name or map folder; by default the run's first held-out track, or else a built-in one."""

    laps: int = 3
    """Completed laps that end an episode; 0: none do."""

    time_limit: float | None = None
    """[s] of an episode; by default enough for one lap more than --laps at 1 m/s."""

    size: tuple[int, int] = (1280, 720)
    """Of the window, width and height in pixels."""

    def run(self) -> CommandResult:
        from outlap.evaluation.protocol import standing_starts
        from outlap.track import load_track
        from outlap.training.subject import held_out_tracks
        from outlap.viewer.watch import Watch

        self.check_races()
        check_least("--laps", self.laps, 0)
        check_positive("--time-limit", self.time_limit)
        check_least("--size", min(self.size), 64)
        found = self.subject(self.driver)
        track = load_track(self.track or held_out_tracks(found.task)[0])
        env = standing_starts(found.env, [track], self.laps, self.time_limit)
        log.info("preparing %s on %s; h in the window lists the keys", found.driver.name, track.name)
        watch = Watch(found.driver, env, track, self.seed, self.size)
        watch.run()
        data = {"driver": found.driver.name, "track": track.name, "episodes": watch.episode}
        return CommandResult(data, lambda console: None)
