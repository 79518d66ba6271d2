"""The one exception that a user's mistake raises, and how others are told in its words."""

from __future__ import annotations


class OutlapError(ValueError):
    """Bad input from outside: a file, a flag, a name.

    The message is one line that names the file or flag, the field, the value and what would be right.
    The command line prints it on standard error and exits with 2.
    """


def short_repr(value: object, longest: int = 80) -> str:
    """Return the `repr` of a wrong value for an error message: at most `longest` characters."""
    text = repr(value)
    return text if len(text) <= longest else f"{text[: longest - 3]}..."


def brief(error: BaseException) -> str:
    """What an exception says, fit for one line: of a broken file it may hold any bytes, and any number of them."""
    words = " ".join(str(error).split()) or type(error).__name__
    return "".join(c if c.isprintable() else "?" for c in words[:300]) + ("…" if len(words) > 300 else "")
