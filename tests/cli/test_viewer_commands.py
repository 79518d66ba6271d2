"""`outlap watch`, `replay`, `video` and `plot` as a user calls them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from outlap.cli.main import main
from outlap.evaluation.recording import Recording
from outlap.track.map_io import write_track
from synthetic_tracks import ring

SHORT = ["--time-limit", "3", "--quiet"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the maps of two tracks, and an evaluation with recordings on both."""
    folder = tmp_path_factory.mktemp("viewer")
    for radius in (5.0, 6.0):
        write_track(ring(radius, half_width=1.5), folder / "maps" / f"ring{radius:.0f}")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OUTLAP_TRACKS", str(folder / "maps"))
        words = ["pure-pursuit", "--tracks", "ring5", "ring6", "--episodes", "3", "--laps", "0", *SHORT]
        assert main(["evaluate", *words, "--record", "2", "--out", str(folder / "raced")]) == 0
    return folder


@pytest.fixture
def here(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty current folder, from which the tracks have names."""
    monkeypatch.setenv("OUTLAP_TRACKS", str(made / "maps"))
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_an_evaluation_keeps_its_first_episodes(made: Path, here: Path):
    files = sorted((made / "raced" / "recordings").iterdir())
    assert [file.stem for file in files] == ["ring5-000", "ring5-001", "ring6-000", "ring6-001"]
    import pandas as pd

    rows = pd.read_parquet(made / "raced" / "episodes.parquet").groupby("track").head(2)
    assert [Recording.load(file).info.seed for file in files] == rows["seed"].tolist()


def test_recordings_and_drivers_in_one_replay(made: Path, here: Path, capfd: pytest.CaptureFixture[str]):
    words = [str(made / "raced"), "follow-the-gap", "--track", "ring6", "--out", "race.html", *SHORT]
    assert main(["replay", *words, "--json", "-"]) == 0
    data = json.loads(capfd.readouterr()[0])
    assert [race["title"] for race in data["races"]] == ["pure-pursuit #1", "pure-pursuit #2", "follow-the-gap"]
    assert data["bytes"] == Path("race.html").stat().st_size > 10_000


def test_a_video_of_a_driver(here: Path, capfd: pytest.CaptureFixture[str]):
    words = ["pure-pursuit", "--track", "ring5", "--opponents", "follow-the-gap", "--size", "320", "240", "--fps", "10"]
    assert main(["video", *words, "--out", "race.mp4", *SHORT]) == 0
    assert "race.mp4 (" in capfd.readouterr()[0]
    assert Path("race.mp4").stat().st_size > 3_000


def test_a_picture_of_a_moment(made: Path, here: Path):
    recording = str(made / "raced" / "recordings" / "ring5-000.npz")
    for at in ("0.5", "2.0"):
        words = ["video", recording, "--at", at, "--size", "321", "200", "--view", "track", "--out", f"at-{at}.png"]
        assert main([*words, "--quiet"]) == 0
    pictures = [np.asarray(Image.open(f"at-{at}.png")) for at in ("0.5", "2.0")]
    assert pictures[0].shape == (200, 321, 3)
    assert (pictures[0] != pictures[1]).any()


@pytest.mark.parametrize("kind", ["trajectories", "friction"])
def test_plots_of_recordings(made: Path, here: Path, kind: str):
    assert main(["plot", kind, str(made / "raced"), "--track", "ring5", "--out", "plot.svg"]) == 0
    assert Path("plot.svg").read_text().lstrip().startswith("<?xml")


def test_watching_ends_with_the_window(here: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]):
    from outlap.viewer.watch import Watch

    monkeypatch.setattr(Watch, "run", lambda self: self.window.close())
    assert main(["watch", "pure-pursuit", "--track", "ring5", "--json", "-"]) == 0
    assert json.loads(capfd.readouterr()[0]) == {"driver": "pure-pursuit", "track": "ring5", "episodes": 1}


def test_mistakes_are_one_line(made: Path, here: Path, capfd: pytest.CaptureFixture[str]):
    raced = str(made / "raced")
    (here / "empty").mkdir()
    for words, said in (
        (["replay"], "no episode named"),
        (["replay", "pure-pursuit", "--out", "race.txt"], "must end in .html"),
        (["replay", "pure-pursuit", "--laps", "-1"], "--laps is -1; must be 0 or more"),
        (["replay", f"{raced}/recordings/ring5-000.npz", "--seed", "3"], "--seed: is for drivers that race now"),
        (["evaluate", "pure-pursuit", "--record", "-1"], "--record is -1"),
        (["replay", "missing.npz"], "missing.npz: no such file"),
        (["replay", "empty"], "empty: holds no recording"),
        (["replay", raced], "recordings of several tracks: ring5, ring6; say which one with --track"),
        (["replay", f"{raced}/recordings/ring5-000.npz", "--track", "ring6"], "was raced on ring5"),
        (["video", "pure-pursuit", "--out", "race.avi"], "must end in .mp4 or .gif or .png"),
        (["video", "pure-pursuit", "--at", "3"], "--at is for a .png"),
        (["video", "pure-pursuit", "--speed", "0"], "--speed is 0.0; must be > 0"),
        (["plot", "friction", "nobody"], "nobody"),
        (["plot", "friction", "pure-pursuit", "--out", "plot.jpg"], "must end in .png or .pdf or .svg"),
        (["watch", "pure-pursuit", "--size", "0", "0"], "--size is 0; must be 64 or more"),
        (["plot", "contexts", raced], "has no context"),
        (["plot", "learning", "nowhere"], "is not a run folder"),
        (["plot", "lap-times", "empty"], "holds no episodes.parquet"),
        (["plot", "lap-times", raced], "no episode has a completed lap"),
        (["plot", "crashes", "empty"], "holds no episodes.parquet"),
        (["watch", "nobody"], "nobody"),
    ):
        capfd.readouterr()
        assert main([*words]) == 2, words
        out, err = capfd.readouterr()
        assert out == ""
        assert err.count("\n") == 1
        assert said in err, words
    assert [path.name for path in here.iterdir()] == ["empty"]
