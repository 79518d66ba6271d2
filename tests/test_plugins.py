"""Entry points are found by group and name; a missing one and a duplicate are reported."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from outlap import plugins
from outlap.errors import OutlapError

GROUP = "outlap.test_group"


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], None]:
    """Install a package that has no code but one entry point."""
    monkeypatch.syspath_prepend(tmp_path)

    def install(package: str, entry: str) -> None:
        folder = tmp_path / f"{package}-1.0.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        (folder / "entry_points.txt").write_text(f"[{GROUP}]\n{entry}\n")

    return install


def test_an_entry_point_is_loaded_by_its_name(install: Callable[[str, str], None]) -> None:
    install("one", "sine = math:sin")
    install("two", "cosine = math:cos")
    assert plugins.load(GROUP, "cosine") is math.cos


def test_an_unknown_name_is_refused(install: Callable[[str, str], None]) -> None:
    install("one", "sine = math:sin")
    with pytest.raises(OutlapError, match=r"entry point 'tangent' .*is not installed"):
        plugins.load(GROUP, "tangent")


def test_a_name_that_several_packages_register_is_refused(install: Callable[[str, str], None]) -> None:
    install("one", "sine = math:sin")
    install("two", "sine = cmath:sin")
    with pytest.raises(OutlapError, match="in several packages: one, two; uninstall all but one"):
        plugins.load(GROUP, "sine")
