"""Units of work on a real Ray cluster of several nodes: lost nodes, restarts, an object store."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest
from filelock import FileLock

pytest.importorskip("ray", reason="needs Ray: pip install 'outlap[distributed]'")

import ray
from ray.cluster_utils import Cluster

from fake_units import Fake, begun, ended
from outlap.errors import OutlapError
from outlap.experiments.engine import LocalEngine
from outlap.experiments.ray_engine import RayEngine, ray_cluster
from outlap.experiments.runner import Status, run_units
from outlap.experiments.search import SearchConfig
from outlap.experiments.store import Store
from outlap.experiments.tune import Tuner

pytestmark = pytest.mark.slow
TESTS = str(Path(__file__).parents[1])


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """A head without cores for units, and a node of two."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", TESTS)  # where the workers find their units
        patch.setenv("RAY_worker_niceness", "0")  # or they wait for the tests beside these
        made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
        made.add_node(num_cpus=2, num_gpus=1)
        made.wait_for_nodes()
        ray.init(made.address, logging_level=logging.WARNING, log_to_driver=False)  # once: processes are used again
        yield made
        ray.shutdown()
        made.shutdown()


@pytest.fixture(params=["shared folder", "object store"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> str | None:
    return None if request.param == "shared folder" else f"file://{tmp_path / 'store'}"


def test_units_wait_for_what_they_need_and_are_done_once(cluster: Cluster, store: str | None, tmp_path: Path):
    work = tmp_path / "work"
    first, second = Fake("first", ticks=3), Fake("second", ticks=30)
    last = Fake("last", before=(first, second))
    seen: list[Status] = []
    run_units([first, second, last], work, RayEngine(store=store), on_status=seen.append)
    assert begun(last, work)[0] >= max(ended(first, work), ended(second, work))
    assert (seen[-1].done, seen[-1].units) == (3, 3)
    assert any("second" in status.running for status in seen)
    run_units([first, second, last], work, RayEngine(store=store))
    assert [len(begun(unit, work)) for unit in (first, second, last)] == [1, 1, 1]


def test_what_fails_stops_only_those_that_need_it(cluster: Cluster, store: str | None, tmp_path: Path):
    broken, other = Fake("broken", fails=True), Fake("other", ticks=2)
    after = Fake("after", before=(broken,))
    with pytest.raises(OutlapError) as error:
        run_units([broken, after, other], tmp_path / "work", RayEngine(store=store))
    assert "2 of 3 units of work failed, broken first (ValueError: no luck)" in str(error.value)
    assert other.is_done(tmp_path / "work")


def test_a_lost_node_loses_no_unit_that_is_done_and_its_units_go_on_elsewhere(
    cluster: Cluster, store: str | None, tmp_path: Path
):
    # Short units, and long ones which the node that is killed is in the middle of.
    work, released = tmp_path / "work", tmp_path / "released"
    short = [Fake(f"short {number}", ticks=2) for number in range(6)]
    long = [Fake(f"long {number}", until=str(released)) for number in range(4)]
    doomed = cluster.add_node(num_cpus=2)
    cluster.wait_for_nodes()
    spare: list[object] = []
    patience = time.monotonic()

    def times_begun() -> int:
        return sum(len(begun(unit, work)) for unit in long)

    def kill(status: Status) -> None:
        nonlocal patience
        at_work = times_begun() == 4 if store is None else True  # what is at work with a store is seen nowhere
        if not spare and status.done == len(short) and len(status.running) == len(long) and at_work:
            cluster.remove_node(doomed, allow_graceful=False)
            spare.append(cluster.add_node(num_cpus=2))
            patience = time.monotonic() + (20.0 if store is None else 3.0)
        elif spare and (times_begun() == 6 or time.monotonic() > patience):
            released.touch()

    run_units([*short, *long], work, RayEngine(store=store), on_status=kill)
    cluster.remove_node(spare[0])
    assert all(unit.is_done(work) for unit in (*short, *long))
    assert [len(begun(unit, work)) for unit in short] == [1] * len(short)
    if store is None:  # a process that outlives its node keeps its unit
        assert 5 <= times_begun() <= 6


def test_what_was_done_without_the_store_is_put_there(cluster: Cluster, tmp_path: Path):
    work, store = tmp_path / "work", f"file://{tmp_path / 'store'}"
    first, other = Fake("first"), Fake("other", ticks=100)
    second = Fake("second", before=(first,))
    last = Fake("last", before=(second,))
    run_units([first, second], work, LocalEngine(1))
    other.folder(work).mkdir(parents=True)
    (other.folder(work) / "ticks").write_text("99")  # as far as another engine came
    run_units([first, second, last, other], work, RayEngine(store=store))
    assert all(unit.is_done(work) for unit in (last, other))
    assert [len(begun(unit, work)) for unit in (first, second, last)] == [1, 1, 1]
    assert ended(other, work) - begun(other, work)[0] < 0.05 * 50
    assert Store(store).done() == {unit.key for unit in (first, second, last, other)}


def test_a_unit_that_cannot_be_fetched_stops_only_those_that_need_it(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    work, store = tmp_path / "work", f"file://{tmp_path / 'store'}"
    first, other = Fake("first"), Fake("other", ticks=20)

    def get(self: Store, unit: Fake, work: Path) -> None:
        if unit.name == "first":
            raise OSError("no network")
        fetch(self, unit, work)

    with monkeypatch.context() as patch:
        fetch = Store.get
        patch.setattr(Store, "get", get)
        with pytest.raises(OutlapError, match=r"1 of 2 units of work failed, first first \(OSError: no network\)"):
            run_units([first, other], work, RayEngine(store=store))
    assert other.is_done(work)
    run_units([first, other], work, RayEngine(store=store))
    assert len(begun(first, work)) == 1


def test_a_unit_uses_its_share_of_a_gpu(cluster: Cluster, tmp_path: Path):
    work, together = tmp_path / "halves", tmp_path / "together"
    halves = [Fake(f"half {number}", until=str(together), on_gpu=True) for number in range(2)]

    def release(_: Status) -> None:
        if all(begun(unit, work) for unit in halves):  # both at a time, or they would wait for ever
            together.touch()

    run_units(halves, work, RayEngine(gpu_share=0.5), on_status=release)
    whole = [Fake(f"whole {number}", ticks=10, on_gpu=True) for number in range(2)]
    run_units(whole, tmp_path / "whole", RayEngine(gpu_share=1.0))
    spans = sorted((begun(unit, tmp_path / "whole")[0], ended(unit, tmp_path / "whole")) for unit in whole)
    assert spans[0][1] <= spans[1][0]  # one after the other
    assert [(unit.folder(tmp_path / "whole") / "gpus").read_text() for unit in whole] == ["0", "0"]


def test_a_cluster_that_is_joined_already_is_kept(cluster: Cluster):
    with ray_cluster("auto"):
        assert ray.is_initialized()
    assert ray.is_initialized()


SCRIPT = """
import sys
from pathlib import Path
from fake_units import Fake
from outlap.experiments.ray_engine import RayEngine
from outlap.experiments.runner import run_units
units = [{units}]
run_units(units, Path("work"), RayEngine(sys.argv[1], store=sys.argv[2] if len(sys.argv) > 2 else None))
"""


@pytest.mark.parametrize(("by", "with_store"), [(signal.SIGINT, True), (signal.SIGKILL, False)])
def test_after_ctrl_c_or_a_kill_of_the_driver_the_same_units_go_on(
    cluster: Cluster, by: signal.Signals, with_store: bool, tmp_path: Path
):
    store = f"file://{tmp_path / 'store'}" if with_store else None
    work, short, long = tmp_path / "work", Fake("short"), Fake("long", ticks=80)
    process = started(cluster, tmp_path, 'Fake("short"), Fake("long", ticks=80)', *([store] if store else []))
    wait_for(lambda: short.is_done(work))
    time.sleep(1.0)
    process.send_signal(by)
    process.wait(timeout=60)
    assert not long.is_done(work)
    run_units([short, long], work, RayEngine(store=store))
    assert long.is_done(work)
    assert len(begun(short, work)) == 1
    assert len(begun(long, work)) == 2


def test_ctrl_c_ends_units_that_cannot_be_told(cluster: Cluster, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    engine, unit = RayEngine(), Fake("deaf", until="never", silent=True)
    (tmp_path / ".lock").touch()
    engine.open(tmp_path)
    engine.submit(unit)
    wait_for(lambda: begun(unit, tmp_path))
    ray.kill(engine._progress)
    wait_for(lambda: not engine.shares())  # it is gone a moment later
    engine.close()
    assert "cannot be told to stop" in caplog.text
    with FileLock(unit.folder(tmp_path) / ".lock", timeout=20.0):  # which the unit held
        assert not unit.is_done(tmp_path)


def started(cluster: Cluster, folder: Path, units: str, *store: str) -> subprocess.Popen[bytes]:
    """A process that does some units in a folder."""
    (folder / "script.py").write_text(SCRIPT.format(units=units))
    return subprocess.Popen(
        [sys.executable, "script.py", str(cluster.address), *store],
        cwd=folder,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": TESTS},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def wait_for(there) -> None:
    deadline = time.monotonic() + 60.0
    while not there():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_what_cannot_be_is_said_in_one_line(cluster: Cluster, tmp_path: Path):
    unit = Fake("first")
    with pytest.raises(OutlapError, match="--store nowhere://x: cannot be used"):
        RayEngine(store="nowhere://x")
    (tmp_path / "file").touch()
    with pytest.raises(OutlapError, match=r"cannot be written: .*; give another --store"):
        run_units([unit], tmp_path, RayEngine(store=f"file://{tmp_path / 'file' / 'store'}"))
    assert not begun(unit, tmp_path)


def test_a_machine_that_does_not_have_the_tracks_says_so(cluster: Cluster, tmp_path: Path):
    unit = Fake("first", on_track="Nightjar")
    with pytest.raises(OutlapError, match=r"track Nightjar: is another one on machine .* than where the work began"):
        run_units([unit], tmp_path, RayEngine(tracks={"Nightjar": "0" * 12}))
    assert not begun(unit, tmp_path)


SHORT = {
    "total_steps": 4096, "num_envs": 8, "n_steps": 16, "batch_size": 128, "n_epochs": 1, "net_arch": [8],
    "env": {"tracks": ["Nightjar"], "beams": 8, "termination": {"time_limit": 1.0}},
}  # fmt: skip


def test_a_search_stops_what_falls_behind_and_keeps_the_best(cluster: Cluster, store: str | None, tmp_path: Path):
    config = SearchConfig(
        algorithm="ppo",
        training=SHORT,
        search={"learning_rate": (1e-3, 1e-5)},
        rungs=(0.25,),
        episodes=4,
        time_limit=1.0,
    )
    tuner = Tuner(config, tmp_path)
    run_units(tuner.first_units(), tuner.work, RayEngine(store=store), on_done=tuner.on_done)
    found = tuner.results()
    assert sorted(found["learning_rate"]) == [1e-5, 1e-3]
    assert found["steps"].iloc[0] == 4096
    assert not found["stopped_early"].iloc[0]
    best = tuner.trials[int(found["trial"].iloc[0])].rungs[-1][0].run(tuner.work)
    assert best.finished
    assert best.config.learning_rate == found["learning_rate"].iloc[0]
    again = Tuner(config, tmp_path)
    run_units(again.first_units(), again.work, RayEngine(store=store), on_done=again.on_done)
    pd.testing.assert_frame_equal(again.results(), found)
