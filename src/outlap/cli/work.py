"""Flags of commands that do many units of work, and the units done with progress."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from outlap.cli.arguments import check_least
from outlap.cli.progress import progress_bar
from outlap.errors import OutlapError
from outlap.files import make_folder

if TYPE_CHECKING:
    from outlap.experiments.engine import Engine
    from outlap.experiments.runner import Status
    from outlap.experiments.unit import Unit


@dataclass(frozen=True, kw_only=True)
class ClusterFlags:
    """How much is at work, and where."""

    jobs: int = 0
    """Units of work at a time; 0: one a core."""

    address: str | None = None
    """Of a Ray cluster's head; by default RAY_ADDRESS, or else a cluster of this machine alone."""

    store: str | None = None
    """Where machines of a Ray cluster that have no folder in common keep finished work: s3://bucket/folder, gs://…"""

    gpu_share: float = 1.0
    """Of a GPU, for each training on one (device cuda) that Ray does."""

    def check_flags(self) -> None:
        """Raises OutlapError for a flag that is wrong."""
        check_least("--jobs", self.jobs, 0)
        if not 0.0 < self.gpu_share <= 1.0:
            raise OutlapError(f"--gpu-share is {self.gpu_share}; must be > 0 and at most 1")


@dataclass(frozen=True, kw_only=True)
class WorkFlags(ClusterFlags):
    """On what units of work are done."""

    engine: Literal["local", "ray"] = "local"
    """Processes of this machine, or a Ray cluster."""

    def check_flags(self) -> None:
        super().check_flags()
        if self.engine == "local":
            for flag, value in (("--address", self.address), ("--store", self.store)):
                if value is not None:
                    raise OutlapError(f"{flag} is of the engine ray alone; add --engine ray, or leave it out")

    def make_engine(self, tracks: Mapping[str, str]) -> Engine:
        """The engine; on other machines tracks must have these fingerprints."""
        from outlap.experiments.engine import LocalEngine

        if self.engine == "local":
            return LocalEngine(self.jobs)
        from outlap.experiments.ray_engine import RayEngine

        return RayEngine(self.address, self.store, self.jobs, self.gpu_share, tracks)

    def do_units(self, units: Sequence[Unit], work: Path, title: str, quiet: bool) -> None:
        """Do units with a progress bar; after Ctrl-C say how to go on."""
        from outlap.experiments.plan import remember_tracks
        from outlap.experiments.runner import run_units

        make_folder(work)
        engine = self.make_engine(remember_tracks({name for unit in units for name in unit.tracks}, work))
        with progress_bar(title, 1000, "‰", quiet) as update:

            def show(status: Status) -> None:
                note = f"{status.done} of {status.units} units"
                if status.running:
                    left = "estimating" if status.seconds_left is None else f"{duration(status.seconds_left)} left"
                    note += f", {left}: {', '.join(status.running)}"
                update(round(1000 * status.share), note)

            try:
                run_units(units, work, engine, show)
            except KeyboardInterrupt:
                print("\nsaved; go on with the same command", file=sys.stderr)
                raise


def duration(seconds: float) -> str:
    """In hours and minutes, for a person."""
    minutes = round(seconds / 60.0)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{max(minutes, 1)} min"
