"""`outlap replay`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from outlap.cli.command import LongCommand
from outlap.cli.output import CommandResult, check_output_path
from outlap.cli.recordings import EpisodeFlags, Episodes, shown


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
