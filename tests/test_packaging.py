"""What pyproject.toml asks for, constraints.txt pins; the package ships what it promises."""

from __future__ import annotations

import tomllib
from importlib.resources import files
from itertools import chain
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parents[1]


def test_every_dependency_and_extra_is_pinned_within_its_range() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = dict(line.split("==") for line in lines if not line.startswith("#"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *chain(*project["optional-dependencies"].values())]
    for requirement in map(Requirement, wanted):
        if requirement.name == project["name"]:  # an extra that takes another one in
            continue
        version = pins[canonicalize_name(requirement.name)]
        assert requirement.specifier.contains(Version(version)), requirement
    assert pins["torch"] == "2.13.0"


def test_the_type_marker_is_in_the_package() -> None:
    assert (files("outlap") / "py.typed").is_file()
