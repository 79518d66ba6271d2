"""Draw the test cars that outlap ships, and write a csv file for each split.

python benchmarks/draw_cars.py --out src/outlap/envs/cars
"""

from __future__ import annotations

import argparse
from pathlib import Path

from outlap.evaluation.car_splits import SHELLS, draw_split
from outlap.files import atomic_write
from outlap.track.catalog import load_tracks
from outlap.track.generate import BUILTIN_HELD_OUT


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw the test cars that outlap ships.")
    parser.add_argument("--out", type=Path, required=True, help="folder of the csv files")
    parser.add_argument("--cars", type=int, default=100, help="cars of each split")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    tracks = list(load_tracks(BUILTIN_HELD_OUT))
    for split in SHELLS:
        cars, redrawn = draw_split(split, arguments.cars, arguments.seed, tracks)
        lines = [
            f"# {split}: {cars.size} cars, seed {arguments.seed}; {redrawn} that no planner could drive were redrawn",
            ",".join(cars.parameters),
            *(",".join(f"{value:.6g}" for value in row) for row in cars.values),
        ]
        atomic_write(arguments.out / f"{split}.csv", "\n".join(lines) + "\n")
        print(lines[0])


if __name__ == "__main__":
    main()
