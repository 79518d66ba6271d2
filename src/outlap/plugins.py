"""Implementations that packages register as Python entry points, looked up by group and name.

A lower package uses a higher one this way without importing it; docs/architecture.md lists the groups.
"""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any

from outlap.errors import OutlapError


def load(group: str, name: str) -> Any:
    """Return the object registered as `name` in an entry-point group.

    Raises:
        OutlapError: no installed package registers the name, or several do.
    """
    found = entry_points(group=group, name=name)
    problem = f"{group}: entry point {name!r}"
    if not found:
        raise OutlapError(f"{problem} is not installed; install the package that registers it")
    if len(found) > 1:
        packages = ", ".join(sorted(each.dist.name if each.dist else each.value for each in found))
        raise OutlapError(f"{problem} is in several packages: {packages}; uninstall all but one")
    (entry,) = found
    return entry.load()
