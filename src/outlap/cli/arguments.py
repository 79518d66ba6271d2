"""From the words after a command to the command object, and from any mistake in them to one line."""

from __future__ import annotations

import contextlib
import difflib
import inspect
import io
import os
import re
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

from pydantic import ValidationError

from outlap.config import explain
from outlap.errors import OutlapError

CommandT = TypeVar("CommandT")


def parse(command: type[CommandT], arguments: Sequence[str], prog: str) -> CommandT:
    """Build `command`, a dataclass, from its flags.

    A command that can be configured from a file has a classmethod `from_config(path)`. Then the values of
    `--config FILE` become its defaults, and the flags override them, wherever on the line they stand.

    Raises:
        OutlapError: one line that says which flag is wrong, and what would be right.
        SystemExit: code 0, after `--help`.
    """
    import tyro

    default: dict[str, Any] = {}
    path = _config_file(arguments)
    from_config = getattr(command, "from_config", None)
    if path is not None and from_config is not None:
        default["default"] = from_config(path)
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint), _no_line_breaks(arguments), _own_flags_first(command):
            return tyro.cli(command, args=list(arguments), prog=prog, **default)
    except (SystemExit, ValidationError) as stop:  # tyro lets pass what a Config of all flags refuses
        if isinstance(stop, SystemExit) and not stop.code:
            raise
        # `from None` would not do: the chain is where pydantic's own error is found.
        message = _value_problem(stop, arguments) or _one_line(complaint.getvalue(), prog)
    raise OutlapError(message)


@contextlib.contextmanager
def _own_flags_first(command: type) -> Iterator[None]:
    """Let tyro list the flags of a command before those of its base classes."""
    owners = [inspect.get_annotations(each) for each in command.__mro__]
    fields: dict[str, Any] = vars(command)["__dataclass_fields__"]
    before = dict(fields)
    names = sorted(fields, key=lambda name: [name in owner for owner in owners].index(True))
    try:
        for name in names:
            fields[name] = fields.pop(name)
        yield
    finally:
        fields.clear()
        fields.update(before)


def _config_file(arguments: Sequence[str]) -> str | None:
    path = None
    for number, word in enumerate(arguments):
        if word == "--config" and number + 1 < len(arguments):
            path = arguments[number + 1]
        elif word.startswith("--config="):
            path = word.partition("=")[2]
    return path


@contextlib.contextmanager
def _no_line_breaks(arguments: Sequence[str]) -> Iterator[None]:
    """Let tyro write its complaint unbroken, as wide as it is; help keeps the terminal's width."""
    if {"-h", "--help"} & set(arguments):
        yield
        return
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "10000"
    try:
        yield
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before


def _value_problem(stop: BaseException, arguments: Sequence[str]) -> str | None:
    """The line for a value that a Config refused; None if tyro stopped for another reason."""
    given = {word.partition("=")[0].replace("_", "-") for word in arguments}
    where = ""
    error: BaseException | None = stop
    while error is not None:
        if isinstance(error, ValidationError):
            line = explain(error, prefix=f"{where}." if where else "")
            field, rest = re.fullmatch(r"(\S*)(.*)", line, re.DOTALL).groups()  # type: ignore[union-attr]
            # The field's path starts with attributes of the command that its flags leave out.
            parts = [part for part in field.split(".") if not part.isdigit()]  # no places in a tuple
            tails = (".".join(parts[start:]) for start in range(len(parts)))
            flags = (f"--{tail.replace('_', '-')}" for tail in tails)
            return next((flag for flag in flags if flag in given), field) + rest
        # tyro's own exception, in between, knows in which nested group it happened.
        place = getattr(error, "arg", "")
        where = place if isinstance(place, str) and place else where
        error = error.__context__
    return None


def _one_line(box: str, prog: str) -> str:
    """tyro's framed complaint as one line, with the closest flag or the form of the value."""
    sections: list[list[str]] = [[]]
    for number, row in enumerate(box.splitlines()):
        line = row.strip(" │|")
        if number == 0 or line.startswith(("╭", "╰")):
            continue  # the title says less than the text
        if line and set(line) <= {"─", "-"}:
            sections.append([])
        elif line:
            sections[-1].append(line)
    sections = [lines for lines in sections if lines]  # without UTF-8 a rule follows the title too
    if not sections:
        return f"wrong arguments (see {prog} --help)"
    message = " ".join(" ".join(sections[0]).split()).replace("[bold]", "").replace("[/bold]", "")
    message = message.partition(" Got errors: ")[0].rstrip(".").replace(f"Missing from {prog}:", "missing:")
    message = re.sub(r"^Error parsing (?:[A-Z]\w*: )?", "", message)
    message = re.sub(r"^(--\S+): no type matching .+ could be .+ from \[(.+)\]$", r"\1 is \2", message)
    if choice := re.match(r"invalid choice '(.*)' for .+ one of \((.+)\)$", message):
        close = difflib.get_close_matches(choice[1], re.findall(r"'(.*?)'", choice[2]), 1)
        message += f"; did you mean {close[0]}?" if close else ""
    for title, *lines in sections[1:]:
        if title == "Perhaps you meant:":
            message += f"; did you mean {lines[0].split()[0]}?"
        elif title == "Argument helptext:":
            message += f"; must be {lines[0]}"
    return message[:1].lower() + message[1:]
