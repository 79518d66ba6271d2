"""An hour of mixed training at full speed: whether memory and throughput stay what they are.

    python benchmarks/soak.py --minutes 60 --out soak.json

Two processes, one core each. One meta-trains against opponents for the whole time, in one training. The other begins
a new training every few minutes, PPO and RecurrentPPO by turns, and races what it has trained, so that whatever is not
given back adds up. Circuits are those of OUTLAP_TRACKS where there are any.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from outlap.cli.progress import progress_bar
from outlap.envs.race_config import RaceConfig
from outlap.evaluation.protocol import standing_starts
from outlap.evaluation.rollout import evaluate
from outlap.experiments.definitions import changed
from outlap.experiments.engine import ONE_THREAD
from outlap.files import atomic_write, to_json
from outlap.processes import process_environment
from outlap.provenance import provenance
from outlap.track.catalog import list_tracks, load_track
from outlap.track.generate import BUILTIN_TRAIN
from outlap.training.config import TrainingConfig
from outlap.training.mql import MQLConfig
from outlap.training.ppo import PPOConfig, RecurrentPPOConfig
from outlap.training.session import train

TURN = 300.0  # [s] of each training of the second process
SAMPLE = 10.0  # [s] between two samples
WARM = 600.0  # [s] in which replays fill, kernels are compiled, libraries loaded
REPLAY = 100_000  # transitions: full within the first minutes
ENDLESS = 1_000_000_000  # actions


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--out", type=Path, default=Path("soak.json"))
    arguments = parser.parse_args()
    seconds = 60.0 * arguments.minutes
    context = multiprocessing.get_context("spawn")
    samples = context.Queue()
    with process_environment(**ONE_THREAD):
        workers = [context.Process(target=each, args=(seconds, samples)) for each in (meta_train, take_turns)]
        for worker in workers:
            worker.start()
    found: dict[str, list[dict[str, Any]]] = {}
    begun = time.monotonic()
    with progress_bar("soaking", round(seconds), "s") as update:
        while any(worker.is_alive() for worker in workers) or not samples.empty():
            if samples.empty():
                time.sleep(1.0)
                update(round(min(time.monotonic() - begun, seconds)), "")
            else:
                name, sample = samples.get()
                found.setdefault(name, []).append(sample)
    summary = {name: summarise(rows) for name, rows in found.items()}
    atomic_write(arguments.out, to_json({"record": provenance(), "summary": summary, "samples": found}) + "\n")
    print(json.dumps(summary, indent=2))


def meta_train(seconds: float, samples: Any) -> None:
    """One Meta-Q-Learning, with opponents."""
    config = MQLConfig(env=environment(num_cars=2), total_steps=ENDLESS, threads=1, buffer_size=REPLAY)
    until(config, seconds, sampler("mql, one training", samples))


def take_turns(seconds: float, samples: Any) -> None:
    """New trainings of PPO and RecurrentPPO, each raced at its end."""
    end = time.monotonic() + seconds
    sample = {
        "ppo": sampler("ppo, new trainings", samples),
        "recurrent-ppo": sampler("recurrent-ppo, new trainings", samples),
    }
    turn = 0
    while (left := end - time.monotonic()) > SAMPLE:
        cls = (PPOConfig, RecurrentPPOConfig)[turn % 2]
        config = cls(env=environment(num_cars=1), total_steps=ENDLESS, threads=1, seed=turn)
        until(config, min(TURN, left), sample[config.algorithm], race=True)
        turn += 1


def environment(num_cars: int) -> RaceConfig:
    """Circuits, and a car drawn anew in every episode."""
    real = [entry.name for entry in list_tracks() if entry.source == "folder"]
    return changed(
        PPOConfig().env,
        {
            "tracks": real[:6] or BUILTIN_TRAIN,
            "num_cars": num_cars,
            "opponents": ["follow-the-gap"] if num_cars > 1 else [],
            "vehicle": {"mu": [0.5, 1.1], "m": [2.8, 4.6]},
        },
    )


def until(config: TrainingConfig, seconds: float, sample: Callable[[int, float], None], race: bool = False) -> None:
    """Train for so long, and perhaps race a little."""
    begun = time.monotonic()

    def on_progress(progress: Any) -> None:
        sample(progress.steps, time.monotonic() - begun)
        if time.monotonic() - begun > seconds:
            raise KeyboardInterrupt

    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "run"
        with contextlib.suppress(KeyboardInterrupt):
            train(config, folder, on_progress=on_progress)
        if race:
            from outlap.training.run import load_run

            track = load_track(config.env.tracks[0])
            evaluate(load_run(folder).driver(), standing_starts(config.env, [track], 0, 5.0), [track], 20, seed=0)


def sampler(name: str, samples: Any) -> Callable[[int, float], None]:
    """Notes, every few seconds, the time, the memory, and how fast steps were made."""
    begun = time.monotonic()
    last: tuple[int, float, float] | None = None  # steps, and seconds by the clock and of the processor

    def sample(steps: int, seconds: float) -> None:
        nonlocal last
        now = steps, time.monotonic(), time.process_time()
        if last is None or steps < last[0]:  # a new training
            last = now
        elif now[1] - last[1] >= SAMPLE:
            made, clock, processor = (b - a for a, b in zip(last, now, strict=True))
            row = {
                "seconds": now[1] - begun,
                "of_training": seconds,
                "memory_mb": resident() / 1e6,
                "steps_per_second": made / clock,
                "steps_per_core_second": made / processor,
            }
            samples.put((name, row))
            last = now

    return sample


def resident() -> int:
    """[bytes] of memory that this process has."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096


def summarise(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Means of the first and the last third of what came after the warm-up, and what lies between them."""
    rows = [row for row in rows if row["seconds"] > WARM]
    if len(rows) < 6:
        return {"samples": len(rows)}
    third = len(rows) // 3
    found: dict[str, Any] = {"samples": len(rows)}
    for key in ("memory_mb", "steps_per_second", "steps_per_core_second"):
        first, last = (sum(row[key] for row in part) / third for part in (rows[:third], rows[-third:]))
        found[key] = {
            "first_third": round(first, 1),
            "last_third": round(last, 1),
            "change_percent": round(100 * (last / first - 1), 2),
            "least": round(min(row[key] for row in rows), 1),
            "most": round(max(row[key] for row in rows), 1),
        }
    return found


if __name__ == "__main__":
    main()
