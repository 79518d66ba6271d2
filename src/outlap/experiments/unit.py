"""A unit of work: a folder, written once and reused by everything that needs it.

A hash of the unit's fields, including the units that it needs, and of outlap's version names the folder. A changed
field therefore gets a new folder, and everything else is reused. A unit is done when its `done.json` exists.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import cache, cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar

from outlap.files import to_json

VERSION = 1  # of the files that units write; a new version repeats all work
DONE = "done.json"
Report = Callable[[float], None]  # takes the finished share of a unit, 0 … 1; raises KeyboardInterrupt to stop it


@dataclass(frozen=True, eq=False)
class Unit:
    """A piece of work.

    The fields and the versions of its packages identify it. Fields that hold units are its requirements; a field with
    `compare=False`, such as the place of an input on this machine, does not enter the hash.
    """

    name: str
    kind: ClassVar[str]
    packages: ClassVar[tuple[str, ...]] = ("outlap",)  # results of other versions of these are not reused

    @cached_property
    def needs(self) -> tuple[Unit, ...]:
        """Units that must be done first."""
        found: list[Unit] = []
        for each in fields(self):
            value = getattr(self, each.name)
            found += [one for one in (value if isinstance(value, tuple) else (value,)) if isinstance(one, Unit)]
        return tuple(found)

    def all_needs(self) -> Iterator[Unit]:
        """Units that must be done first, each after its own requirements."""
        for needed in self.needs:
            yield from needed.all_needs()
            yield needed

    @cached_property
    def key(self) -> str:
        """The hash that identifies the unit, 12 hexadecimal digits."""
        content: dict[str, Any] = {"version": VERSION, "kind": self.kind, "needs": [unit.key for unit in self.needs]}
        content["versions"] = {package: _version(package) for package in self.packages}
        for each in fields(self):
            value = getattr(self, each.name)
            needed = isinstance(value, Unit) or (isinstance(value, tuple) and any(isinstance(v, Unit) for v in value))
            if each.compare and not needed:
                content[each.name] = value
        return hashlib.sha256(to_json(content).encode()).hexdigest()[:12]

    @property
    def category(self) -> str:
        """Units of one category take time in proportion to their size."""
        return self.kind

    @property
    def size(self) -> float:
        """Amount of work, in any measure that the units of a category share."""
        return 1.0

    @property
    def tracks(self) -> tuple[str, ...]:
        """Names of the tracks that it drives on."""
        return ()

    @property
    def uses_gpu(self) -> bool:
        """Whether it needs a share of a GPU."""
        return False

    def folder(self, work: Path) -> Path:
        """Return its folder in a work folder."""
        return work / self.kind / f"{self.name}-{self.key}"

    def is_done(self, work: Path) -> bool:
        """Return whether it is finished."""
        return (self.folder(work) / DONE).is_file()

    def do(self, work: Path, report: Report) -> None:
        """Do the work in its folder, or resume it. Raise KeyboardInterrupt if `report` does, with the work saved."""
        raise NotImplementedError


_version = cache(version)  # reads a file


def done_record(unit: Unit, work: Path) -> dict[str, Any]:
    """Return the content of a finished unit's `done.json`."""
    return json.loads((unit.folder(work) / DONE).read_text())
