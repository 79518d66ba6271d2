"""`outlap opponents`, and opponents in `outlap evaluate` and `outlap train`: as a user calls them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from outlap.cli.main import main
from outlap.drivers.ghost import Ghost
from outlap.drivers.population import read_manifest
from outlap.experiments.engine import Engine
from outlap.experiments.opponent_units import OpponentUnit
from outlap.track.map_io import write_track
from outlap.training.opponents import Opponent
from small_populations import driver, population, ring_driver, save_population
from synthetic_tracks import ring

RADIUS = 5.0  # [m]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A current folder of its own, from which a ring has a name."""
    write_track(ring(radius=RADIUS), tmp_path / "maps" / "ring5")
    monkeypatch.setenv("OUTLAP_TRACKS", str(tmp_path / "maps"))
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"


@pytest.fixture
def call(capfd: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """Run a command; gives what `--json -` writes."""

    def call(*words: str) -> Any:
        capfd.readouterr()
        assert main([*words, "--json", "-"]) == 0
        return json.loads(capfd.readouterr().out)

    return call


@pytest.fixture
def fail(capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run a command that has a mistake; gives its one line."""

    def fail(*words: str) -> str:
        capfd.readouterr()
        assert main(list(words)) == 2
        out, err = capfd.readouterr()
        assert (out, err.count("\n")) == ("", 1)
        return err

    return fail


@pytest.fixture
def mixed(here: Path) -> str:
    """A population of one that laps the ring and one that knows nothing, which is held out."""
    good = ring_driver(RADIUS, "good", speeds=(0.5, 3.5))
    return str(save_population(here / "mixed", (good, "train"), (driver(name="bad"), "held_out"), track="ring5"))


def test_the_list_has_what_the_manifest_says(here: Path, call: Callable[..., Any]) -> None:
    population(here / "mine", "train", "held_out")
    first, second = call("opponents", "list", "mine")["opponents"]
    assert first == {
        "name": "ring-2.0", "max_speed_mps": 2.0, "split": "train", "track": "ring", "verified_laps": 5,
        "crash_rate": 0.0, "lap_time_s": 10.0,
    }  # fmt: skip
    assert list(second) == list(first)
    assert (second["name"], second["split"]) == ("ring-3.0", "held_out")


def test_the_list_is_a_table_for_a_person(mixed: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["opponents", "list", mixed]) == 0
    out, err = capfd.readouterr()
    assert err == ""
    assert [name in out for name in ("good", "bad", "held out", f"population: {mixed}")] == [True] * 4
    assert "failed" not in out


def test_verification_takes_those_that_fail_out_of_the_manifest(mixed: str, call: Callable[..., Any]) -> None:
    words = ["opponents", "verify", mixed, "--laps", "2", "--starts", "3", "--quiet"]
    rows = {row["name"]: row for row in call(*words)["opponents"]}
    assert (rows["good"]["verified"], rows["bad"]["verified"]) == (True, False)
    assert (rows["good"]["crash_rate"], rows["bad"]["crash_rate"]) == (0.0, 1.0)
    assert rows["bad"]["lap_time_s"] is None
    (member,) = read_manifest(mixed)
    assert (member.name, member.verified_laps, member.command) == ("good", 2, "outlap opponents train")
    assert member.lap_time_s == pytest.approx(2.0 * math.pi * RADIUS / 2.0, rel=0.05)
    assert rows["good"]["lap_time_s"] == pytest.approx(member.lap_time_s)
    assert [row["name"] for row in call(*words)["opponents"]] == ["good"]


def test_a_population_of_which_nobody_passes_is_empty_and_says_so(
    here: Path, call: Callable[..., Any], fail: Callable[..., str]
) -> None:
    save_population(here / "bad", (driver(0, "a"), "train"), (driver(1, "b"), "train"), track="ring5")
    rows = call("opponents", "verify", "bad", "--laps", "1", "--starts", "2", "--quiet")["opponents"]
    assert [row["verified"] for row in rows] == [False, False]
    assert "bad/manifest.json: names no opponent" in fail("opponents", "list", "bad")
    assert "bad/manifest.json: names no opponent" in fail("opponents", "verify", "bad")


def test_a_recorded_lap_is_a_driver(call: Callable[..., Any]) -> None:
    recorded = call("opponents", "record", "pure-pursuit", "--track", "ring5", "--out", "laps/fast.csv")
    assert recorded["lap"] == "laps/fast.csv"
    assert len(Ghost.load("laps/fast.csv").lap) == recorded["points"]
    words = ["--tracks", "ring5", "--episodes", "2", "--laps", "1", "--quiet"]
    raced = call("evaluate", "laps/fast.csv", *words)
    assert raced["driver"] == "fast"
    assert raced["all"]["crash_rate"] == 0.0
    assert raced["all"]["lap_time_s"]["mean"] == pytest.approx(recorded["lap_time_s"], rel=0.02)


def test_a_member_records_and_races_in_the_car_that_it_was_trained_in(mixed: str, call: Callable[..., Any]) -> None:
    lap_time = 2.0 * math.pi * RADIUS / 2.0  # at the middle of 0.5 … 3.5 m/s
    recorded = call("opponents", "record", f"{mixed}/good", "--track", "ring5", "--out", "good.csv")
    assert recorded["lap_time_s"] == pytest.approx(lap_time, rel=0.05)
    words = ["--tracks", "ring5", "--episodes", "2", "--laps", "1", "--quiet"]
    assert call("evaluate", f"{mixed}/good", *words)["all"]["lap_time_s"]["mean"] == pytest.approx(lap_time, rel=0.05)
    bad = call("evaluate", f"{mixed}/bad", *words)
    assert (bad["driver"], bad["all"]["episodes"]) == ("bad", 2)


def test_a_population_as_a_whole_is_not_one_driver(mixed: str, fail: Callable[..., str]) -> None:
    for words in (("evaluate", mixed), ("opponents", "record", mixed, "--track", "ring5", "--out", "x.csv")):
        assert f"{mixed}: is a population; name one of its drivers, {mixed}/NAME: good, bad" in fail(*words)
    assert not Path("x.csv").exists()


def test_a_race_counts_places_and_contacts(call: Callable[..., Any]) -> None:
    race = ["evaluate", "pure-pursuit", "--num-cars", "2", "--opponents", "pure-pursuit", "--formation", "behind"]
    ends = ["--tracks", "ring5", "--laps", "0", "--time-limit", "3", "--episodes", "4", "--quiet", "--out", "x"]
    summary = call(*race, *ends)["all"]
    assert {"overtakes", "places_lost", "contacts", "opponent_crashes"} <= set(summary)
    assert set(summary["contacts"]) == {"wall", "car"}
    assert summary["places_lost"] == 0  # nobody is behind
    record = json.loads(Path("x/evaluation.json").read_text())
    assert (record["env"]["start"]["formation"], record["env"]["num_cars"]) == ("behind", 2)
    assert pd.read_parquet("x/episodes.parquet")["opponent_1"].tolist() == ["pure-pursuit"] * 4


def test_opponents_of_an_evaluation_are_held_out_unless_told_otherwise(
    here: Path, call: Callable[..., Any], fail: Callable[..., str]
) -> None:
    crawler = ring_driver(RADIUS, "crawler", speed_action=-1.0, speeds=(0.5, 3.0))
    save_population(here / "slow", (crawler, "held_out"), track="ring5")
    race = ["evaluate", "pure-pursuit", "--num-cars", "2", "--opponents", "slow", "--formation", "behind"]
    ends = ["--tracks", "ring5", "--laps", "0", "--time-limit", "4", "--episodes", "6", "--quiet", "--out", "x"]
    summary = call(*race, *ends)["all"]
    assert summary["contacts"]["car"] + summary["overtakes"] == 6  # it passes the car before it, or does not
    assert summary["contacts"]["car"] >= 1
    assert pd.read_parquet("x/episodes.parquet")["opponent_1"].tolist() == ["crawler"] * 6
    assert "slow: has no opponent in its train half" in fail(*race, *ends[:-1], "y", "--opponent-split", "train")


def test_no_training_meets_the_held_out_half(mixed: str, here: Path, fail: Callable[..., str]) -> None:
    words = ["train", "ppo", "--env.num-cars", "2", "--env.tracks", "ring5", "--total-steps", "64", "--out", "run"]
    flag = fail(*words, "--env.opponents", mixed, "--env.opponent-split", "held_out")
    assert "opponent_split is 'held_out'; must be 'train'" in flag
    (here / "mine.yaml").write_text("env: {opponent_split: held_out}\n")
    assert "opponent_split is 'held_out'; must be 'train'" in fail(*words, "--config", "mine.yaml")
    assert f"{mixed}/bad: is held out" in fail(*words, "--env.opponents", f"{mixed}/bad")
    assert not Path("run").exists()


@pytest.fixture
def planned(monkeypatch: pytest.MonkeyPatch) -> list[OpponentUnit]:
    """Units that `opponents train` would do."""
    planned: list[OpponentUnit] = []

    def note(units: Sequence[OpponentUnit], work: Path, engine: Engine, *callbacks: Any) -> None:
        planned.extend(units)

    def enter(units: Sequence[OpponentUnit], work: Path, folder: Path, command: str) -> list[tuple]:
        rows = pd.DataFrame({"completed_laps": [5], "lap_time_s": [np.nan], "outcome": ["finished"]})
        assert folder == Path("populations") / work.parent.name
        return [(unit, rows, "entered") for unit in units]

    monkeypatch.setattr("outlap.experiments.runner.run_units", note)
    monkeypatch.setattr("outlap.experiments.opponent_units.enter_all", enter)
    return planned


def test_training_is_of_every_speed_of_both_halves(planned: list[OpponentUnit], call: Callable[..., Any]) -> None:
    words = ["--track", "ring5", "--speeds", "2.0:3.1:0.5", "--held-out", "3.5", "--steps", "1_000", "--quiet"]
    data = call("opponents", "train", *words)
    assert [unit.opponent for unit in planned] == [
        Opponent("ring5-2.0", 2.0, "train"), Opponent("ring5-2.5", 2.5, "train"), Opponent("ring5-3.0", 3.0, "train"),
        Opponent("ring5-3.5", 3.5, "held_out"),
    ]  # fmt: skip
    assert {(unit.settings.total_steps, unit.laps, unit.starts) for unit in planned} == {(1000, 5, 20)}
    assert data["folder"] == "populations/ring5"
    assert [row["name"] for row in data["opponents"]] == [unit.name for unit in planned]


def test_the_last_speed_is_not_passed(planned: list[OpponentUnit], call: Callable[..., Any]) -> None:
    call("opponents", "train", "--track", "ring5", "--speeds", "2:3:0.6", "--held-out", "3.2", "--quiet")
    assert [each.max_speed_mps for each in planned] == [2.0, 2.6, 3.2]
    assert [each.split for each in planned] == ["train", "train", "held_out"]


def test_a_tracks_name_becomes_one_that_files_can_have(
    here: Path, planned: list[OpponentUnit], call: Callable[..., Any]
) -> None:
    write_track(replace(ring(radius=RADIUS), name="Ring (new) #2"), here / "Ring (new) #2")
    call("opponents", "train", "--track", "./Ring (new) #2", "--speeds", "2:2:1", "--held-out", "3", "--quiet")
    assert [each.name for each in planned] == ["Ring-new-2-2.0", "Ring-new-2-3.0"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--speeds", "2.0"], "--speeds is '2.0'; must be first:last:step, such as 2.0:6.0:0.5"),
        (["--speeds", "slow:fast:1"], "--speeds is 'slow:fast:1'; must be first:last:step"),
        (["--speeds", "2:6:0"], "--speeds is '2:6:0'; must be first:last:step"),
        (["--speeds", "6:2:1"], "--speeds is '6:2:1'; must be first:last:step"),
        (["--speeds", "nan:6:1"], "--speeds is 'nan:6:1'; must be first:last:step"),
        (["--speeds", "2:inf:1"], "--speeds is '2:inf:1'; must be first:last:step"),
        (["--speeds", "0.5:6:0.5"], "a top speed is 0.5; must be more than 0.5 m/s"),
        (["--held-out", "nan"], "a top speed is nan; must be more than 0.5 m/s"),
        (["--held-out", "3.0"], "two opponents would be called ring5-3.0"),
        (["--speeds", "2:2.1:0.04"], "two opponents would be called ring5-2.0"),
        (["--laps", "0"], "--laps is 0; must be 1 or more"),
        (["--starts", "0"], "--starts is 0; must be 1 or more"),
        (["--jobs", "-1"], "--jobs is -1; must be 0 or more"),
        (["--track", "Atlantis"], "no track is called 'Atlantis'"),
        (["--env.opponent-split", "held_out"], "opponent_split is 'held_out'; must be 'train'"),
    ],
)
def test_wrong_flags_of_a_training_are_one_line(
    planned: list[OpponentUnit], fail: Callable[..., str], here: Path, words: list[str], message: str
) -> None:
    assert message in fail("opponents", "train", "--track", "ring5", *words, "--quiet")
    assert planned == []
    assert not list(here.iterdir())


def test_wrong_folders_are_one_line(here: Path, fail: Callable[..., str]) -> None:
    (here / "empty").mkdir()
    for words in (("list", "empty"), ("list", "nowhere"), ("verify", "empty", "--quiet")):
        line = fail("opponents", *words)
        assert f"{words[1]}: is no population, it has no manifest.json; make one with outlap opponents train" in line
    (here / "broken").mkdir()
    (here / "broken" / "manifest.json").write_text('{"opponents": [')
    assert "broken/manifest.json: cannot be read" in fail("opponents", "list", "broken")
    (here / "broken" / "manifest.json").write_text('{"opponents": [{"name": "../../etc"}]}')
    assert "broken/manifest.json: opponents.0.name is '../../etc'" in fail("opponents", "list", "broken")


def test_tampered_weights_are_one_line_wherever_they_are_used(here: Path, fail: Callable[..., str]) -> None:
    population(here / "mine", "train", "held_out")
    driver(9, "ring-2.0", speeds=(0.0, 2.0)).save(here / "mine" / "ring-2.0")
    for words in (
        ("opponents", "verify", "mine", "--quiet"),
        ("evaluate", "mine/ring-2.0", "--tracks", "ring5"),
        ("opponents", "record", "mine/ring-2.0", "--track", "ring5", "--out", "x.csv"),
        ("train", "ppo", "--env.tracks", "ring5", "--env.num-cars", "2", "--env.opponents", "mine", "--out", "run"),
    ):
        assert "mine/ring-2.0.safetensors: its SHA-256 is" in fail(*words)
    assert [path.name for path in here.iterdir()] == ["mine"]
    assert len(read_manifest("mine")) == 2


def test_a_lap_that_is_not_completed_leaves_no_file(mixed: str, fail: Callable[..., str]) -> None:
    line = fail("opponents", "record", f"{mixed}/bad", "--track", "ring5", "--out", "x.csv")
    assert "driver bad: completed no lap of ring5 (crash after" in line
    assert not Path("x.csv").exists()


@pytest.mark.parametrize(
    ("out", "message"),
    [("lap", "--out is lap; must end in .csv"), ("file/lap.csv", "--out file/lap.csv: cannot be written")],
)
def test_where_a_lap_cannot_go_is_one_line(here: Path, fail: Callable[..., str], out: str, message: str) -> None:
    (here / "file").write_text("mine")
    assert message in fail("opponents", "record", "centerline-follower", "--track", "ring5", "--out", out)
    assert [path.name for path in here.iterdir()] == ["file"]


def test_a_broken_recording_is_one_line(here: Path, fail: Callable[..., str]) -> None:
    (here / "lap.csv").write_text("a,b\n1,2\n")
    assert "lap.csv: cannot be read as a recorded lap" in fail("evaluate", "lap.csv", "--tracks", "ring5")
    race = ["evaluate", "pure-pursuit", "--num-cars", "2", "--opponents", "gone.csv", "--tracks", "ring5"]
    assert "gone.csv: cannot be read as a recorded lap" in fail(*race)
