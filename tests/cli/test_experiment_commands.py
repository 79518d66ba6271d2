"""`outlap reproduce` and `outlap compare`, as they are used."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pandas as pd
import pytest

from outlap.cli.main import main
from outlap.evaluation.hot_spots import hot_spots

METHODS = ["vanilla-dr", "mql-abc", "follow-the-gap", "recurrent-ppo"]
SMALLEST = ["--budget", "smoke", "--seeds", "1", "--methods", *METHODS]
TABLES = ["table-1", "table-2", "table-3", "everything", "vehicles"]
COLUMNS = {
    "task_set", "table", "task", "method", "training_seed", "seed", "track", "outcome", "episode_steps",
    "episode_return", "last_reward", "overtakes", "places_lost", "completed_laps", "lap_time_s", "progress_m",
    "mean_speed_mps", "impact_speed_mps",
}  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of everything, in the smallest budget, with one seed and those methods that differ in their code."""
    folder = tmp_path_factory.mktemp("reproduce") / "report"
    words = ["reproduce", "all", *SMALLEST, "--out", str(folder), "--quiet"]
    assert main(words) == 0
    return folder


def test_everything_comes_from_one_command(made: Path):
    data = json.loads((made / "results.json").read_text())
    assert list(data["tables"]) == TABLES
    for methods in data["tables"].values():
        assert list(methods) == METHODS
        for metrics in methods.values():
            for entry in metrics.values():
                assert {"value", "low", "high", "seeds", "published"} <= {*entry}
                assert entry["seeds"] == 1
    assert data["tables"]["table-1"]["mql-abc"]["crashes"]["published"] == 500
    assert data["tables"]["table-3"]["recurrent-ppo"]["crashes"]["published"] is None
    variance = data["figure-2"]["loss_variance"]
    assert (variance["fixed"]["published"], variance["abc"]["published"]) == (2.23e-6, 8.40e-7)
    assert variance["abc_over_fixed"]["published"] == pytest.approx(1 / 2.7, abs=0.01)
    assert (variance["abc_over_fixed"]["seeds"], variance["abc_over_fixed"]["adaptations"]) == (1, 2)
    assert data["record"]["versions"]["outlap"]
    assert data["record"]["command"]


def test_every_episode_is_a_row(made: Path):
    rows = pd.read_parquet(made / "episodes.parquet")
    assert {*rows.columns} >= COLUMNS
    seeds = {key: tuple(mine["seed"]) for key, mine in rows.groupby(["table", "method"])}
    for table in TABLES:
        # Everybody races the same episodes.
        assert len({seeds[table, method] for method in METHODS}) == 1


def test_the_report_is_whole_and_stands_by_itself(made: Path):
    markdown, page = (made / "report.md").read_text(), (made / "report.html").read_text()
    shown = re.findall(r"!\[[^]]*]\(([^)]+)\)", markdown)
    assert len(shown) == 5 + 1 + 1 + 5  # tables, profiles, figure 2, appendix B to F
    for name in shown:
        assert (made / name).stat().st_size > 5000
        assert (made / name).with_suffix(".svg").is_file()
    assert page.count("data:image/svg+xml;base64,") == len(shown)
    assert not re.search(r'(src|href)="(?!data:)', page)  # nothing is loaded from elsewhere
    assert page.count("<table>") == len(re.findall(r"^\|---\|", markdown, re.MULTILINE))
    assert "built-in" in next(line for line in markdown.splitlines() if line.startswith("## Table III"))
    assert "too small to say anything" in markdown
    assert "| MQL-ABC | 1,280 |" in markdown  # what went into every method


def test_the_same_command_again_does_no_work_and_part_of_it_neither(made: Path, capfd: pytest.CaptureFixture[str]):
    before = {path: path.stat().st_mtime_ns for path in (made / "work").rglob("done.json")}
    words = ["reproduce", "table-2", "figure-2", *SMALLEST, "--out", str(made)]
    assert main([*words, "--dry-run", "--json", "-"]) == 0
    assert set(json.loads(capfd.readouterr().out)["missing"].values()) == {0}
    assert main([*words, "--quiet"]) == 0
    assert {path: path.stat().st_mtime_ns for path in (made / "work").rglob("done.json")} == before
    assert list(json.loads((made / "results.json").read_text())["tables"]) == ["table-2"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["reproduce", "table-4"], "'table-4' is no table or figure; must be one of"),
        (["reproduce"], "nothing to make"),
        (["reproduce", "all", "--budget", "nowhere.yaml"], "nowhere.yaml: no such file"),
        (["reproduce", "all", "--methods", "mqll"], "method is 'mqll'; must be a .yaml file, or one of"),
        (["reproduce", "all", "--seeds", "0"], "--seeds is 0; must be 1 or more"),
        (["compare", "follow-the-gap"], "one run alone"),
        (["compare", "follow-the-gap", "nowhere"], "driver is 'nowhere'"),
        (["compare", "follow-the-gap", "pure-pursuit", "--time-limit", "0"], "--time-limit is 0.0; must be > 0"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(words: list[str], said: str, capfd: pytest.CaptureFixture[str]):
    assert main(words) == 2
    out, err = capfd.readouterr()
    assert (out, len(err.splitlines())) == ("", 1)
    assert said in err


def test_drivers_are_compared_on_the_same_episodes(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    words = ["--episodes", "3", "--time-limit", "4", "--out", str(tmp_path / "report"), "--quiet", "--json", "-"]
    assert main(["compare", "follow-the-gap", "centerline-follower", "--tracks", "Foxglove", *words]) == 0
    data = json.loads(capfd.readouterr().out)
    assert data["unit"] == "episode"
    assert list(data["methods"]) == ["follow-the-gap", "centerline-follower"]
    assert {each["metric"] for each in data["differences"]} == {"crashes", "progress_m"}
    rows = pd.read_parquet(tmp_path / "report" / "episodes.parquet")
    assert len({tuple(mine["seed"]) for _, mine in rows.groupby("method")}) == 1
    assert list(data["hot_spots"]) == ["follow-the-gap", "centerline-follower"]
    for method, found in data["hot_spots"].items():
        assert found == hot_spots(rows.loc[rows["method"] == method], {"Foxglove": 340.0})
    assert (tmp_path / "report" / "report.html").is_file()
