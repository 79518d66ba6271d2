"""`outlap benchmark adaptation`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic.dataclasses import dataclass
from tyro.conf import Positional, arg

from outlap.cli.command import Count
from outlap.cli.output import CommandResult, dated_folder, table
from outlap.cli.work import WorkCommand

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class BenchmarkAdaptation(WorkCommand):
    """Let drivers live in cars and on circuits that they never met, and compare them with a blind driver and an oracle.

    A life begins at a standstill on the start line and lasts three laps; memory is kept, and a crash ends it. Runs that
    differ in nothing but their seed are one method. After a kill or Ctrl-C, the same command with the same --out
    resumes.
    """

    drivers: Annotated[Positional[tuple[str, ...]], arg(metavar="RUN")] = ()
    """Run folders, or names of drivers such as follow-the-gap."""

    blind: tuple[str, ...] = ()
    """Runs that observe nothing of the car's parameters: the lower end of the gap."""

    oracle: tuple[str, ...] = ()
    """Runs that observe the car's parameters: the upper end of the gap."""

    lives: tuple[Path, ...] = ()
    """Files lives.parquet of methods from elsewhere, for the same table."""

    split: Literal["inside", "edge", "outside", "hard"] = "outside"
    """The test cars, by their distance from the training ranges."""

    cars: Count = 40
    """Cars of the split."""

    tracks: tuple[str, ...] = ()
    """Names or map folders; by default the first blind run's held-out tracks, or else the built-in held-out ones."""

    protocol: Literal["life", "practice"] = "life"
    """A life, or 60 s of driving with a fresh car after each crash before it."""

    seed: int = 0
    """Of sensor noise and of the bootstrap."""

    out: Path | None = None
    """A new folder for the results, or one in which the same benchmark was begun; by default benchmarks/TIME."""

    def run(self) -> CommandResult:
        from outlap.errors import OutlapError
        from outlap.experiments.adaptation import prepare_adaptations
        from outlap.experiments.outlap_benchmark import lives_units, write_benchmark
        from outlap.training.run import load_run
        from outlap.training.subject import held_out_tracks

        self.check_flags()
        if not self.blind:
            raise OutlapError("--blind: none given; name the runs that know nothing of the car, such as PPO's")
        reference = load_run(self.blind[0])
        names = self.tracks or held_out_tracks(reference)
        drivers = [*self.blind, *self.oracle, *self.drivers]
        units = lives_units(drivers, reference.config.env, names, f"{self.split}:{self.cars}", self.protocol, self.seed)
        blind = units[0].method
        oracle = next((unit.method for unit in units if self.oracle and unit.driver == self.oracle[0]), None)
        folder = self.out or dated_folder(Path("benchmarks"))
        prepare_adaptations(folder)
        self.do_units(units, folder / "work", "living", resume=f"go on with the same command and --out {folder}")
        data = write_benchmark(units, folder, blind, oracle, self.seed, self.lives)
        return CommandResult(data, lambda console: _print(console, data))


def _print(console: Console, data: Mapping[str, Any]) -> None:
    headings = ("method", "n", "survive [%]", "lap 2 / min", "J [m]", "gap")  # p is in the JSON: 80 columns are few
    rows: list[tuple[str, ...] | None] = []
    for name, each in data["methods"].items():
        gap = each["recovered_gap"]
        rows.append(
            (
                name, str(each["trainings"]), _cell(each["survival"]["lap_3"], 100.0, 0),
                _cell(each["lap_time_ratio"]["lap_2"], 1.0, 2), _cell(each["distance_m"], 1.0, 0),
                "-" if gap is None else _cell(gap, 1.0, 2),
            )
        )  # fmt: skip
    title = f"{data['cars']} cars of the split {data['split']} on {', '.join(data['tracks'])}"
    console.print(table(headings, rows, ("method",), title))
    console.print("n: trainings; survive: cars that completed three laps; min: the car's minimum-time lap", style="dim")
    console.print("J: driven between 1.5 and 3.5 of those; gap: recovered of that from blind to oracle", style="dim")
    console.print("[95 % interval of a bootstrap over trainings and cars]", style="dim", markup=False)
    console.print(f"results: {data['folder']}")


def _cell(value: Mapping[str, float], scale: float, digits: int) -> str:
    numbers = [value[name] for name in ("value", "low", "high")]
    if numbers[0] != numbers[0]:  # NaN: nobody completed that lap
        return "-"
    mean, low, high = (f"{scale * number:.{digits}f}" for number in numbers)
    return f"{mean}\n[{low}, {high}]"
