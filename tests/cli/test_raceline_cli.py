"""`outlap raceline`: files, JSON, and what is said of mistakes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from outlap.cli.main import main
from outlap.track.map_io import read_raceline_csv, write_track
from outlap.track.raceline import Raceline
from synthetic_tracks import ring

KEYS = {
    "track", "method", "lap_time_s", "length_m", "solve_time_s", "min_margin_m", "limits", "raceline", "picture",
    "own_lap_time_s",
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_track(ring(5.0), tmp_path_factory.mktemp("tracks") / "ring5")


def plan(*words: str | Path, capfd: pytest.CaptureFixture[str]) -> dict:
    assert main(["raceline", *map(str, words), "--json", "-"]) == 0
    return json.loads(capfd.readouterr()[0])


def test_it_writes_a_raceline_and_a_picture_and_tells_the_lap_time(folder, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    data = plan(folder, "--v-max", "5", capfd=capfd)
    assert set(data) == KEYS
    line = read_raceline_csv(tmp_path / "ring5_raceline.csv")
    assert line.speed.max() == pytest.approx(5.0)
    assert data["lap_time_s"] == pytest.approx(data["length_m"] / 5.0, rel=1e-3)
    assert (data["track"], data["method"], data["raceline"]) == ("ring5", "min-time", "ring5_raceline.csv")
    assert min(Image.open(tmp_path / data["picture"]).size) > 500


def test_limits_methods_and_vehicles_are_taken(folder, tmp_path, capfd):
    out = tmp_path / "lines" / "mine.csv"
    (tmp_path / "slow.yaml").write_text("v_max: 3.0\nmu: {min: 0.5, max: 0.7}\n")
    slow = plan(folder, "--vehicle", tmp_path / "slow.yaml", "--method", "min-curvature", "--out", out, capfd=capfd)
    assert (slow["limits"]["v_max"], slow["limits"]["mu"]) == (3.0, 0.6)
    assert out.is_file()
    assert out.with_suffix(".png").is_file()
    harder = ["--a-max", "5", "--a-brake", "8", "--mu", "0.9"]
    fast = plan(folder, "--vehicle", "paper", *harder, "--method", "centerline", "--out", out, capfd=capfd)
    limits = fast["limits"]
    assert (limits["v_max"], limits["a_max"], limits["a_brake"], limits["mu"]) == (8.0, 5.0, 8.0, 0.9)


def test_friction_from_a_file(folder, tmp_path, capfd):
    rows = [f"{s}, {d}, 0.4" for s in (0, 10) for d in (-1, 1)]
    (tmp_path / "ice.csv").write_text("s_m, d_m, mu\n" + "\n".join(rows))
    words = [folder, "--out", tmp_path / "a.csv", "--method", "centerline"]
    ice = plan(*words, "--friction", tmp_path / "ice.csv", capfd=capfd)
    assert ice["lap_time_s"] == pytest.approx(plan(*words, "--mu", "0.4", capfd=capfd)["lap_time_s"], rel=1e-6)


def test_it_is_compared_with_the_raceline_that_the_track_has(tmp_path, capfd):
    """A circle at 4 m/s on the centreline asks for v² / R of grip; the inside is shorter by 2 pi for every metre."""
    track = ring(5.0)
    angle = np.linspace(0.0, 2.0 * np.pi, 500, endpoint=False)
    ones = np.ones(500)
    theirs = Raceline(5.0 * angle, 5.0 * np.cos(angle), 5.0 * np.sin(angle), angle, 0.2 * ones, 4.0 * ones, 0.0 * ones)
    folder = write_track(replace(track, raceline=theirs), tmp_path / "ring5")
    data = plan(folder, "--vehicle", "track", "--out", tmp_path / "a.csv", capfd=capfd)
    assert data["own_lap_time_s"] == pytest.approx(2.0 * np.pi * 5.0 / 4.0, rel=1e-3)
    assert data["limits"]["mu"] == pytest.approx(4.0**2 / 5.0 / 9.81)
    assert data["limits"]["v_max"] == 4.0
    assert data["lap_time_s"] < data["own_lap_time_s"]


def test_a_maps_own_raceline_is_not_replaced_unasked(tmp_path, monkeypatch, capfd):
    folder = write_track(ring(5.0), tmp_path / "ring5")
    monkeypatch.chdir(folder)
    assert main(["raceline", ".", "--method", "centerline"]) == 2
    assert "belongs to the map in this folder; to replace it, give --out ring5_raceline.csv" in capfd.readouterr()[1]
    assert main(["raceline", ".", "--method", "centerline", "--out", "ring5_raceline.csv"]) == 0
    assert (folder / "ring5_raceline.csv").is_file()


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--mu", "-1"], "--mu is -1.0; must be > 0"),
        (
            ["--vehicle", "tractor"],
            "--vehicle is 'tractor'; must be one of f1tenth, paper, forzaeth, a yaml file",
        ),
        (["--vehicle", "track"], "ring5 has no raceline that could ask anything"),
        (["--margin", "1.5"], "it is narrower than 3.31 m"),
        (["--margin", "-0.1"], "margin is -0.1; it must be zero or more metres"),
        (["--out", "line.txt"], "--out is line.txt; must be a file that ends in .csv"),
        (["--friction", "nowhere.csv"], "nowhere.csv: does not exist"),
        (["--method", "fastest"], "--method"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(folder, tmp_path, monkeypatch, capfd, words, complaint):
    monkeypatch.chdir(tmp_path)
    assert main(["raceline", str(folder), *words, "--quiet"]) == 2
    error = capfd.readouterr()[1].strip()
    assert complaint in error
    assert error.startswith("outlap raceline: error:")
    assert "\n" not in error
    assert not list(tmp_path.iterdir())
