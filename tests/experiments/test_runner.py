"""Units of work: their order, their failures, and that nothing is done twice or lost."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from fake_units import Fake, begun, ended
from outlap.errors import OutlapError
from outlap.experiments.engine import LocalEngine
from outlap.experiments.runner import Status, estimate_seconds, finished_rates, run_units
from outlap.experiments.unit import Unit, done_record


def test_units_wait_for_what_they_need_and_are_done_once(tmp_path: Path):
    first = Fake("first", ticks=3)
    second = Fake("second", ticks=2)
    last = Fake("last", before=(first, second))
    seen: list[Status] = []
    before = dict(os.environ)
    run_units([first, second, last], tmp_path, LocalEngine(2), on_status=seen.append)
    assert os.environ == before
    assert begun(last, tmp_path)[0] >= max(ended(first, tmp_path), ended(second, tmp_path))
    assert (seen[-1].done, seen[-1].units, seen[-1].running) == (3, 3, ())
    assert seen[-1].share == 1.0
    assert seen[-1].seconds_left == 0.0
    assert done_record(first, tmp_path)["seconds"] >= 0.1
    run_units([first, second, last], tmp_path, LocalEngine(2))
    assert [len(begun(unit, tmp_path)) for unit in (first, second, last)] == [1, 1, 1]
    # One that is new is done by itself.
    new = Fake("new", before=(first,))
    run_units([first, new], tmp_path, LocalEngine(2))
    assert [len(begun(unit, tmp_path)) for unit in (first, new)] == [1, 1]


def test_what_fails_stops_only_those_that_need_it(tmp_path: Path):
    broken = Fake("broken", fails=True)
    after = Fake("after", before=(broken,))
    later = Fake("later", before=(after,))
    other = Fake("other", ticks=2)
    with pytest.raises(OutlapError) as error:
        run_units([broken, after, later, other], tmp_path, LocalEngine(1))
    assert "3 of 4 units of work failed, broken first (ValueError: no luck)" in str(error.value)
    assert other.is_done(tmp_path)
    assert not begun(after, tmp_path)
    with pytest.raises(OutlapError, match="broken first"):
        run_units([broken, after, other], tmp_path, LocalEngine(1))
    assert [len(begun(unit, tmp_path)) for unit in (broken, other)] == [2, 1]


def test_a_process_that_dies_takes_no_other_unit_with_it(tmp_path: Path):
    deadly = Fake("deadly", dies=True)
    others = [Fake("other", ticks=6), Fake("next"), Fake("last")]
    with pytest.raises(OutlapError, match="1 of 4 units of work failed, deadly first") as error:
        run_units([deadly, *others], tmp_path, LocalEngine(2))
    assert "BrokenProcessPool" in str(error.value)
    assert all(unit.is_done(tmp_path) for unit in others)
    assert len(begun(deadly, tmp_path)) == 2  # beside another one, and alone


@pytest.mark.parametrize("busy", [True, False])
def test_a_process_that_dies_before_the_next_unit_is_submitted(busy: bool, tmp_path: Path):
    engine, released = LocalEngine(2), tmp_path / "released"
    first, second = Fake("first", until=str(released)), Fake("second")
    engine.open(tmp_path)
    assert engine._workers is not None
    try:
        engine.submit(first)
        wait_for(lambda: begun(first, tmp_path))
        outcomes = []
        if not busy:
            released.touch()
            wait_for(lambda: outcomes.extend(engine.wait(0.1)) or outcomes)
        os.kill(next(iter(engine._workers.pool._processes)), signal.SIGKILL)
        pool = engine._workers.pool
        wait_for(lambda: pool._broken)  # type: ignore[attr-defined]
        engine.submit(second)
        released.touch()
        wait_for(lambda: outcomes.extend(engine.wait(0.1)) or len(outcomes) == 2)
    finally:
        engine.close()
    assert [outcome.error for outcome in outcomes] == [None, None]
    assert len(begun(first, tmp_path)) == 1 + busy
    assert len(begun(second, tmp_path)) == 1
    assert engine._lost == ({first.key} if busy else set())  # the second may still be lost once


def wait_for(there: Callable[[], object]) -> None:
    deadline = time.monotonic() + 60.0
    while not there():
        assert time.monotonic() < deadline
        time.sleep(0.05)


SCRIPT = """
from pathlib import Path
from fake_units import Fake
from outlap.experiments.engine import LocalEngine
from outlap.experiments.runner import run_units
if __name__ == "__main__":
    run_units([Fake("long", ticks=100)], Path("work"), LocalEngine(1))
"""


@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGKILL])
def test_after_ctrl_c_or_a_kill_the_same_units_go_on(by: signal.Signals, tmp_path: Path):
    (tmp_path / "script.py").write_text(SCRIPT)
    work, unit = tmp_path / "work", Fake("long", ticks=100)
    process = subprocess.Popen(
        [sys.executable, "script.py"],
        cwd=tmp_path,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    ticks = unit.folder(work) / "ticks"
    deadline = time.monotonic() + 120.0
    while not ticks.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    with pytest.raises(OutlapError, match="another process is at work there"):
        run_units([unit], work, LocalEngine(1))
    process.send_signal(by)
    process.wait(timeout=30)
    time.sleep(1.0)  # a worker whose parent was killed sees it at its next report
    left = int(ticks.read_text())
    time.sleep(0.3)
    assert int(ticks.read_text()) == left < 100  # nobody works on
    assert not unit.is_done(work)
    run_units([unit], work, LocalEngine(1))
    assert unit.is_done(work)
    assert len(begun(unit, work)) == 2
    assert done_record(unit, work)["seconds"] < 0.05 * (100 - left) + 10.0  # what was done is not done again


def test_estimates_follow_what_units_really_took(tmp_path: Path):
    units = [Fake(f"unit {number}", ticks=20) for number in range(8)]
    assert estimate_seconds(units, finished_rates(tmp_path), slots=2, shares={}) is None  # nothing has finished
    for unit, seconds in zip(units[:4], (1.0, 2.0, 3.0, 6.0), strict=True):
        folder = unit.folder(tmp_path)
        folder.mkdir(parents=True)
        record = {"seconds": seconds, "category": unit.category, "size": unit.size}
        (folder / "done.json").write_text(json.dumps(record))
    rates = finished_rates(tmp_path)
    assert estimate_seconds(units[4:], rates, slots=2, shares={}) == pytest.approx(4 * 3.0 / 2)
    assert estimate_seconds([Fake("twice", ticks=40)], rates, slots=2, shares={}) == pytest.approx(6.0)
    # The last unit cannot be shared.
    assert estimate_seconds(units[7:], rates, slots=2, shares={units[7].key: 0.5}) == pytest.approx(1.5)
    assert estimate_seconds([], rates, slots=2, shares={}) == 0.0


def test_units_that_follow_from_finished_ones_are_done_too(tmp_path: Path):
    first, second = Fake("first"), Fake("second")
    last = Fake("last", before=(first, second))
    finished: list[str] = []

    def on_done(unit: Unit) -> list[Unit]:
        finished.append(unit.name)
        return [last] if {"first", "second"} == {*finished} else []

    run_units([first, second], tmp_path, LocalEngine(2), on_done=on_done)
    assert sorted(finished) == ["first", "last", "second"]
    assert last.is_done(tmp_path)
    finished.clear()
    run_units([first, second], tmp_path, LocalEngine(2), on_done=on_done)  # finished ones are reported again
    assert finished == ["first", "second", "last"]
    assert [len(begun(unit, tmp_path)) for unit in (first, second, last)] == [1, 1, 1]


def test_another_version_does_not_reuse_units(monkeypatch: pytest.MonkeyPatch):
    before, same = Fake("unit").key, Fake("unit").key
    assert before == same
    monkeypatch.setattr("outlap.experiments.unit._version", lambda package: f"{package} of tomorrow")
    assert Fake("unit").key != before
