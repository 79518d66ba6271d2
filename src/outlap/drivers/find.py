"""Drivers by name: those that need no training, populations, recorded laps, trained runs and functions."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from outlap import plugins
from outlap.drivers.classical import CenterlineFollower, FollowTheGap, PurePursuit
from outlap.drivers.driver import Driver, FunctionDriver
from outlap.drivers.ghost import Ghost
from outlap.drivers.population import MANIFEST, SHIPPED, Split, load_population
from outlap.errors import OutlapError

UNTRAINED: dict[str, type[Driver]] = {driver.name: driver for driver in (CenterlineFollower, PurePursuit, FollowTheGap)}
POPULATION = "population"  # the name of the one that comes with outlap
OFFERED = (
    f"{', '.join(UNTRAINED)}, {POPULATION}, a population's folder or one of its members, a recorded lap (.csv), "
    "a run folder, or module:function"
)
Named = str | os.PathLike[str] | Driver | Callable[[dict[str, Any]], Any]  # what a driver can be asked for by


def find_drivers(
    names: Sequence[Named], field_of_view: float, split: Split | None = "train", run_code: bool = False
) -> list[Driver]:
    """Every driver that some names stand for; drivers and functions stand for themselves.

    Args:
        names: see OFFERED.
        field_of_view: [rad] of the scanners, for those that look.
        split: the half of a population; None: both.
        run_code: import modules, which runs their code.

    Raises OutlapError for a name that is none of these, for what cannot be loaded, and for what may not be.
    """
    return [driver for name in names for driver in _drivers(name, field_of_view, split, run_code)]


def driver_name(driver: Named) -> str:
    """Return what a configuration calls a driver: its name, or the name or path that was given."""
    return os.fspath(driver) if isinstance(driver, (str, os.PathLike)) else _as_driver(driver, "driver").name


def _drivers(name: Named, field_of_view: float, split: Split | None, run_code: bool) -> Sequence[Driver]:
    if not isinstance(name, (str, os.PathLike)):
        return [_as_driver(name, "driver")]
    text = os.fspath(name)
    if text == FollowTheGap.name:
        return [FollowTheGap(field_of_view=field_of_view)]
    if text in UNTRAINED:
        return [UNTRAINED[text]()]
    first, _, rest = text.partition("/")
    path = SHIPPED / rest if first == POPULATION else Path(text)
    if (path / MANIFEST).is_file():
        return load_population(path, split)
    if path.suffix == ".csv":
        return [Ghost.load(path)]
    if (path / "config.yaml").is_file():
        return [plugins.load("outlap.driver_loaders", "run")(path)]
    module, _, function = text.partition(":")
    if function and module.replace(".", "").isidentifier():
        if not run_code:
            raise OutlapError(
                f"driver {text}: is a module, which runs code when it is imported; if you trust it, allow that with "
                "opponent_code, or outlap reproduce --driver-code"
            )
        return [_function(module, function)]
    if path.is_dir():
        raise OutlapError(f"{text}: holds neither a run (no config.yaml) nor a population (no {MANIFEST})")
    if (path.parent / MANIFEST).is_file():
        return load_population(path.parent, split, path.name.removesuffix(".safetensors"))
    raise OutlapError(f"driver is {text!r}; must be {OFFERED}")


def _function(module: str, function: str) -> Driver:
    if os.getcwd() not in sys.path:  # where `python -m` would look, and a console script does not
        sys.path.append(os.getcwd())
    try:
        found = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, TypeError) as error:
        raise OutlapError(f"driver {module}:{function}: cannot be imported: {error}") from None
    return _as_driver(found, f"driver {module}:{function}:")


def _as_driver(found: Any, where: str) -> Driver:
    """A driver as it is, a function as a driver; a class is neither."""
    if isinstance(found, Driver):
        return found
    if isinstance(found, type) or not callable(found):
        raise OutlapError(f"{where} is {found!r:.60}; must be a Driver, a function, or the name of one")
    return FunctionDriver.of(found)
