"""Compiled kernels of other sources are thrown away, those of these sources are kept."""

from __future__ import annotations

from pathlib import Path

import pytest

from outlap.kernel_cache import discard_stale_kernels


class Cached:
    """A folder's sources, and a cache with a compiled kernel."""

    def __init__(self, folder: Path) -> None:
        self.sources = [folder / "lidar.py", folder / "seeding.py"]
        for source in self.sources:
            source.write_text("one = 1\n")
        self.kernels = folder / "cache"
        self.kernels.mkdir()
        self.stats = self
        self.cache_path = str(self.kernels)
        self.discard()
        self.compile("lidar.cast_walls-1.py311.1.nbc")

    def discard(self) -> None:
        discard_stale_kernels(self, self.sources)

    def compile(self, name: str) -> None:
        (self.kernels / name).write_bytes(b"compiled")

    def kept(self) -> list[Path]:
        return list(self.kernels.glob("*.nbc"))


@pytest.fixture
def cached(tmp_path: Path) -> Cached:
    return Cached(tmp_path)


def test_unchanged_sources_keep_their_kernels(cached: Cached) -> None:
    cached.discard()
    assert cached.kept()


@pytest.mark.parametrize("changed", [0, 1])
def test_a_change_in_any_source_throws_them_away(cached: Cached, changed: int) -> None:
    cached.sources[changed].write_text("two = 2\n")
    cached.discard()
    assert not cached.kept()
    cached.compile("new.nbc")
    cached.discard()
    assert cached.kept()


def test_packages_with_kernels_that_import_others_look_after_theirs() -> None:
    module = __import__("outlap.simulator", fromlist=["_probe"])
    assert (Path(module._probe.stats.cache_path) / "sources.sha256").is_file()
