"""Compiled kernels of other sources are thrown away, those of these sources are kept."""

from __future__ import annotations

from pathlib import Path

import pytest

from outlap.simulator import kernel_cache


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder with a compiled kernel, and sources of its own."""
    package = tmp_path / "outlap"
    for name in ("simulator/lidar.py", "seeding.py", "track/centerline.py"):
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text("one = 1\n")
    folder = tmp_path / "cache"
    folder.mkdir()

    class Probe:
        class stats:
            cache_path = str(folder)

    monkeypatch.setattr(kernel_cache, "PACKAGE", package)
    monkeypatch.setattr(kernel_cache, "_probe", Probe)
    kernel_cache.discard_stale_kernels()
    (folder / "lidar.cast_walls-1.py311.1.nbc").write_bytes(b"compiled")
    return folder


def test_unchanged_sources_keep_their_kernels(cache: Path) -> None:
    kernel_cache.discard_stale_kernels()
    assert list(cache.glob("*.nbc"))


@pytest.mark.parametrize("name", ["simulator/lidar.py", "seeding.py", "track/centerline.py"])
def test_a_change_in_any_source_throws_them_away(cache: Path, name: str) -> None:
    (kernel_cache.PACKAGE / name).write_text("two = 2\n")
    kernel_cache.discard_stale_kernels()
    assert not list(cache.glob("*.nbc"))
    (cache / "new.nbc").write_bytes(b"compiled")
    kernel_cache.discard_stale_kernels()
    assert list(cache.glob("*.nbc"))
