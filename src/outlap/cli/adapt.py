"""`outlap adapt`."""

from __future__ import annotations

import hashlib
import shlex
import shutil
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from outlap.cli.arguments import check_least
from outlap.cli.interrupts import NOTHING_KEPT
from outlap.cli.output import CommandResult
from outlap.cli.progress import progress_bar
from outlap.cli.races import held_out_tracks, unused
from outlap.cli.recordings import RECORDINGS, record_episodes, with_recordings

if TYPE_CHECKING:
    from rich.console import Console

    from outlap.evaluation.results import Parts

Rule = Literal["abc", "fixed", "none"]
BEFORE, NO_SEED = "before", -1  # in place of a clip rule, and of an adaptation's seed


@dataclass(frozen=True)
class Adapt:
    """Adapt a meta-trained policy to tracks, and race it before and after on the same episodes.

    A task is a track with the run's cars, drawn anew in every episode. Every clip rule adapts from the same
    seeds, each time starting from the meta-policy, which stays as it is. Killed or interrupted, the same command with
    --out of what it had begun goes on there.
    """

    run_folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """A run folder of `outlap train mql`."""

    tracks: tuple[str, ...] = ()
    """Names or map folders; by default the run's held-out tracks, or else the built-in held-out ones."""

    clip: tuple[Rule, ...] = ("none", "fixed", "abc")
    """How propensity weights are clipped: Adaptive Beta Clipping, the original's fixed clip, or not."""

    seeds: int = 5
    """Adaptations to each track with each clip rule."""

    iterations: int = 10
    """Of each adaptation."""

    collect_steps: int = 100
    """Actions in the new task that each of --collect-worlds makes before every iteration."""

    collect_worlds: int = 8
    """Cars that collect."""

    on_task_steps: int = 5
    """Updates on the new task alone in every iteration."""

    replay_steps: int = 30
    """Updates on the weighted replay in every iteration."""

    learning_rate: float = 1e-4
    """Of the adaptation."""

    episodes: int = 100
    """Raced on each track before, and after each adaptation."""

    time_limit: float = 40.0
    """[s] of an episode."""

    seed: int = 0
    """Of the episodes, and the first of the adaptations."""

    record: int = 0
    """Of each track's episodes, keep so many, raced before and after the first adaptation with each clip rule, to be
    looked at with `outlap replay`, `outlap video` or `outlap plot`."""

    out: Path | None = None
    """A new folder for the results, or one in which the same adaptations were begun; by default RUN/adaptations/TIME.
    """

    quiet: FlagCreatePairsOff[bool] = False
    """Show no progress."""

    json: str | None = None
    """Write the result as JSON to this file; - for standard output."""

    def _settings(self) -> dict[str, Any]:
        """Flags that the results depend on."""
        aside = ("run_folder", "out", "quiet", "json")
        return {field.name: getattr(self, field.name) for field in fields(self) if field.name not in aside}

    @contextmanager
    def _kept(self, parts: Parts, folder: Path) -> Iterator[None]:
        """After Ctrl-C, say how to go on; without any part, empty the folder, so that the same command can begin."""
        try:
            yield
        except BaseException as error:
            again = f"saved; go on with: {self._again(folder)}"
            if parts.has(0):
                parts.close()
            else:
                parts.remove()
                shutil.rmtree(folder / RECORDINGS, ignore_errors=True)
                with suppress(OSError):
                    folder.rmdir()
                again = NOTHING_KEPT
            if isinstance(error, KeyboardInterrupt):
                print(f"\n{again}", file=sys.stderr)
            raise

    def _again(self, folder: Path) -> str:
        """The command that goes on in a folder."""
        words = ["outlap", "adapt", str(self.run_folder)]
        for name, value in self._settings().items():
            if value != getattr(Adapt, name):
                values = value if isinstance(value, tuple) else (value,)
                words += [f"--{name.replace('_', '-')}", *map(str, values)]
        return shlex.join([*words, "--out", str(folder)])

    def run(self) -> CommandResult:
        import pandas as pd

        from outlap.drivers.policy import PolicyDriver
        from outlap.envs.race_vector_env import RaceVectorEnv
        from outlap.envs.sb3_vec_env import SB3VecEnv
        from outlap.envs.terminations import CRASH
        from outlap.evaluation.metrics import summarise_methods
        from outlap.evaluation.results import UPDATES, Parts, save_results, write_rows
        from outlap.evaluation.rollout import evaluate, standing_starts
        from outlap.mql.adaptation import AdaptationSettings, adapt
        from outlap.mql.propensity import CLIP_RULES
        from outlap.provenance import provenance
        from outlap.track.catalog import load_tracks
        from outlap.training.run import load_meta, load_run

        for name in ("seeds", "iterations", "collect_steps", "collect_worlds", "episodes"):
            check_least(f"--{name.replace('_', '-')}", getattr(self, name), 1)
        check_least("--record", self.record, 0)
        run = load_run(self.run_folder)
        meta = load_meta(run)
        tracks = load_tracks(self.tracks or held_out_tracks(run))
        folder = self.out or unused(run.folder / "adaptations" / time.strftime("%Y%m%d-%H%M%S"))
        fingerprints = {track.name: track.fingerprint for track in tracks}
        races = standing_starts(run.config.env, tracks, 0, self.time_limit)
        collecting = run.config.env.model_copy(update={"augment_tracks": False})
        base = AdaptationSettings(
            iterations=self.iterations, collect_steps=self.collect_steps, on_task_steps=self.on_task_steps,
            replay_steps=self.replay_steps, learning_rate=self.learning_rate,
        )  # fmt: skip
        seeds = range(self.seed, self.seed + self.seeds)
        methods = [(BEFORE, NO_SEED), *((rule, seed) for seed in seeds for rule in self.clip)]
        policies = [(track, method, seed) for track in tracks for method, seed in methods]
        asked = {
            **self._settings(), "tracks": fingerprints, "run": run.config, "versions": provenance()["versions"],
            "policy": hashlib.sha256(run.policy_path.read_bytes()).hexdigest(),
        }  # fmt: skip
        parts = Parts(folder, asked)
        with (
            self._kept(parts, folder),
            progress_bar("adapting", len(policies), "policies", self.quiet) as update,
        ):
            for number, (track, method, seed) in enumerate(policies):
                if not parts.has(number):
                    policy, updates = meta, None
                    if method != BEFORE:
                        task = SB3VecEnv(RaceVectorEnv(self.collect_worlds, collecting, [track]))
                        task.env.training_steps = meta.num_timesteps  # curricula go on where training ended
                        task.seed(10_000 + seed)
                        policy, record = adapt(meta, task, replace(base, clip=CLIP_RULES[method]()), seed=seed)
                        updates = pd.DataFrame(record.updates).assign(method=method, seed=seed, track=track.name)
                    driver = PolicyDriver(policy, scale_observations=races.scale_observations, name=method)
                    raced = evaluate(driver, races, [track], self.episodes, self.seed)
                    if seed in (NO_SEED, self.seed):
                        recorded = min(self.record, self.episodes)
                        suffix = f"-{methods.index((method, seed))}-{method}"
                        place = folder / RECORDINGS
                        record_episodes(driver, races, track, self.seed, recorded, place, method, suffix)
                    parts.put(number, raced.assign(method=method, adaptation_seed=seed), updates)
                crashes = (parts.rows(number)["outcome"] == CRASH).mean()
                update(number + 1, f"{method} on {track.name}: {crashes:.1%} crashes")
        everything = parts.all_rows()
        summary = summarise_methods(everything)
        write_rows(parts.all_updates(), folder / UPDATES)
        save_results(folder, everything, summary, {**provenance(), "settings": self, "tracks": fingerprints})
        parts.remove()
        data = {**summary, "folder": folder}
        result = CommandResult(data, lambda console: _print(console, data))
        return with_recordings(result, folder, tracks[0]) if self.record else result


def _print(console: Console, data: Mapping[str, Any]) -> None:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, title="before and after adapting")
    for heading in ("method", "track", "crash rate [%]", "speed [m/s]", "lap / least", "progress [m]"):
        table.add_column(heading, justify="left" if heading in ("method", "track") else "right")
    for method, summary in data.items():
        if method == "folder":
            continue
        for track, each in [*summary["tracks"].items(), ("all", summary["all"])]:
            crashes = _cell(each["crash_rate"], 100.0, 1)
            speed, progress = _cell(each["mean_speed_mps"], 1.0, 2), _cell(each["progress_m"], 1.0, 0)
            ratio = _cell(each["lap_time_ratio"], 1.0, 3)
            table.add_row(method, track, crashes, speed, ratio, progress, end_section=track == "all")
    console.print(table)
    console.print("mean over adaptation seeds [95 % interval]", style="dim")
    console.print(f"results: {data['folder']}", highlight=False, markup=False, soft_wrap=True)


def _cell(value: Mapping[str, float], scale: float, digits: int) -> str:
    if value["mean"] is None:  # nobody came so far
        return "-"
    mean = f"{scale * value['mean']:.{digits}f}"
    if value["low"] is None:  # one seed has no interval
        return mean
    return f"{mean} [{scale * value['low']:.{digits}f}, {scale * value['high']:.{digits}f}]"
