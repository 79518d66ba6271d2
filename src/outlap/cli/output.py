"""What a command hands back, and how it reaches the screen and the JSON file."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from outlap.errors import OutlapError
from outlap.files import atomic_write, to_json

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

STANDARD_OUTPUT = "-"
NOTHING_KEPT = "nothing is kept; begin again with the same command"  # after Ctrl-C


@dataclasses.dataclass(frozen=True)
class CommandResult:
    """What a command found: the same content for a program and for a person.

    Args:
        data: what `--json` writes; keys in snake_case with the unit at the end.
        show: prints it for a person, as a table for example, on the console it is given.
    """

    data: Mapping[str, Any]
    show: Callable[[Console], None]


def check_json_path(path: str | None) -> None:
    """Make the folder of `path` now, so that an hour of work does not end in a failed write.

    Raises:
        OutlapError: `path` is a folder, or nothing can be written there.
    """
    if path is None or path == STANDARD_OUTPUT:
        return
    if not path or Path(path).is_dir():
        raise OutlapError(f"--json is {path!r}, a folder; must be a file, or - for standard output")
    _make_parent("--json", Path(path))


def check_output_path(path: Path, endings: Sequence[str]) -> None:
    """Make the folder of a command's `--out` now, and see that a file of one of these endings can be written.

    Raises OutlapError where it cannot.
    """
    if path.suffix.lower() not in endings:
        raise OutlapError(f"--out is {path}; must end in {' or '.join(endings)}")
    _make_parent("--out", path)
    if path.is_dir():
        raise OutlapError(f"--out {path}: is a folder; give another file")


def _make_parent(flag: str, path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutlapError(f"{flag} {path}: cannot make the folder {path.parent}: {error.strerror}") from None
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise OutlapError(f"{flag} {path}: the folder {path.parent} cannot be written to; give another file")


def dated_folder(home: Path, name: str = "") -> Path:
    """Return a folder in `home` that does not exist, named after the present time; the default of `--out`."""
    folder = home / time.strftime(f"{name}%Y%m%d-%H%M%S")
    numbered = (folder.with_name(f"{folder.name}-{number}") for number in range(2, 1000))
    return next(path for path in (folder, *numbered) if not path.exists())


def lines(*texts: str) -> Callable[[Console], None]:
    """Return a function that prints lines, for `CommandResult.show`."""

    def show(console: Console) -> None:
        for text in texts:
            console.print(text)

    return show


def table(
    headings: Sequence[str], rows: Iterable[Sequence[object] | None], left: Sequence[str] = (), title: str | None = None
) -> Table:
    """Return a table to print.

    Args:
        headings: of the columns.
        rows: a value for each column, shown as `str`; None draws a line.
        left: headings of columns that are aligned to the left, which are text; the others are numbers.
        title: above the table.
    """
    from rich import box
    from rich.table import Table
    from rich.text import Text

    made = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left", show_edge=False, pad_edge=False)
    for heading in headings:
        text = heading in left
        made.add_column(Text(heading), justify="left" if text else "right", overflow="fold", no_wrap=not text)
    for row in rows:
        if row is None:
            made.add_section()
        else:
            made.add_row(*(value if isinstance(value, Text) else Text(str(value)) for value in row))
    return made


def deliver(result: CommandResult, json_path: str | None) -> None:
    """Show `result` on standard output, or as JSON there if `json_path` is `-`, or both where it is a file.

    Raises:
        BrokenPipeError: nobody reads standard output any more.
    """
    if json_path == STANDARD_OUTPUT:
        print(to_json(result.data), flush=True)
        return
    if json_path is not None:
        atomic_write(json_path, to_json(result.data) + "\n")
    result.show(_result_console())
    sys.stdout.flush()


@contextlib.contextmanager
def standard_output_kept_clean() -> Iterator[None]:
    """Send whatever is printed meanwhile, by libraries and child processes too, to standard error."""
    sys.stdout.flush()
    saved = os.dup(1)
    os.dup2(2, 1)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        sys.stderr.flush()
        os.dup2(saved, 1)
        os.close(saved)


def _result_console() -> Console:
    from rich.console import Console

    class ResultConsole(Console):
        """Print text as it is: paths are never broken, brackets are no markup. Tables fit the terminal."""

        def print(self, *objects: Any, **options: Any) -> None:
            options.setdefault("soft_wrap", all(isinstance(each, str) for each in objects))
            super().print(*objects, **options)

        def on_broken_pipe(self) -> None:
            raise  # rich calls this while it handles the error, and would exit with 1; main decides

    return ResultConsole(highlight=False, markup=False, emoji=False)
