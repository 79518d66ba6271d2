"""Two outlap processes at the same time, and how fast each is compared with alone.

    python benchmarks/side_by_side.py --seconds 5 --steps 200000

Two simulator benchmarks run beside each other, and evaluations beside a training. A fraction of 0.5 is what two
processes on the same cores can reach. Prints JSON.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median
from typing import Any

from outlap.provenance import machine

OUTLAP = (sys.executable, "-m", "outlap")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=5.0, help="of each of three simulator measurements")
    parser.add_argument("--steps", type=int, default=200_000, help="of the training")
    parser.add_argument("--episodes", type=int, default=100, help="of each evaluation, on each track")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = {
            "simulators": simulators(arguments.seconds),
            **evaluation_and_training(Path(folder), arguments.steps, arguments.episodes),
            "machine": machine(),
        }
    print(json.dumps(found, indent=2))


def start(*words: object) -> subprocess.Popen[str]:
    command = [*OUTLAP, *map(str, words), "--quiet", "--json", "-"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def result(process: subprocess.Popen[str]) -> dict[str, Any]:
    """Wait for a command and return its JSON."""
    output, _ = process.communicate()
    if process.returncode:
        raise SystemExit(f"{process.args}: failed with exit code {process.returncode}")
    return json.loads(output)


def simulators(seconds: float) -> dict[str, Any]:
    """Measure the simulator alone, and then twice at the same time."""

    def begin() -> subprocess.Popen[str]:
        return start("benchmark", "simulator", "--cars", 1, "--beams", 108, "--seconds", seconds)

    def speed(process: subprocess.Popen[str]) -> float:
        return result(process)["rows"][0]["env_steps_per_second"]

    speed(begin())  # compiles
    alone = speed(begin())
    beside = [speed(process) for process in [begin(), begin()]]
    return {
        "alone_env_steps_per_second": alone,
        "beside_env_steps_per_second": beside,
        "fractions": [round(each / alone, 3) for each in beside],
    }


def evaluation_and_training(folder: Path, steps: int, episodes: int) -> dict[str, Any]:
    """Measure a training and an evaluation, each alone, and then evaluations for as long as the training lasts."""

    def train(name: str) -> subprocess.Popen[str]:
        return start("train", "ppo", "--total-steps", steps, "--out", folder / name)

    def evaluate(name: str) -> float:
        result(start("evaluate", folder / "alone", "--episodes", episodes, "--out", folder / name))
        return json.loads((folder / name / "evaluation.json").read_text())["seconds"]

    training_alone = result(train("alone"))["env_steps_per_second"]
    evaluate("evaluation-first")  # compiles, and plans lines
    evaluation_alone = evaluate("evaluation-alone")
    process = train("beside")
    taken = []
    while process.poll() is None:
        taken.append(evaluate(f"evaluation-{len(taken)}"))
    training_beside = result(process)["env_steps_per_second"]
    if len(taken) < 2:
        raise SystemExit("the training was over before one evaluation: give more --steps, or fewer --episodes")
    evaluation_beside = median(taken[:-1])  # the last one was alone for a while
    return {
        "training": {
            "alone_env_steps_per_second": training_alone,
            "beside_env_steps_per_second": training_beside,
            "fraction": round(training_beside / training_alone, 3),
        },
        "evaluation": {
            "alone_s": evaluation_alone,
            "beside_s": evaluation_beside,
            "fraction": round(evaluation_alone / evaluation_beside, 3),
        },
    }


if __name__ == "__main__":
    main()
