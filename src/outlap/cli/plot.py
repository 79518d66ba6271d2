"""`outlap plot`: figures of recorded episodes, of evaluations and of trainings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from outlap.cli.command import Command, LongCommand
from outlap.cli.output import CommandResult, check_output_path
from outlap.cli.recordings import EpisodeFlags, Episodes, recording_files
from outlap.errors import OutlapError

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from outlap.evaluation.recording import Recording


PICTURES = (".png", ".pdf", ".svg")


@dataclass(frozen=True, kw_only=True)
class _EpisodePlot(EpisodeFlags, LongCommand):
    names: Episodes
    """Recordings of `outlap evaluate --record` or `outlap adapt --record`, folders of them, or drivers, which race one
    episode now."""

    out: Path = Path("plot.png")
    """The picture: .png, .pdf or .svg."""


@dataclass(frozen=True, kw_only=True)
class PlotTrajectories(_EpisodePlot):
    """Draw where cars drove on the map, coloured by their speed."""

    def run(self) -> CommandResult:
        from outlap.viewer.episode_plots import draw_trajectories

        check_output_path(self.out, PICTURES)
        recordings, track = self.episodes(self.names, self.quiet)
        return _drawn(draw_trajectories(track, recordings), self.out)


@dataclass(frozen=True, kw_only=True)
class PlotFriction(_EpisodePlot):
    """Draw how much of the tyres' grip was used: the friction circle."""

    def run(self) -> CommandResult:
        from outlap.viewer.episode_plots import draw_friction_circles

        check_output_path(self.out, PICTURES)
        recordings, _ = self.episodes(self.names, self.quiet)
        return _drawn(draw_friction_circles(recordings), self.out)


@dataclass(frozen=True)
class PlotContexts(Command):
    """Draw what a policy's context tells of the task: principal components, and how tasks are confused.

    A task is a track, or what recordings of one track are called.
    """

    names: Episodes
    """Recordings of a policy of `outlap train mql`, or folders of them."""

    out: Path = Path("plot.png")
    """The picture: .png, .pdf or .svg."""

    def run(self) -> CommandResult:
        from outlap.viewer.episode_plots import draw_contexts

        check_output_path(self.out, PICTURES)
        return _drawn(draw_contexts(_recordings(self.names)), self.out)


@dataclass(frozen=True)
class PlotLapTimes(Command):
    """Draw lap times over the least possible, by track: of the folders that `outlap evaluate` leaves."""

    folders: Annotated[Positional[tuple[Path, ...]], arg(metavar="FOLDER")]
    """Evaluations; drivers are told apart by their names."""

    out: Path = Path("plot.png")
    """The picture: .png, .pdf or .svg."""

    def run(self) -> CommandResult:
        import pandas as pd

        from outlap.evaluation.results import ROWS
        from outlap.viewer.episode_plots import draw_lap_time_ratios

        check_output_path(self.out, PICTURES)
        if not self.folders:
            raise OutlapError("no evaluation named; give folders that outlap evaluate has written")
        rows = []
        for folder in self.folders:
            if not (folder / ROWS).is_file():
                raise OutlapError(f"{folder}: holds no {ROWS}; give a folder that outlap evaluate has written")
            rows.append(pd.read_parquet(folder / ROWS))
        return _drawn(draw_lap_time_ratios(pd.concat(rows, ignore_index=True)), self.out)


@dataclass(frozen=True)
class PlotLearning(Command):
    """Draw learning curves: return and crash rate over the actions of trainings.

    Runs that differ in nothing but their seed are one curve, with the 95 % interval of its mean.
    """

    runs: Annotated[Positional[tuple[str, ...]], arg(metavar="RUN")]
    """Run folders of `outlap train`."""

    out: Path = Path("plot.png")
    """The picture: .png, .pdf or .svg."""

    def run(self) -> CommandResult:
        from outlap.experiments.figures import draw_learning, read_learning
        from outlap.training.run import load_run

        check_output_path(self.out, PICTURES)
        if not self.runs:
            raise OutlapError("no run named; give run folders of outlap train")
        runs = [load_run(name) for name in self.runs]
        short = [run.folder.resolve().name for run in runs]
        names = short if len(set(short)) == len(short) else [str(run.folder) for run in runs]
        methods: dict[str, list[tuple[str, pd.DataFrame]]] = {}
        for name, run in zip(names, runs, strict=True):
            curve = read_learning(run.folder)
            if not len(curve):
                raise OutlapError(f"{run.folder}: has no learning curve yet; train longer, or leave it out")
            methods.setdefault(run.method, []).append((name, curve))
        curves = {
            members[0][0] + (f" ({len(members)} seeds)" if len(members) > 1 else ""): [curve for _, curve in members]
            for members in methods.values()
        }
        return _drawn(draw_learning(curves, "Learning"), self.out)


def _recordings(names: Sequence[str]) -> list[Recording]:
    """Those in files and folders. Raises OutlapError for a name that stands for none."""
    from outlap.evaluation.recording import Recording

    found = []
    for name in names:
        files = recording_files(name)
        if not files:
            raise OutlapError(f"{name}: is no recording; make some with outlap evaluate --record 3")
        found += [Recording.load(file) for file in files]
    if not found:
        raise OutlapError("no recording named; make some with outlap evaluate --record 3")
    return found


def _drawn(figure: Figure, out: Path) -> CommandResult:
    from outlap.figure_style import save_figure

    save_figure(figure, out)
    return CommandResult({"file": out}, lambda console: console.print(str(out)))
