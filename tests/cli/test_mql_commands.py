"""`outlap train mql`, `adapt` and `benchmark mql` as a user calls them."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pandas as pd
import pytest
from filelock import FileLock

from one_process import OneProcess
from outlap.cli.main import main
from outlap.evaluation.metrics import summarise_methods
from outlap.evaluation.recording import Recording
from outlap.evaluation.rollout import evaluate
from outlap.mql.adaptation import adapt
from outlap.track.map_io import write_track
from synthetic_tracks import ring

SMALL = [
    "--env.tracks", "ring5", "--env.beams", "8", "--env.no-augment-tracks", "--env.termination.time-limit", "4",
    "--num-envs", "4", "--learning-starts", "16", "--batch-size", "16", "--buffer-size", "2000", "--total-steps", "64",
]  # fmt: skip
SHORT = [
    "--iterations", "1", "--collect-steps", "10", "--collect-worlds", "2", "--replay-steps", "2", "--episodes", "3",
]  # fmt: skip


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run of a current folder from which two rings have names."""
    for radius in (5.0, 6.0):
        write_track(ring(radius), tmp_path / "maps" / f"ring{radius:.0f}")
    monkeypatch.setenv("OUTLAP_TRACKS", str(tmp_path / "maps"))
    monkeypatch.chdir(tmp_path)
    assert main(["train", "mql", *SMALL, "--out", "run", "--quiet"]) == 0
    return tmp_path / "run"


@pytest.fixture
def one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Adaptations in this process."""
    monkeypatch.setattr("outlap.experiments.workers.ProcessPoolExecutor", OneProcess)


@pytest.mark.usefixtures("one_process")
def test_train_evaluate_and_adapt(run: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "run", "--tracks", "ring6", "--episodes", "3", "--time-limit", "2", "--quiet"]) == 0
    capfd.readouterr()
    words = ["run", "--tracks", "ring6", "--seeds", "2", *SHORT, "--time-limit", "2", "--out", "adapted", "--quiet"]
    assert main(["adapt", *words, "--record", "1", "--json", "-"]) == 0
    data = json.loads(capfd.readouterr()[0])
    assert set(data) == {"before", "none", "fixed", "abc", "folder", "recordings"}
    assert (data["before"]["all"]["episodes"], data["abc"]["all"]["episodes"]) == (3, 6)
    assert data["abc"]["all"]["seeds"] == 2
    rows = pd.read_parquet("adapted/episodes.parquet")
    assert len(rows) == 3 + 2 * 3 * 3
    # The same episodes for all: the start says so.
    starts = rows.groupby(["method", "adaptation_seed"])["start_m"].apply(list)
    assert all(start == starts.iloc[0] for start in starts)
    updates = pd.read_parquet("adapted/updates.parquet")
    assert len(updates) == 2 * 3 * 2
    assert {"beta_mean", "clip_level", "clipped_share", "effective_sample_size", "proximal_weight"} <= set(updates)
    assert updates["classifier_accuracy"].between(0.5, 1.0).all()
    # The same episode before and after, in this order, with the context that the policy acted on.
    files = sorted(Path("adapted/recordings").iterdir())
    assert [file.stem for file in files] == [f"ring6-000-{name}" for name in ("0-before", "1-none", "2-fixed", "3-abc")]
    recordings = [Recording.load(file) for file in files]
    assert len({recording.info.seed for recording in recordings}) == 1
    assert all(recording.context.shape == (len(recording.time), 32) for recording in recordings)
    assert main(["replay", "adapted", "--out", "adapted.html"]) == 0
    assert main(["plot", "contexts", "adapted", "--out", "contexts.png"]) == 0


@pytest.mark.usefixtures("one_process")
def test_an_adaptation_goes_on_where_it_was_interrupted(
    run: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["adapt", "run", "--tracks", "ring6", "--seeds", "2", "--clip", "none", "abc", *SHORT, "--record", "1"]
    words += ["--time-limit", "2", "--jobs", "1", "--quiet"]
    assert main([*words, "--out", "whole"]) == 0
    raced: list[str] = []

    def interrupted_in_the_third(driver, *arguments, **keywords):
        raced.append(driver.name)
        if len(raced) == 3:
            raise KeyboardInterrupt
        return evaluate(driver, *arguments, **keywords)

    monkeypatch.setattr("outlap.evaluation.rollout.evaluate", interrupted_in_the_third)
    capfd.readouterr()
    assert main(words) == 130
    (folder,) = Path("run/adaptations").iterdir()
    again = "outlap adapt run --jobs 1 --tracks ring6 --clip none abc --seeds 2 --iterations 1 --collect-steps 10"
    again += f" --collect-worlds 2 --replay-steps 2 --episodes 3 --time-limit 2.0 --record 1 --out {folder}"
    assert f"saved; go on with: {again}\n" in capfd.readouterr()[1]
    with FileLock(folder / "work" / ".lock"):
        assert main([*words, "--out", str(folder)]) == 2
    assert "another process is at work there" in capfd.readouterr()[1]
    assert main([*again.split()[1:], "--quiet"]) == 0
    assert raced == ["before", "none", "abc", "abc", "none", "abc"]
    for name in ("episodes.parquet", "updates.parquet"):
        pd.testing.assert_frame_equal(pd.read_parquet(folder / name), pd.read_parquet(Path("whole") / name))
    assert {path.name for path in folder.rglob("*")} == {path.name for path in Path("whole").rglob("*")}
    assert main([*words, "--out", str(folder), "--seeds", "3"]) == 0
    assert raced[6:] == ["none", "abc"]  # only what is new
    assert main([*words, "--out", str(folder), "--clip", "fixed", "none"]) == 0
    assert raced[8:] == ["fixed", "fixed"]  # the order of the rules does not matter
    kept = sorted(path.stem for path in (folder / "recordings").iterdir())
    assert kept == ["ring6-000-0-before", "ring6-000-1-fixed", "ring6-000-2-none"]


@pytest.mark.usefixtures("one_process")
def test_adapting_goes_on_with_the_rewards_that_training_ended_with(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    began_at = []

    def noting(meta, task, *args, **settings):
        began_at.append(task.env.training_progress)
        return adapt(meta, task, *args, **settings)

    monkeypatch.setattr("outlap.mql.adaptation.adapt", noting)
    words = ["adapt", "run", "--tracks", "ring6", "--seeds", "1", "--clip", "none", *SHORT, "--time-limit", "1"]
    assert main([*words, "--quiet"]) == 0
    assert began_at == [1.0]


def test_a_run_of_a_gpu_is_adapted_on_the_cpu_where_there_is_none(run: Path, capfd: pytest.CaptureFixture[str]) -> None:
    config = run / "config.yaml"
    config.write_text(config.read_text().replace("device: cpu", "device: cuda:99"))
    words = ["adapt", "run", "--tracks", "ring6", "--seeds", "1", "--clip", "none", *SHORT, "--time-limit", "1"]
    capfd.readouterr()
    assert main([*words, "--quiet"]) == 0
    assert (
        capfd.readouterr()[1] == "run: was trained on device cuda:99, which is not available; continuing on the CPU\n"
    )


def test_a_folder_of_somebody_else_is_left_as_it_is(run: Path, capfd: pytest.CaptureFixture[str]) -> None:
    drawing = Path("car/parts/chassis.dxf")
    drawing.parent.mkdir(parents=True)
    drawing.touch()
    words = ["adapt", "run", "--tracks", "ring6", *SHORT, "--quiet", "--out"]
    assert main([*words, "car"]) == 2
    assert "car: is there already; must be an empty or a new folder" in capfd.readouterr()[1]
    assert drawing.exists()
    # The command continues in what a process leaves that was killed before it had done anything.
    Path("killed/work").mkdir(parents=True)
    Path("killed/work/.lock").touch()
    assert main([*words, "killed", "--seeds", "1", "--clip", "none", "--time-limit", "1"]) == 0


def test_wrong_arguments_are_one_line(run: Path, capfd: pytest.CaptureFixture[str]) -> None:
    config = run / "config.yaml"
    for words, said in (
        (["adapt", "nowhere"], "is not a run folder"),
        (["adapt", "run", "--seeds", "0"], "--seeds is 0; must be 1 or more"),
        (["adapt", "run", "--clip", "tight"], "clip"),
        (["adapt", "run", "--tracks", "nowhere"], "no track is called 'nowhere'"),
        (["train", "ppo", "--resume", "run"], "was trained with mql, not ppo"),
        (["benchmark", "mql", "--batch", "1"], "--batch must be at least 2"),
    ):
        capfd.readouterr()
        assert main(words) == 2
        err = capfd.readouterr()[1]
        assert said in err
        assert err.count("\n") == 1
    (run / "replay.npz").unlink()
    assert main(["adapt", "run", "--tracks", "ring6"]) == 2
    assert "cannot be read as a replay" in capfd.readouterr()[1]
    assert config.exists()


def test_the_seed_is_the_unit() -> None:
    rows = pd.DataFrame(
        {
            "method": ["before"] * 2 + ["abc"] * 4,
            "adaptation_seed": [-1, -1, 0, 0, 1, 1],
            "track": "ring",
            "outcome": ["crash", "timeout", "crash", "crash", "timeout", "timeout"],
            "mean_speed_mps": [1.0, 3.0, 2.0, 2.0, 4.0, 4.0],
            "lap_time_ratio": [math.nan, math.nan, 1.1, math.nan, 1.3, 1.3],
            "progress_m": 1.0,
        }
    )
    summary = summarise_methods(rows)
    assert summary["before"]["all"]["crash_rate"]["mean"] == 0.5
    abc = summary["abc"]["tracks"]["ring"]
    assert abc["crash_rate"]["mean"] == 0.5
    assert abc["crash_rate"]["sd"] == pytest.approx(0.5**0.5)  # of the two seeds: 1 and 0
    assert abc["mean_speed_mps"]["mean"] == 3.0
    assert abc["lap_time_ratio"]["mean"] == pytest.approx(1.2)
    assert summary["before"]["all"]["lap_time_ratio"]["mean"] is None


def test_benchmark_rows(capfd: pytest.CaptureFixture[str]) -> None:
    words = ["--preset", "fast", "--beams", "16", "--batch", "32", "--updates", "2", "--repeats", "1", "--json", "-"]
    assert main(["benchmark", "mql", *words, "--quiet"]) == 0
    (row,) = json.loads(capfd.readouterr()[0])["rows"]
    assert (row["preset"], row["beams"], row["batch"]) == ("fast", 16, 32)
    assert row["update_ms"] > 0
    assert row["env_steps_per_second"] > 0
