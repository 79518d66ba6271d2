"""`outlap raceline`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from outlap.cli.command import LongCommand
from outlap.cli.output import CommandResult
from outlap.errors import OutlapError

if TYPE_CHECKING:
    from rich.console import Console

    from outlap.planning.limits import CarLimits
    from outlap.simulator.vehicle import VehicleParams
    from outlap.track import Track


@dataclass(frozen=True)
class PlanRaceline(LongCommand):
    """Plan the fastest line around a track for a car: an F1TENTH raceline csv, a picture, and its lap time."""

    track: Positional[str]
    """Name, map folder or centreline csv."""

    vehicle: str = "f1tenth"
    """The car: a preset (f1tenth, paper), a yaml file of its parameters, a run folder, whose car it is; of ranges, the
    middle counts. Or track: what the track's own raceline asks of a car."""

    method: Literal["centerline", "min-curvature", "min-time"] = "min-time"
    """Of finding the line; its speeds are always the fastest that the car can drive on it."""

    v_max: float | None = None
    """[m/s] top speed, in place of the car's."""

    mu: float | None = None
    """Friction, in place of the car's."""

    a_max: float | None = None
    """[m/s²] with which it accelerates and brakes, in place of the car's."""

    a_brake: float | None = None
    """[m/s²] with which it brakes, where that differs from --a-max."""

    margin: float | None = None
    """[m] to keep from the walls, on either side of the car; 0.15 by default, what pure pursuit can do with."""

    friction: Path | None = None
    """A csv of friction that differs from place to place: s_m, d_m, mu for a grid along and across the centreline."""

    out: Path | None = None
    """The csv; NAME_raceline.csv here by default. The picture goes beside it, as .png. Older ones are replaced."""

    def run(self) -> CommandResult:
        from outlap.planning.friction import FrictionMap
        from outlap.planning.plan import DEFAULT_MARGIN, plan_line
        from outlap.track import load_track
        from outlap.track.map_io import write_raceline_csv

        for flag in ("v_max", "mu", "a_max", "a_brake"):
            value = getattr(self, flag)
            if value is not None and not 0.0 < value < float("inf"):
                raise OutlapError(f"--{flag.replace('_', '-')} is {value}; must be > 0")
        track = load_track(self.track)
        limits = self._limits(track)
        friction = None if self.friction is None else FrictionMap.read(self.friction, track.centerline.length)
        if friction is not None and self.mu is not None:
            raise OutlapError(f"--mu is {self.mu}; {self.friction} says what friction is where, give one of them")
        out = self.out or Path(f"{track.name}_raceline.csv")
        if self.out is None and Path(f"{track.name}_map.yaml").is_file():
            raise OutlapError(f"{out}: belongs to the map in this folder; to replace it, give --out {out}")
        picture = out.with_suffix(".png")
        if out.is_dir() or out.suffix.lower() != ".csv":
            raise OutlapError(f"--out is {out}; must be a file that ends in .csv")
        margin = DEFAULT_MARGIN if self.margin is None else self.margin
        line = plan_line(track, limits, self.method, margin, friction)
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            write_raceline_csv(line.raceline, out)
            from outlap.viewer.plots import draw_raceline  # Matplotlib: not before it is needed

            draw_raceline(track, line.raceline, picture, line.lap_time)
        except OSError as error:
            raise OutlapError(f"--out {out}: cannot be written: {error.strerror}") from error
        data: dict[str, Any] = {
            "track": track.name,
            "method": line.method,
            "lap_time_s": round(line.lap_time, 4),
            "length_m": round(line.path.length, 3),
            "solve_time_s": round(line.solve_time, 2),
            "min_margin_m": round(line.min_margin, 4),
            "own_lap_time_s": None if track.raceline is None else round(track.raceline.lap_time, 4),
            "limits": limits,
            "raceline": out,
            "picture": picture,
        }

        def show(console: Console) -> None:
            console.print(
                f"{track.name}, {line.method}: {line.lap_time:.2f} s for {line.path.length:.1f} m, "
                f"{line.speed.min():.1f} to {line.speed.max():.1f} m/s; at least {line.min_margin:.2f} m from the "
                f"walls; planned in {line.solve_time:.1f} s",
            )  # fmt: skip
            if track.raceline is not None:
                console.print(f"the track's own raceline: {track.raceline.lap_time:.2f} s")
            for what, path in (("raceline", out), ("picture", picture)):
                console.print(f"{what}: {path}")

        return CommandResult(data, show)

    def _limits(self, track: Track) -> CarLimits:
        from outlap.planning.limits import CarLimits
        from outlap.simulator.vehicle import VehicleParams

        if self.vehicle == "track":
            if track.raceline is None:
                raise OutlapError(f"--vehicle is 'track'; {track.name} has no raceline that could ask anything")
            limits = CarLimits.of(VehicleParams()).implied_by(track.raceline)
        else:
            limits = CarLimits.of(find_vehicle(self.vehicle))
        changes = {name: value for name in ("v_max", "mu", "a_max") if (value := getattr(self, name)) is not None}
        if self.a_max is not None or self.a_brake is not None:
            changes["a_brake"] = self.a_brake or self.a_max
        return replace(limits, **changes)


def find_vehicle(name: str) -> VehicleParams:
    """The car that a preset, a yaml file or a run folder has.

    Raises OutlapError for a name that is none of these.
    """
    from outlap.config import load_config
    from outlap.simulator.vehicle import PRESETS, VehicleParams
    from outlap.training.run import load_run

    if name in PRESETS:
        return PRESETS[name]
    path = Path(name)
    if path.suffix.lower() in (".yaml", ".yml"):
        return load_config(VehicleParams, path)
    if (path / "config.yaml").is_file():
        return load_run(path).config.env.vehicle
    raise OutlapError(f"--vehicle is {name!r}; must be one of {', '.join(PRESETS)}, a yaml file, a run folder or track")
