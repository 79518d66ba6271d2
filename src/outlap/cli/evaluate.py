"""`outlap evaluate`."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from outlap.cli.arguments import check_least
from outlap.cli.output import CommandResult
from outlap.config import bounds
from outlap.drivers.find import find_drivers
from outlap.errors import OutlapError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from outlap.drivers.driver import Driver
    from outlap.envs.race_config import RaceConfig
    from outlap.evaluation.rollout import EvaluationProgress
    from outlap.track import Track
    from outlap.training.run import Run

Flag = FlagCreatePairsOff[bool]


@dataclass(frozen=True)
class Evaluate:
    """Race a driver on tracks, from a standstill anywhere on the lap, and measure it.

    The episodes are settled in advance by --seed, the same ones for every driver. The car is that of the
    training, with its ranges. The paper's protocol: --laps 0 --time-limit 5 --episodes 500.
    """

    driver: Annotated[Positional[str], arg(metavar="RUN")]
    """A run folder of `outlap train`, an opponent such as population/NAME, or a driver without one: pure-pursuit."""

    task: str | None = None
    """A run folder: race as in its training, its cars with their ranges, on its held-out tracks; of a driver that has a
    scanner and a top speed of its own, those stay. By default the driver's own task."""

    tracks: tuple[str, ...] = ()
    """Names or map folders; by default the run's held-out tracks, or else the built-in held-out ones."""

    episodes: int = 100
    """On each track."""

    laps: int = 3
    """Completed laps that end an episode, counted from line to line; 0: none do."""

    time_limit: float | None = None
    """[s] of an episode; by default enough for one lap more than --laps at 1 m/s."""

    v_max: float | None = None
    """[m/s] top speed of the cars, in place of the run's; what the policy commands stays within what it learnt."""

    num_cars: int | None = None
    """The driver's car and opponents; by default as many as the run was trained with."""

    opponents: tuple[str, ...] = ()
    """Drivers and populations to draw opponents from, in place of the run's; one where the run had none."""

    opponent_code: Flag = False
    """Load opponents that can run code when they are loaded: run folders, module:function."""

    opponent_split: Literal["train", "held_out"] = "held_out"
    """The half of a population that opponents are drawn from."""

    racing_line: Literal["track", "min-curvature", "min-time"] | None = None
    """That pure pursuit follows, in place of the run's: the track's own, or one planned for the car."""

    formation: Literal["queue", "behind", "grid", "scattered"] | None = None
    """In which the cars start, in place of the run's; behind: the driver's car is the last."""

    seed: int = 0
    """Of the episodes."""

    worlds: int = 128
    """Episodes raced at once; changes the speed, and not the results."""

    stochastic: Flag = False
    """Draw actions from the policy's distribution, as in training; then results depend on --worlds too."""

    out: Path | None = None
    """A new or empty folder for the results; by default RUN/evaluations/TIME."""

    quiet: Flag = False
    """Show no progress."""

    json: str | None = None
    """Write the result as JSON to this file; - for standard output."""

    def run(self) -> CommandResult:
        self._check_flags()
        from outlap.envs.tasks import load_tracks
        from outlap.evaluation.rollout import made_for, standing_starts
        from outlap.training.run import load_run

        if self.stochastic and not is_run(self.driver):
            raise OutlapError(f"--stochastic is for a trained run; {self.driver} draws nothing")
        driver, trained_env, run = find_subject(self.driver, deterministic=not self.stochastic, seed=self.seed)
        task = run
        if self.task is not None:
            task = load_run(self.task)
            trained_env = made_for(driver, task.config.env)
        tracks = load_tracks(self.tracks or held_out_tracks(task))
        env = self._as_asked(with_top_speed(trained_env, self.v_max))
        if self.racing_line and env.num_cars == 1 and "line_ahead" not in driver.observation_terms:
            raise OutlapError(f"--racing-line is {self.racing_line}; {driver.name} follows no line")
        env = standing_starts(env, tracks, self.laps, self.time_limit)
        home = run.folder if run else Path("runs") / driver.name
        folder = self.out or unused(home / "evaluations" / time.strftime("%Y%m%d-%H%M%S"))
        return evaluate_into(
            folder,
            driver,
            env,
            tracks,
            episodes=self.episodes,
            seed=self.seed,
            num_worlds=self.worlds,
            run=run,
            facts={"stochastic": self.stochastic},
            quiet=self.quiet,
        )

    def _check_flags(self) -> None:
        for flag, value, least in (
            ("--episodes", self.episodes, 1),
            ("--laps", self.laps, 0),
            ("--seed", self.seed, 0),
            ("--worlds", self.worlds, 1),
            ("--num-cars", 1 if self.num_cars is None else self.num_cars, 1),
        ):
            check_least(flag, value, least)
        for flag, number in (("--time-limit", self.time_limit), ("--v-max", self.v_max)):
            if number is not None and not 0.0 < number < float("inf"):
                raise OutlapError(f"{flag} is {number}; must be > 0")
        if self.laps == 0 and self.time_limit is None:
            raise OutlapError("--laps is 0; must be 1 or more, or be given with a --time-limit")

    def _as_asked(self, env: RaceConfig) -> RaceConfig:
        changes: dict[str, Any] = {"opponent_split": self.opponent_split}
        if self.num_cars is not None:
            changes["num_cars"] = self.num_cars
        if self.opponents:
            changes |= {"num_cars": max(2, env.num_cars), **changes, "opponents": self.opponents}
        if self.opponent_code:
            changes["opponent_code"] = True
        if self.racing_line is not None:
            changes["racing_line"] = self.racing_line
        if self.formation:
            changes["start"] = env.start.model_copy(update={"formation": self.formation})
        return env.model_copy(update=changes)


def is_run(name: str) -> bool:
    """Whether a driver's name is that of a run folder."""
    return (Path(name) / "config.yaml").is_file()


def find_subject(name: str, *, deterministic: bool = True, seed: int = 0) -> tuple[Driver, RaceConfig, Run | None]:
    """The one driver that a name stands for, the environment that it is made for, and its run if it has one.

    Args:
        name: a run folder, or what `drivers.find` knows.
        deterministic, seed: see `PolicyDriver`; of a run's policy.

    Raises OutlapError for a name that stands for nobody, or for many.
    """
    from outlap.evaluation.rollout import made_for
    from outlap.training.ppo import PPOConfig
    from outlap.training.run import load_run

    if is_run(name):
        run = load_run(name)
        return run.driver(deterministic=deterministic, seed=seed), run.config.env, run
    env = PPOConfig().env
    drivers = find_drivers([name], env.field_of_view, split=None, run_code=True)
    if len(drivers) > 1:
        names = ", ".join(driver.name for driver in drivers)
        raise OutlapError(f"{name}: is a population; name one of its drivers, {name}/NAME: {names}")
    return drivers[0], made_for(drivers[0], env), None


def evaluate_into(
    folder: Path,
    driver: Driver,
    env: RaceConfig,
    tracks: Sequence[Track],
    *,
    episodes: int,
    seed: int,
    num_worlds: int,
    run: Run | None = None,
    facts: Mapping[str, Any] | None = None,
    quiet: bool = False,
) -> CommandResult:
    """Evaluate with a progress bar and leave rows, summary and record in a folder.

    Args:
        folder: new or empty; removed again if the evaluation does not come to its end.
        driver: to evaluate.
        env: the task, see `rollout.standing_starts`.
        tracks: to evaluate on.
        episodes: on each track.
        seed, num_worlds: see `rollout.evaluate`.
        run: of the driver, if it has one: tracks that it was trained on are named as such.
        facts: more for the record.
        quiet: show no progress.

    Raises OutlapError for a folder that is not empty or cannot be written, and what `evaluate` raises.
    """
    from outlap.cli.progress import progress_bar
    from outlap.evaluation.metrics import summarise
    from outlap.evaluation.results import prepare_folder, save_results
    from outlap.evaluation.rollout import evaluate
    from outlap.training.run import provenance

    prepare_folder(folder)
    begun = time.monotonic()
    try:
        with progress_bar("evaluating", episodes * len(tracks), "episodes", quiet) as update:

            def show(progress: EvaluationProgress) -> None:
                rate = progress.steps / max(time.monotonic() - begun, 1e-9)
                update(int(progress.done), f"{progress.finished} finished  {rate:,.0f} steps/s")

            rows = evaluate(driver, env, tracks, episodes, seed, num_worlds, show)
    except BaseException:
        with suppress(OSError):
            folder.rmdir()  # it is empty
        raise
    names = [track.name for track in tracks]
    trained_on = _trained_on(run, names)
    summary = {**summarise(rows), "trained_on": trained_on}
    record = {
        **provenance(),
        "seconds": round(time.monotonic() - begun, 1),
        "driver": driver.name,
        **_policy_record(run),
        "tracks": {track.name: track.fingerprint for track in tracks},
        "trained_on": trained_on,
        "episodes_per_track": episodes,
        "seed": seed,
        "worlds": num_worlds,
        **(facts or {}),
        "env": env.model_dump(mode="json"),
    }
    save_results(folder, rows, summary, record)
    data = {**summary, "driver": driver.name, "folder": folder}
    return CommandResult(data, lambda console: show_summary(console, data))


def show_summary(console: Console, data: Mapping[str, Any]) -> None:
    """Print what an evaluation found, and where it is."""
    trained_on = data["trained_on"]
    each = next(iter(data["tracks"].values()))["episodes"]
    console.print(
        f"{data['driver']}: {each} episodes on each track, {data['all']['episodes']} in all",
        highlight=False, markup=False,
    )  # fmt: skip
    for columns in (DRIVING, RACING, EPISODES):
        console.print()
        console.print(_table(data, columns))
    console.print()
    console.print(
        "mean ± sd over episodes, [95 % interval of the mean]",
        style="dim", highlight=False, markup=False,
    )  # fmt: skip
    if (error := data["all"]["min_lap_error"]) is not None:
        exact = f", too long by up to {100.0 * error:.2f} % for two cars drawn at random" if error else ""
        console.print(
            f"lap / least: lap time over the minimum-time lap of the same track and vehicle{exact}",
            style="dim", highlight=False, markup=False,
        )  # fmt: skip
    if trained_on:
        console.print(
            f"* trained on {', '.join(trained_on)}: not a result on unseen tracks", highlight=False, markup=False
        )
    console.print(f"results: {data['folder']}", highlight=False, markup=False, soft_wrap=True)


DRIVING = ("crash_rate", "completed_laps", "lap_time_s", "lap_time_ratio", "mean_speed_mps")
RACING = ("crashes", "overtakes", "places_lost")
EPISODES = ("progress_m", "episode_steps", "episode_return")
DIGITS = {"progress_m": 0, "episode_steps": 0, "lap_time_s": 1, "lap_time_ratio": 3, "episode_return": 1}
HEADINGS = {
    "crash_rate": "crash rate",
    "completed_laps": "laps",
    "lap_time_s": "lap time [s]",
    "lap_time_ratio": "lap / least",
    "mean_speed_mps": "speed [m/s]",
    "progress_m": "progress [m]",
    "crashes": "crashes",
    "overtakes": "overtakes",
    "places_lost": "places lost",
    "episode_steps": "steps",
    "episode_return": "return",
}


def _table(data: Mapping[str, Any], columns: Sequence[str]) -> Table:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False, pad_edge=False)
    table.add_column("track", overflow="fold")
    for column in columns:
        table.add_column(Text(HEADINGS[column]), justify="right", no_wrap=True)
    for name, summary in data["tracks"].items():
        mark = "*" if name in data["trained_on"] else ""
        table.add_row(Text(name + mark), *(_cell(summary, column) for column in columns))
    if len(data["tracks"]) > 1:
        table.add_section()
        table.add_row("all", *(_cell(data["all"], column) for column in columns))
    return table


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


def held_out_tracks(run: Run | None) -> tuple[str, ...]:
    """Names of the tracks that a run has kept from its training, or else the built-in ones."""
    from outlap.track.generate import BUILTIN_HELD_OUT

    return (run.config.held_out_tracks if run else ()) or BUILTIN_HELD_OUT


def with_top_speed(env: RaceConfig, v_max: float | None) -> RaceConfig:
    """The task with another top speed of the cars; actions go on to mean the speeds that they were trained with."""
    if v_max is None:
        return env
    vehicle = env.vehicle.model_copy(update={"v_max": v_max})
    speeds = env.speed_range or (bounds(env.vehicle.v_min)[0], None)
    if speeds[1] is None:
        speeds = (speeds[0], bounds(env.vehicle.v_max)[1])
    return env.model_copy(update={"vehicle": vehicle, "speed_range": speeds})


def _trained_on(run: Run | None, tracks: Sequence[str]) -> list[str]:
    """Those of the tracks that the run was trained on."""
    from outlap.track.catalog import name_key
    from outlap.track.generate import BUILTIN_TRAIN

    if run is None:
        return []
    trained = {name_key(Path(name).name) for name in run.config.env.tracks or BUILTIN_TRAIN}
    return [name for name in tracks if name_key(name) in trained]


def _policy_record(run: Run | None) -> dict[str, Any]:
    if run is None:
        return {}
    path = run.policy_path
    return {
        "run": run.folder.resolve(),
        "policy": path.relative_to(run.folder),
        "policy_sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
    }


def unused(folder: Path) -> Path:
    """This folder, or one numbered like it where two evaluations begin in the same second."""
    numbered = (folder.with_name(f"{folder.name}-{i}") for i in range(2, 1000))
    return next(path for path in (folder, *numbered) if not path.exists())
