"""The one exception that a user's mistake raises."""

from __future__ import annotations


class OutlapError(ValueError):
    """Bad input from outside: a file, a flag, a name.

    The message is one line that names the file or flag, the field, the value and what would be right.
    The command line prints it on standard error and exits with 2.
    """
