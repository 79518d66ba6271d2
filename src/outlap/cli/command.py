"""Base classes of the commands: the flags that every command has."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import AbstractContextManager
from dataclasses import dataclass

from tyro.conf import FlagCreatePairsOff

from outlap.cli.output import CommandResult
from outlap.cli.progress import Update, progress_bar

Flag = FlagCreatePairsOff[bool]  # --name, without a --no-name


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
