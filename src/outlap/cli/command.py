"""Base classes of the commands, and the types of their flags.

Commands are pydantic dataclasses: a value outside the limits of its type is one line that names the flag.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from contextlib import AbstractContextManager
from typing import Annotated

from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass
from tyro.conf import FlagCreatePairsOff

from outlap.cli.output import CommandResult
from outlap.cli.progress import Update, progress_bar


def at_least(least: int) -> AfterValidator:
    """Return the limit of an integer flag."""

    def check(value: int) -> int:
        if value < least:
            raise ValueError(f"must be {least} or more")
        return value

    return AfterValidator(check)


def _positive(value: float) -> float:
    if not 0.0 < value < math.inf:
        raise ValueError("must be > 0")
    return value


Flag = FlagCreatePairsOff[bool]  # --name, without a --no-name
Count = Annotated[int, at_least(1)]
CountOrZero = Annotated[int, at_least(0)]
Positive = Annotated[float, AfterValidator(_positive)]  # and finite
Share = Annotated[float, Field(gt=0.0, le=1.0)]
Pixels = Annotated[int, at_least(64)]


@dataclass(frozen=True, kw_only=True)
class Command(ABC):
    """A dataclass whose fields are the flags of a command; tyro builds it.

    Logs go to standard error. A subclass with a class method `from_config(path)` also takes `--config FILE`.
    """

    json: str | None = None
    """Write the result as JSON to this file; - for standard output."""

    @abstractmethod
    def run(self) -> CommandResult:
        """Do the work. Raise OutlapError for a flag or an input that is wrong."""


@dataclass(frozen=True, kw_only=True)
class LongCommand(Command):
    """A command that shows its progress on standard error."""

    quiet: Flag = False
    """Show no progress."""

    def progress(self, what: str, total: int, unit: str) -> AbstractContextManager[Update]:
        """Show a progress bar, see `progress_bar`, unless the command is quiet."""
        return progress_bar(what, total, unit, self.quiet)
