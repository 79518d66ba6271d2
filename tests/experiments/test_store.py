"""Units in an object store: what is there is whole, and found by all."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from fake_units import Fake
from outlap.errors import OutlapError
from outlap.experiments import ray_engine
from outlap.experiments.ray_engine import run_with_store
from outlap.experiments.store import Store
from outlap.experiments.unit import Report, Unit


def kept(unit: Fake, work: Path, ticks: str) -> Path:
    """The unit's folder, with so much done."""
    folder = unit.folder(work)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "ticks").write_text(ticks)
    (folder / ".lock").touch()
    return folder


def test_an_unfinished_unit_gives_way_to_the_finished_one(tmp_path: Path) -> None:
    store, unit = Store(f"file://{tmp_path / 'store'}"), Fake("long", ticks=3)
    here, there = tmp_path / "here", unit.folder(tmp_path / "there")
    kept(unit, here, "2")
    store.put_part(unit, here)
    assert store.done() == set()
    with pytest.raises(OutlapError, match="has lost long; run it all again"):
        store.get(unit, tmp_path / "there")
    store.get_part(unit, tmp_path / "there")
    assert (there / "ticks").read_text() == "2"
    assert not (there / ".lock").exists()
    kept(unit, here, "3")
    store.put(unit, here)
    assert store.done() == {unit.key}
    store.get(unit, tmp_path / "there")
    assert (there / "ticks").read_text() == "3"
    assert [path.name for path in (tmp_path / "store").rglob("*") if path.is_file()] == [f"long-{unit.key}.tar"]


class Remembering(MemoryFileSystem):
    """Tells what a folder held when it was asked first, as file systems of object stores do unless told not to."""

    def ls(self, path: str, detail: bool = True, **_: Any) -> list[Any]:
        path = self._strip_protocol(path)
        found: Any = self.dircache[path] if path in self.dircache else super().ls(path, detail=True)
        self.dircache[path] = found
        return found if detail else [each["name"] for each in found]

    def exists(self, path: str, **_: Any) -> bool:
        path = self._strip_protocol(path)
        return any(each["name"] == path for each in self.ls(self._parent(path)))


@pytest.fixture
def remembering() -> Iterator[None]:
    fsspec.register_implementation("memory", Remembering, clobber=True)
    yield
    fsspec.register_implementation("memory", MemoryFileSystem, clobber=True)
    MemoryFileSystem.store.clear()


def test_what_another_machine_has_put_there_since_is_found(remembering: None, tmp_path: Path) -> None:
    """A folder that was listed before is listed again."""
    here, elsewhere = (Store("memory://units") for _ in range(2))
    elsewhere.files = Remembering(skip_instance_cache=True)  # of another process
    for unit in (Fake("first"), Fake("second")):
        kept(unit, tmp_path / "elsewhere", "1")
        elsewhere.put(unit, tmp_path / "elsewhere")
        here.get(unit, tmp_path / "here")
        assert unit.key in here.done()


class Failing(Store):
    """Has an error at every copy of one kind."""

    fails: str

    def _put(self, unit: Unit, work: Path, suffix: str) -> None:
        if suffix == self.fails:
            raise OSError("no network")
        super()._put(unit, work, suffix)


def done_with(store: Failing, unit: Unit, folder: Path) -> None:
    """The unit, done on a machine of a cluster that copies it after every report."""
    folder.mkdir()
    run_with_store(unit, folder, store, report=lambda share: None)


def test_an_error_of_a_copy_costs_no_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(ray_engine, "STORE_INTERVAL", 0.0)
    store, unit = Failing(f"file://{tmp_path / 'store'}"), Fake("long", ticks=3)
    store.fails = ".tar"  # the last one, which is not passed over
    with pytest.raises(OSError, match="no network"):
        done_with(store, unit, tmp_path / "first")
    assert (store.done(), store.begun()) == (set(), {unit.key})
    store.fails = ".part.tar"
    done_with(store, unit, tmp_path / "second")
    assert store.done() == {unit.key}
    other = Fake("other", ticks=2)
    done_with(store, other, tmp_path / "third")
    assert store.done() == {unit.key, other.key}
    assert caplog.text.count("continues, but is not copied") == 2


class Stopping(Fake):
    """Is interrupted once it has begun."""

    def do(self, work: Path, report: Report) -> None:
        kept(self, work, "1")
        raise KeyboardInterrupt


def test_what_ctrl_c_could_not_save_is_an_error(tmp_path: Path) -> None:
    store, unit = Failing(f"file://{tmp_path / 'store'}"), Stopping("long")
    store.fails = ".tar"
    with pytest.raises(KeyboardInterrupt):
        done_with(store, unit, tmp_path / "first")
    assert store.begun() == {unit.key}
    store.fails = ".part.tar"
    with pytest.raises(OSError, match="no network"):
        done_with(store, unit, tmp_path / "second")


def test_a_copy_that_is_cut_off_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, unit = Store(f"file://{tmp_path / 'store'}"), Fake("long")
    kept(unit, tmp_path / "here", "1")

    def cut_off(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(store.files, "mv", cut_off)
    with pytest.raises(KeyboardInterrupt):
        store.put(unit, tmp_path / "here")
    assert [path for path in (tmp_path / "store").rglob("*") if path.is_file()] == []
