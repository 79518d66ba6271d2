"""Commands that do units of work: their flags, and the units done with progress."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic.dataclasses import dataclass

from outlap.cli.command import CountOrZero, LongCommand, Share
from outlap.errors import OutlapError
from outlap.files import make_folder

if TYPE_CHECKING:
    from outlap.experiments.engine import Engine
    from outlap.experiments.runner import Follow, Status
    from outlap.experiments.unit import Unit


@dataclass(frozen=True, kw_only=True)
class WorkCommand(LongCommand):
    """A command that does units of work, on this machine or on a Ray cluster."""

    jobs: CountOrZero = 0
    """Units of work at a time; 0: one a core."""

    engine: Literal["local", "ray"] = "local"
    """Processes of this machine, or a Ray cluster."""

    address: str | None = None
    """Of a Ray cluster's head; by default RAY_ADDRESS, or else a cluster of this machine alone."""

    store: str | None = None
    """Where machines of a Ray cluster that have no folder in common keep finished work: s3://bucket/folder, gs://…"""

    gpu_share: Share = 1.0
    """Of a GPU, for each training on one (device cuda) that Ray does."""

    def check_flags(self) -> None:
        """Raise OutlapError for a wrong flag."""
        for flag, value in (("--address", self.address), ("--store", self.store)):
            if self.engine == "local" and value is not None:
                raise OutlapError(f"{flag} is of the engine ray alone; add --engine ray, or leave it out")

    def do_units(
        self,
        units: Sequence[Unit],
        work: Path,
        title: str,
        on_done: Follow | None = None,
        on_failed: Follow | None = None,
        tracks: Iterable[str] = (),
        resume: str = "go on with the same command",
    ) -> None:
        """Do units with a progress bar, see `run_units`; after Ctrl-C say how to resume.

        Args:
            units: see `run_units`, as `work`, `on_done` and `on_failed`.
            title: of the progress bar.
            tracks: names of tracks that only units use which follow from others.
            resume: how, in words.
        """
        from outlap.experiments.plan import remember_tracks
        from outlap.experiments.runner import run_units

        make_folder(work)
        engine = self._make_engine(remember_tracks({*tracks, *(name for unit in units for name in unit.tracks)}, work))
        with self.progress(title, 1000, "‰") as update:
            try:
                run_units(
                    units,
                    work,
                    engine,
                    lambda status: update(round(1000 * status.share), _note(status)),
                    on_done,
                    on_failed,
                )
            except KeyboardInterrupt:
                print(f"\nsaved; {resume}", file=sys.stderr)
                raise

    def count_slots(self) -> int:
        """Return how many units are done at a time."""
        if self.jobs or self.engine == "local":
            return self.jobs or os.cpu_count() or 1
        from outlap.experiments.ray_engine import cluster_cores

        return cluster_cores(self.address)

    def _make_engine(self, tracks: Mapping[str, str]) -> Engine:
        """Return the engine; on other machines tracks must have these fingerprints."""
        from outlap.experiments.engine import LocalEngine

        if self.engine == "local":
            return LocalEngine(self.jobs)
        from outlap.experiments.ray_engine import RayEngine

        return RayEngine(self.address, self.store, self.jobs, self.gpu_share, tracks)


def _note(status: Status) -> str:
    note = f"{status.done} of {status.units} units"
    if status.running:
        left = "estimating" if status.seconds_left is None else f"{duration(status.seconds_left)} left"
        note += f", {left}: {', '.join(status.running)}"
    return note


def duration(seconds: float) -> str:
    """Return a duration in hours and minutes, for a person."""
    minutes = round(seconds / 60.0)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{max(minutes, 1)} min"
