"""`outlap raceline`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic.dataclasses import dataclass
from tyro.conf import Positional

from outlap.cli.command import LongCommand, Positive
from outlap.cli.output import CommandResult, lines
from outlap.errors import OutlapError
from outlap.files import make_folder


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

    v_max: Positive | None = None
    """[m/s] top speed, in place of the car's."""

    mu: Positive | None = None
    """Friction, in place of the car's."""

    a_max: Positive | None = None
    """[m/s²] with which it accelerates and brakes, in place of the car's."""

    a_brake: Positive | None = None
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
        from outlap.training.subject import find_limits

        track = load_track(self.track)
        limits = find_limits(
            self.vehicle, track, v_max=self.v_max, mu=self.mu, a_max=self.a_max, a_brake=self.a_brake or self.a_max
        )
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
        from outlap.viewer.plots import draw_raceline  # Matplotlib: not before it is needed

        write_raceline_csv(line.raceline, make_folder(out.parent) / out.name)
        draw_raceline(track, line.raceline, picture, line.lap_time)
        data = {
            "track": track.name, "method": line.method, "lap_time_s": round(line.lap_time, 4),
            "length_m": round(line.path.length, 3), "solve_time_s": round(line.solve_time, 2),
            "min_margin_m": round(line.min_margin, 4),
            "own_lap_time_s": None if track.raceline is None else round(track.raceline.lap_time, 4),
            "limits": limits, "raceline": out, "picture": picture,
        }  # fmt: skip
        own = () if track.raceline is None else (f"the track's own raceline: {track.raceline.lap_time:.2f} s",)
        show = lines(
            f"{track.name}, {line.method}: {line.lap_time:.2f} s for {line.path.length:.1f} m, "
            f"{line.speed.min():.1f} to {line.speed.max():.1f} m/s; at least {line.min_margin:.2f} m from the walls; "
            f"planned in {line.solve_time:.1f} s",
            *own,
            f"raceline: {out}",
            f"picture: {picture}",
        )
        return CommandResult(data, show)
