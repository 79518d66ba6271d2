"""`outlap evaluate`."""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic.dataclasses import dataclass
from tyro.conf import Positional, arg

from outlap.cli.command import Count, CountOrZero, Flag, LongCommand, Positive
from outlap.cli.output import NOTHING_KEPT, CommandResult, dated_folder, table
from outlap.cli.races import RaceFlags, with_recordings
from outlap.errors import OutlapError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from outlap.drivers.driver import Driver
    from outlap.envs.race_config import RaceConfig
    from outlap.evaluation.rollout import EvaluationProgress
    from outlap.track import Track
    from outlap.training.subject import Subject


@dataclass(frozen=True, kw_only=True)
class Evaluate(RaceFlags, LongCommand):
    """Race a driver on tracks, from a standstill anywhere on the lap, and measure it.

    The episodes are settled in advance by --seed, the same ones for every driver. The car is that of the
    training, with its ranges. The paper's protocol: --laps 0 --time-limit 5 --episodes 500.
    """

    driver: Annotated[Positional[str], arg(metavar="RUN")]
    """A run folder of `outlap train`, an opponent such as population/NAME, or a driver without one: pure-pursuit."""

    tracks: tuple[str, ...] = ()
    """Names or map folders; by default the run's held-out tracks, or else the built-in held-out ones."""

    episodes: Count = 100
    """On each track."""

    laps: CountOrZero = 3
    """Completed laps that end an episode, counted from line to line; 0: none do."""

    time_limit: Positive | None = None
    """[s] of an episode; by default enough for one lap more than --laps at 1 m/s."""

    worlds: Count = 128
    """Episodes raced at once; changes the speed, and not the results."""

    stochastic: Flag = False
    """Draw actions from the policy's distribution, as in training; then results depend on --worlds too."""

    record: CountOrZero = 0
    """Of each track's episodes, keep so many to be looked at with `outlap replay`, `outlap video` or `outlap plot`."""

    out: Path | None = None
    """A new or empty folder for the results; by default RUN/evaluations/TIME."""

    def run(self) -> CommandResult:
        if self.laps == 0 and self.time_limit is None:
            raise OutlapError("--laps is 0; must be 1 or more, or be given with a --time-limit")
        from outlap.evaluation.protocol import standing_starts
        from outlap.track.catalog import load_tracks
        from outlap.training.run import is_run
        from outlap.training.subject import held_out_tracks

        if self.stochastic and not is_run(self.driver):
            raise OutlapError(f"--stochastic is for a trained run; {self.driver} draws nothing")
        if self.stochastic and self.record:
            raise OutlapError("--record is of episodes that can be raced again; leave --stochastic out")
        found = self.subject(self.driver, deterministic=not self.stochastic)
        tracks = load_tracks(self.tracks or held_out_tracks(found.task))
        env = standing_starts(found.env, tracks, self.laps, self.time_limit)
        home = found.run.folder if found.run else Path("runs") / found.driver.name
        folder = self.out or dated_folder(home / "evaluations")
        data = {**self._evaluate(found, env, tracks, folder)}
        data["crash_map"] = _draw_crash_map(folder, tracks, data["hot_spots"])
        result = CommandResult(data, lambda console: show_summary(console, data))
        if not self.record:
            return result
        self._record(found.driver, env, tracks, folder)
        return with_recordings(result, folder, tracks[0])

    def _evaluate(self, found: Subject, env: RaceConfig, tracks: Sequence[Track], folder: Path) -> Mapping[str, Any]:
        from outlap.evaluation.results import evaluate_into

        run, begun = found.run, time.monotonic()
        with self.progress("evaluating", self.episodes * len(tracks), "episodes") as update:

            def show(progress: EvaluationProgress) -> None:
                rate = progress.steps / max(time.monotonic() - begun, 1e-9)
                update(int(progress.done), f"{progress.finished} finished  {rate:,.0f} steps/s")

            try:
                return evaluate_into(
                    folder, found.driver, env, tracks, episodes=self.episodes, seed=self.seed, num_worlds=self.worlds,
                    trained_on=run.trained_on([track.name for track in tracks]) if run else (),
                    facts={**(run.policy_record() if run else {}), "stochastic": self.stochastic}, on_progress=show,
                )  # fmt: skip
            except KeyboardInterrupt:
                print(f"\n{NOTHING_KEPT}", file=sys.stderr)
                raise

    def _record(self, driver: Driver, env: RaceConfig, tracks: Sequence[Track], folder: Path) -> None:
        from outlap.evaluation.recorder import record_episodes
        from outlap.evaluation.recording import RECORDINGS

        number = min(self.record, self.episodes)
        with self.progress("recording", number * len(tracks), "episodes") as update:
            done = itertools.count(1)
            for track in tracks:
                record_episodes(
                    driver, env, track, self.seed, number, folder / RECORDINGS,
                    on_recorded=lambda path: update(next(done), path.name),
                )  # fmt: skip


def _draw_crash_map(folder: Path, tracks: Sequence[Track], spots: Sequence[Mapping[str, Any]]) -> Path | None:
    """Draw the crashes of an evaluation into its folder; return the picture, or None where nobody crashed."""
    import pandas as pd

    from outlap.envs.terminations import CRASH
    from outlap.evaluation.results import ROWS
    from outlap.figure_style import save_figure
    from outlap.viewer.crash_map import draw_crashes

    rows = pd.read_parquet(folder / ROWS)
    if CRASH not in rows["outcome"].to_numpy():
        return None
    save_figure(draw_crashes(tracks, rows, spots), folder / "crashes.png")
    return folder / "crashes.png"


def _hot_spot_table(spots: Sequence[Mapping[str, Any]]) -> Table:
    rows = [(spot["track"], f"{spot['s_m']:.1f}", spot["crashes"], f"{spot['share']:.0%}") for spot in spots]
    return table(("track", "crash hot spot at [m]", "crashes", "share of the track's"), rows, left=("track",))


def show_summary(console: Console, data: Mapping[str, Any]) -> None:
    """Print what an evaluation found, and where it is."""
    trained_on = data["trained_on"]
    each = next(iter(data["tracks"].values()))["episodes"]
    console.print(f"{data['driver']}: {each} episodes on each track, {data['all']['episodes']} in all")
    for columns in (DRIVING, RACING, EPISODES):
        console.print()
        console.print(_table(data, columns))
    console.print()
    if data["hot_spots"]:
        console.print(_hot_spot_table(data["hot_spots"]))
        console.print()
    console.print("mean ± sd over episodes, [95 % interval of the mean]", style="dim")
    if (error := data["all"]["min_lap_error"]) is not None:
        exact = f", too long by up to {100.0 * error:.2f} % for two cars drawn at random" if error else ""
        console.print(
            f"lap / least: lap time over the minimum-time lap of the same track and vehicle{exact}", style="dim"
        )
    if trained_on:
        console.print(f"* trained on {', '.join(trained_on)}: not a result on unseen tracks")
    if data["crash_map"]:
        console.print(f"where they crashed: {data['crash_map']}")
    console.print(f"results: {data['folder']}")


DRIVING = ("crash_rate", "completed_laps", "lap_time_s", "lap_time_ratio", "mean_speed_mps")
RACING = ("crashes", "overtakes", "places_lost")
EPISODES = ("progress_m", "episode_steps", "episode_return")
HEADINGS = {
    "crash_rate": "crash rate", "completed_laps": "laps", "lap_time_s": "lap time [s]", "lap_time_ratio": "lap / least",
    "mean_speed_mps": "speed [m/s]", "progress_m": "progress [m]", "crashes": "crashes", "overtakes": "overtakes",
    "places_lost": "places lost", "episode_steps": "steps", "episode_return": "return",
}  # fmt: skip
DIGITS = {"progress_m": 0, "episode_steps": 0, "lap_time_s": 1, "lap_time_ratio": 3, "episode_return": 1}


def _table(data: Mapping[str, Any], columns: Sequence[str]) -> Table:
    summaries = {f"{name}{'*' * (name in data['trained_on'])}": each for name, each in data["tracks"].items()}
    rows = [(name, *(_cell(summary, column) for column in columns)) for name, summary in summaries.items()]
    of_all = [None, ("all", *(_cell(data["all"], column) for column in columns))] if len(rows) > 1 else []
    return table(("track", *(HEADINGS[column] for column in columns)), [*rows, *of_all], left=("track",))


def _cell(summary: Mapping[str, Any], column: str) -> str:
    if column == "crashes":
        into_cars = summary["contacts"]["car"]
        return f"{summary['outcomes']['crash']}" + (f"\n{into_cars} into cars" if into_cars else "")
    if column == "crash_rate":
        low, high = (100.0 * summary[f"crash_rate_{end}"] for end in ("low", "high"))
        return f"{100.0 * summary['crash_rate']:.1f} %\n[{low:.1f}, {high:.1f}]"
    value = summary[column]
    if not isinstance(value, Mapping):
        return str(value)
    if value["mean"] is None:
        return "-"
    digits = DIGITS.get(column, 2)
    if value["sd"] is None:
        return f"{value['mean']:.{digits}f}"
    return (
        f"{value['mean']:.{digits}f} ± {value['sd']:.{digits}f}\n"
        f"[{value['low']:.{digits}f}, {value['high']:.{digits}f}]"
    )
