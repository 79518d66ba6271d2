"""A unit of work: a folder, written once and used again by everything that needs it.

Its folder is named by a hash of what the unit is made of, the units that it needs included: whatever changes gets a
new folder, and nothing else is done again. A unit is done when its `done.json` is there.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

from outlap.files import to_json

VERSION = 1  # of what units write; another one does everything again
DONE = "done.json"
Report = Callable[[float], None]  # called with the share that is done, now and then


@dataclass(frozen=True, eq=False)
class Unit:
    """A piece of work. Fields say what it is made of; those that are units are what it needs."""

    name: str
    kind: ClassVar[str]
    # Whether it needs PyTorch, which is imported before it begins: a process can be ended at once meanwhile.
    learns: ClassVar[bool] = True

    @cached_property
    def needs(self) -> tuple[Unit, ...]:
        """Units that must be done before."""
        found: list[Unit] = []
        for each in fields(self):
            value = getattr(self, each.name)
            found += [one for one in (value if isinstance(value, tuple) else (value,)) if isinstance(one, Unit)]
        return tuple(found)

    @cached_property
    def key(self) -> str:
        """The hash."""
        made_of: dict[str, Any] = {"version": VERSION, "kind": self.kind, "needs": [unit.key for unit in self.needs]}
        for each in fields(self):
            value = getattr(self, each.name)
            needed = isinstance(value, Unit) or (isinstance(value, tuple) and any(isinstance(v, Unit) for v in value))
            if not needed:
                made_of[each.name] = value
        return hashlib.sha256(to_json(made_of).encode()).hexdigest()[:12]

    @property
    def seconds(self) -> float:
        """About how long it takes on one core."""
        raise NotImplementedError

    @property
    def tracks(self) -> tuple[str, ...]:
        """Names of the tracks that it drives on."""
        return ()

    @property
    def uses_gpu(self) -> bool:
        """Whether it needs a share of one."""
        return False

    def folder(self, work: Path) -> Path:
        """Where it is, in a folder of work."""
        return work / self.kind / f"{self.name}-{self.key}"

    def is_done(self, work: Path) -> bool:
        """Whether nothing is left to do."""
        return (self.folder(work) / DONE).is_file()

    def do(self, work: Path, report: Report) -> None:
        """Do it, or go on with it, in its folder. Raises KeyboardInterrupt where `report` does, its work saved."""
        raise NotImplementedError


def done_record(unit: Unit, work: Path) -> dict[str, Any]:
    """What was noted when a unit was done."""
    return json.loads((unit.folder(work) / DONE).read_text())
