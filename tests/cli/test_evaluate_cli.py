"""`outlap evaluate`: what it prints, writes and refuses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from outlap.cli.main import main
from outlap.config import save_config
from outlap.envs.race_config import RaceConfig
from outlap.evaluation.hot_spots import hot_spots
from outlap.evaluation.metrics import summarise
from outlap.simulator.vehicle import VehicleParams
from outlap.track.catalog import load_track
from outlap.track.map_io import write_track
from outlap.training.ppo import PPOConfig
from outlap.training.run import create_run
from synthetic_tracks import ring
from untrained_policies import untrained_ppo

ENV = RaceConfig(
    tracks=("ring5",),
    num_cars=2,
    opponent_speed=1.0,
    beams=10,
    control_interval=10,
    speed_range=(0.0, 4.0),
    vehicle=VehicleParams(mu=(0.5, 1.0)),
    observation=("scan", "vel"),
    scale_observations=True,
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run and two tracks, the first of which the run was trained on."""
    folder = tmp_path_factory.mktemp("evaluate")
    for radius in (5.0, 4.0):
        track = ring(radius=radius)
        write_track(track, folder / "maps" / track.name)
    run = create_run(folder / "run", PPOConfig(env=ENV, held_out_tracks=("ring4",), net_arch=(16, 16)))
    untrained_ppo(ENV, ring(radius=5.0)).save(run.folder / "policy.zip")
    return folder


@pytest.fixture
def here(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty current folder, from which `made`'s tracks have names."""
    monkeypatch.setenv("OUTLAP_TRACKS", str(made / "maps"))
    monkeypatch.setenv("OUTLAP_CACHE", str(tmp_path / "cache"))
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"


@pytest.fixture
def fail(here: Path, capfd: pytest.CaptureFixture[str]):
    """Run `outlap evaluate ...` that has a mistake; gives its one line."""

    def fail(*words: str) -> str:
        capfd.readouterr()
        assert main(["evaluate", *words]) == 2
        out, err = capfd.readouterr()
        assert out == ""
        assert err.count("\n") == 1
        assert not list(here.rglob("*"))  # nothing was begun
        return err

    return fail


def run_of(made: Path) -> str:
    return str(made / "run")


def test_what_is_written_and_shown(made, here, capfd):
    words = ["evaluate", run_of(made), "--tracks", "ring5", "ring4", "--episodes", "5", "--laps", "1"]
    assert main([*words, "--out", "here", "--json", "result.json", "--quiet"]) == 0
    out, err = capfd.readouterr()
    assert err == ""
    assert "5 episodes on each track, 10 in all" in out
    assert "* trained on ring5: not a result on unseen tracks" in out
    assert "results: here" in out

    rows = pd.read_parquet("here/episodes.parquet")
    assert rows["track"].tolist() == ["ring5"] * 5 + ["ring4"] * 5
    assert rows["driver"].unique().tolist() == ["run"]
    assert rows["vehicle_mu"].between(0.5, 1.0).all()
    summary = json.loads(Path("here/summary.json").read_text())
    assert summary["trained_on"] == ["ring5"]
    assert {name: summary[name] for name in ("all", "tracks")} == summarise(rows)
    data = json.loads(Path("result.json").read_text())
    assert {name: data[name] for name in summary} == summary
    assert (data["driver"], data["folder"]) == ("run", "here")
    assert "crash" in rows["outcome"].tolist()
    assert data["crash_map"] == "here/crashes.png"
    assert Path("here/crashes.png").stat().st_size > 5_000
    assert "where they crashed: here/crashes.png" in out
    lengths = {name: load_track(name).centerline.length for name in ("ring5", "ring4")}
    assert summary["hot_spots"] == hot_spots(rows, lengths)

    record = json.loads(Path("here/evaluation.json").read_text())
    assert record["command"].startswith("outlap")
    assert record["policy"] == "policy.zip"
    assert len(record["policy_sha256"]) == 64
    assert (record["seed"], record["episodes_per_track"], record["stochastic"]) == (0, 5, False)
    assert record["versions"]["outlap"]
    env = RaceConfig.model_validate(record["env"])
    assert (env.num_cars, env.vehicle, env.termination.laps) == (2, ENV.vehicle, 1)
    assert env.start.speed == 0.0
    assert not [path for path in here.rglob("*") if ".partial" in path.name]


def test_json_on_standard_output_is_alone_there(made, here, capfd):
    assert main(["evaluate", run_of(made), "--episodes", "2", "--laps", "1", "--out", "x", "--json", "-"]) == 0
    data = json.loads(capfd.readouterr().out)
    # The run's own held-out track is what is evaluated where none is named.
    assert list(data["tracks"]) == ["ring4"]
    assert data["trained_on"] == []
    assert data["tracks"]["ring4"]["episodes"] == data["all"]["episodes"] == 2


def test_results_go_into_the_run_folder_and_never_over_each_other(made, here):
    for _ in range(2):
        assert main(["evaluate", run_of(made), "--episodes", "1", "--time-limit", "1", "--quiet"]) == 0
    assert len(list((made / "run" / "evaluations").glob("*/episodes.parquet"))) == 2
    assert not list(here.iterdir())


def test_a_seed_repeats_an_evaluation(made, here):
    for name, *changes in (("a",), ("b", "--worlds", "2"), ("c", "--seed", "1")):
        words = ["evaluate", run_of(made), "--episodes", "6", "--laps", "1", "--quiet", "--out", name, *changes]
        assert main(words) == 0
    a, b, c = (pd.read_parquet(f"{name}/episodes.parquet") for name in "abc")
    pd.testing.assert_frame_equal(a, b, check_exact=True)
    assert not set(a["seed"]) & set(c["seed"])


def test_stochastic_actions_are_other_ones_and_repeatable(made, here):
    for name, *changes in (("a",), ("b", "--stochastic"), ("c", "--stochastic")):
        words = ["evaluate", run_of(made), "--episodes", "4", "--laps", "1", "--quiet", "--out", name, *changes]
        assert main(words) == 0
    a, b, c = (pd.read_parquet(f"{name}/episodes.parquet") for name in "abc")
    pd.testing.assert_frame_equal(b, c, check_exact=True)
    assert not np.allclose(a["progress_m"], b["progress_m"])
    assert json.loads(Path("b/evaluation.json").read_text())["stochastic"] is True


def test_a_driver_without_a_run(here, capfd):
    words = ["evaluate", "centerline-follower", "--tracks", "ring5", "--episodes", "2", "--laps", "1", "--v-max", "2"]
    assert main([*words, "--json", "-", "--quiet"]) == 0
    data: dict[str, Any] = json.loads(capfd.readouterr().out)
    assert data["trained_on"] == []
    assert data["all"]["crash_rate"] == 0.0
    assert data["all"]["completed_laps"]["mean"] == 1.0
    assert data["all"]["mean_speed_mps"]["mean"] < 2.0 + 9.51 * 0.01  # one step of full acceleration past it
    assert Path(data["folder"]).parent == Path("runs/centerline-follower/evaluations")


def test_the_papers_protocol_ends_after_its_time(made, here):
    words = ["evaluate", run_of(made), "--episodes", "6", "--laps", "0", "--time-limit", "0.5", "--quiet", "--out", "x"]
    assert main(words) == 0
    rows = pd.read_parquet("x/episodes.parquet")
    assert max(rows["episode_steps"]) == 5  # 0.5 s of 0.1 s
    assert set(rows["outcome"]) <= {"timeout", "crash"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--episodes", "0"], "--episodes is 0; must be 1 or more"),
        (["--worlds", "0"], "--worlds is 0"),
        (["--laps", "-1"], "--laps is -1"),
        (["--laps", "0"], "be given with a --time-limit"),
        (["--time-limit", "0"], "--time-limit is 0"),
        (["--v-max", "nan"], "--v-max is nan"),
        (["--tracks", "Atlantis"], "no track is called 'Atlantis'"),
        (["--tracks", "ring4", "ring4"], "ring4 is named twice"),
    ],
)
def test_wrong_flags_are_one_line(made, fail, words, message):
    assert message in fail(run_of(made), *words, "--out", "x")


def test_wrong_runs_are_one_line(made, fail, tmp_path):
    assert "driver is 'nowhere'; must be " in fail("nowhere")
    assert "a run folder" in fail("nowhere")
    assert "centerline-follower" in fail("centreline")
    (tmp_path / "empty").mkdir()
    assert "no config.yaml" in fail(str(tmp_path / "empty"))
    untrained = create_run(tmp_path / "untrained", PPOConfig(env=ENV))
    assert "holds no policy yet" in fail(str(untrained.folder), "--tracks", "ring4")
    assert "draws nothing" in fail("centerline-follower", "--stochastic", "--tracks", "ring4")


def test_a_policy_of_another_configuration_is_refused(made, fail, tmp_path):
    run = create_run(tmp_path / "edited", PPOConfig(env=ENV, net_arch=(16, 16)))
    (run.folder / "policy.zip").write_bytes((made / "run" / "policy.zip").read_bytes())
    save_config(PPOConfig(env=ENV.model_copy(update={"beams": 20}), net_arch=(16, 16)), run.folder / "config.yaml")
    line = fail(str(run.folder), "--tracks", "ring4", "--out", "x", "--quiet")
    assert "trained on 10 numbers of 'scan' and would be shown 20" in line


def test_a_folder_with_something_in_it_is_left_alone(made, here, capfd):
    (here / "full").mkdir()
    (here / "full" / "thesis.tex").write_text("mine")
    assert main(["evaluate", run_of(made), "--tracks", "ring4", "--out", "full"]) == 2
    assert "must be an empty or a new folder" in capfd.readouterr().err
    assert [path.name for path in (here / "full").iterdir()] == ["thesis.tex"]


def test_interrupted_it_leaves_no_folder(made, here, monkeypatch, capfd):
    from outlap.drivers.policy import PolicyDriver

    def interrupt(self, observation):
        raise KeyboardInterrupt

    monkeypatch.setattr(PolicyDriver, "act", interrupt)
    assert main(["evaluate", run_of(made), "--tracks", "ring4", "--out", "x", "--quiet"]) == 130
    assert not (here / "x").exists()


def test_a_driver_without_a_run_races_the_task_of_one(made, here, capfd):
    """The run's cars, with their ranges, on its held-out tracks, along a line planned for them."""
    words = ["evaluate", "pure-pursuit", "--task", run_of(made), "--racing-line", "min-time", "--episodes", "3"]
    assert main([*words, "--laps", "1", "--out", "here", "--json", "-", "--quiet"]) == 0
    summary = json.loads(capfd.readouterr()[0])
    rows = pd.read_parquet("here/episodes.parquet")
    assert list(summary["tracks"]) == ["ring4"]
    friction = rows["vehicle_mu"].to_numpy()
    assert 0.5 <= friction.min() < friction.max() <= 1.0
    assert json.loads(Path("here/evaluation.json").read_text())["env"]["racing_line"] == "min-time"


def test_a_racing_line_is_for_those_who_follow_one(made, fail):
    line = fail("follow-the-gap", "--tracks", "ring5", "--racing-line", "min-time")
    assert "--racing-line is min-time; follow-the-gap follows no line" in line
