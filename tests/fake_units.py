"""Units of work for tests of the runner; in a module of their own, since workers import them."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

from outlap.experiments.unit import Report, Unit
from outlap.files import atomic_write


@dataclass(frozen=True, eq=False)
class Fake(Unit):
    """Writes when it began and ended, and how often; may fail, and may take long."""

    kind = "fakes"
    before: tuple[Fake, ...] = ()
    fails: bool = False
    dies: bool = False  # takes its process with it
    ticks: int = 1  # of 50 ms
    until: str | None = None  # a file is there
    silent: bool = False  # reports nothing meanwhile
    on_gpu: bool = False
    on_track: str | None = None

    @property
    def size(self) -> float:
        return self.ticks

    @property
    def tracks(self) -> tuple[str, ...]:
        return (self.on_track,) if self.on_track else ()

    @property
    def uses_gpu(self) -> bool:
        return self.on_gpu

    def do(self, work: Path, report: Report) -> None:
        folder = self.folder(work)
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "begun").open("a") as file:
            file.write(f"{time.monotonic()}\n")
        (folder / "gpus").write_text(os.environ.get("CUDA_VISIBLE_DEVICES", ""))
        if self.dies:
            os._exit(9)
        if self.fails:
            raise ValueError("no luck")
        path = folder / "ticks"
        for tick in range(int(path.read_text()) if path.exists() else 0, self.ticks):
            time.sleep(0.05)
            atomic_write(path, str(tick + 1))
            report((tick + 1) / self.ticks)
        while self.until and not Path(self.until).exists():
            time.sleep(0.05)
            if not self.silent:
                report(0.99)
        (folder / "ended").write_text(str(time.monotonic()))


def begun(unit: Fake, work: Path) -> list[float]:
    """When the unit was begun, once for every time."""
    path = unit.folder(work) / "begun"
    return [float(line) for line in path.read_text().split()] if path.exists() else []


def ended(unit: Fake, work: Path) -> float:
    """When it was through."""
    return float((unit.folder(work) / "ended").read_text())
