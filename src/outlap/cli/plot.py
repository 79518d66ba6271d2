"""`outlap plot`: figures of recorded episodes, of evaluations and of trainings."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic.dataclasses import dataclass
from tyro.conf import Positional, arg

from outlap.cli.command import Command, LongCommand
from outlap.cli.output import CommandResult, check_output_path, lines
from outlap.cli.races import EpisodeFlags, Episodes
from outlap.errors import OutlapError

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

PICTURES = (".png", ".pdf", ".svg")


@dataclass(frozen=True, kw_only=True)
class _Plot(Command):
    out: Path = Path("plot.png")
    """The picture: .png, .pdf or .svg."""

    def run(self) -> CommandResult:
        from outlap.figure_style import save_figure

        check_output_path(self.out, PICTURES)
        save_figure(self.draw(), self.out)
        return CommandResult({"file": self.out}, lines(str(self.out)))

    @abstractmethod
    def draw(self) -> Figure:
        """Return the figure. Raise OutlapError for an input that is wrong."""


@dataclass(frozen=True, kw_only=True)
class _EpisodePlot(EpisodeFlags, _Plot, LongCommand):
    names: Episodes
    """Recordings of `outlap evaluate --record` or `outlap adapt --record`, folders of them, or drivers, which race one
    episode now."""


@dataclass(frozen=True, kw_only=True)
class PlotTrajectories(_EpisodePlot):
    """Draw where cars drove on the map, coloured by their speed."""

    def draw(self) -> Figure:
        from outlap.viewer.episode_plots import draw_trajectories

        recordings, track = self.episodes(self.names, self.quiet)
        return draw_trajectories(track, recordings)


@dataclass(frozen=True, kw_only=True)
class PlotFriction(_EpisodePlot):
    """Draw how much of the tyres' grip was used: the friction circle."""

    def draw(self) -> Figure:
        from outlap.viewer.episode_plots import draw_friction_circles

        recordings, _ = self.episodes(self.names, self.quiet)
        return draw_friction_circles(recordings)


@dataclass(frozen=True, kw_only=True)
class PlotContexts(_Plot):
    """Draw what a policy's context tells of the task: principal components, and how tasks are confused.

    A task is a track, or what recordings of one track are called.
    """

    names: Episodes
    """Recordings of a policy of `outlap train mql`, or folders of them."""

    def draw(self) -> Figure:
        from outlap.viewer.episode_plots import draw_contexts
        from outlap.viewer.episodes import load_recordings

        return draw_contexts(load_recordings(self.names))


@dataclass(frozen=True, kw_only=True)
class PlotLapTimes(_Plot):
    """Draw lap times over the least possible, by track: of the folders that `outlap evaluate` leaves."""

    folders: Annotated[Positional[tuple[Path, ...]], arg(metavar="FOLDER")]
    """Evaluations; drivers are told apart by their names."""

    def draw(self) -> Figure:
        import pandas as pd

        from outlap.viewer.episode_plots import draw_lap_time_ratios

        if not self.folders:
            raise OutlapError("no evaluation named; give folders that outlap evaluate has written")
        return draw_lap_time_ratios(pd.concat([_read_rows(folder) for folder in self.folders], ignore_index=True))


@dataclass(frozen=True, kw_only=True)
class PlotCrashes(_Plot):
    """Draw where cars crashed on the maps of an evaluation's tracks, with the hot spots."""

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """That `outlap evaluate` or `outlap compare` has written."""

    def draw(self) -> Figure:
        from outlap.evaluation.hot_spots import hot_spots
        from outlap.track.catalog import load_tracks
        from outlap.viewer.crash_map import draw_crashes

        rows = _read_rows(self.folder)
        if "crash_s_m" not in rows:
            raise OutlapError(f"{self.folder}: its rows do not say where cars crashed; evaluate again")
        tracks = load_tracks(list(dict.fromkeys(rows["track"].tolist())))
        return draw_crashes(tracks, rows, hot_spots(rows, {track.name: track.centerline.length for track in tracks}))


@dataclass(frozen=True, kw_only=True)
class PlotLearning(_Plot):
    """Draw learning curves: return and crash rate over the actions of trainings.

    Runs that differ in nothing but their seed are one curve, with the 95 % interval of its mean.
    """

    runs: Annotated[Positional[tuple[str, ...]], arg(metavar="RUN")]
    """Run folders of `outlap train`."""

    def draw(self) -> Figure:
        from outlap.experiments.figures import draw_learning, learning_curves

        if not self.runs:
            raise OutlapError("no run named; give run folders of outlap train")
        return draw_learning(learning_curves(self.runs), "Learning")


def _read_rows(folder: Path) -> pd.DataFrame:
    """Return the rows of an evaluation. Raise OutlapError for a folder without them."""
    import pandas as pd

    from outlap.evaluation.results import ROWS

    if not (folder / ROWS).is_file():
        raise OutlapError(f"{folder}: holds no {ROWS}; give a folder that outlap evaluate has written")
    return pd.read_parquet(folder / ROWS)
