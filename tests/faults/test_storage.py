"""A place that cannot be written to is one line that names it and says what to do, before any work is done."""

from __future__ import annotations

from pathlib import Path

import pytest

from outlap.cli.main import main

SMALL = ["--total-steps", "64", "--num-envs", "2", "--env.beams", "8", "--env.tracks", "Foxglove", "--threads", "1"]
CHEAP = ["--env.no-augment-tracks"]
PLACES = ("plain/new", "/proc/new")  # below a file; of a system that makes no folders: root is kept out of both
COMMANDS = {
    "train ppo": [*SMALL, *CHEAP, "--n-steps", "8", "--batch-size", "16"],
    "opponents train": ["--track", "Foxglove"],
    "reproduce": ["table-1", "--budget", "smoke", "--methods", "follow-the-gap"],
    "evaluate": ["follow-the-gap", "--tracks", "Foxglove", "--episodes", "1", "--quiet"],
    "compare": ["follow-the-gap", "pure-pursuit"],
}


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A current folder with a plain file in it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plain").write_text("of the user")
    return tmp_path


def said_of(words: list[str], capfd: pytest.CaptureFixture[str]) -> str:
    """The one line of a command that fails."""
    assert main(words) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    return err


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("command", COMMANDS)
def test_a_folder_that_cannot_be_made(command: str, place: str, here: Path, capfd: pytest.CaptureFixture[str]) -> None:
    said = said_of([*command.split(), *COMMANDS[command], "--out", place], capfd)
    assert place in said
    assert "give another --out" in said
    assert [path.name for path in here.iterdir()] == ["plain"]
    assert (here / "plain").read_text() == "of the user"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A meta-training: what `adapt` and `export` take."""
    folder = tmp_path_factory.mktemp("meta") / "run"
    words = [*SMALL, *CHEAP, "--learning-starts", "32", "--batch-size", "8", "--buffer-size", "200"]
    assert main(["train", "mql", *words, "--out", str(folder), "--quiet"]) == 0
    return folder


@pytest.mark.parametrize("command", ["adapt", "export"])
def test_what_a_run_is_made_into(command: str, run: Path, capfd: pytest.CaptureFixture[str]) -> None:
    capfd.readouterr()
    place = "plain/new" if command == "adapt" else "plain/policy.onnx"
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    said = said_of([command, str(run), "--out", place], capfd)
    assert place in said
    assert "give another" in said or "cannot make the folder plain" in said
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before


def test_the_cache_of_tracks(here: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("OUTLAP_CACHE", str(here / "plain"))
    said = said_of(["tracks", "download", "Monza", "--url", "http://127.0.0.1:9/{name}"], capfd)
    assert f"{here / 'plain' / 'tracks'}: cannot write here" in said
    assert "set OUTLAP_CACHE to a folder" in said
