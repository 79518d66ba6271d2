"""The drawn map shows what the track says, at the right place."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from outlap.errors import OutlapError
from outlap.track.generate import generate_track
from outlap.track.raceline import Raceline
from outlap.track.track import Track
from outlap.viewer.plots import BLUE, VERMILION, WALL_GREY, draw_raceline, draw_track


@pytest.fixture(scope="module")
def track() -> Track:
    return generate_track(4, length=90.0, resolution=0.05)


def colours_at(figure: Figure, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """What the picture shows at points of the map (n,) [m]: (n, 3) in [0, 1]."""
    figure.canvas.draw()
    picture = np.asarray(figure.canvas.buffer_rgba())  # pyright: ignore[reportAttributeAccessIssue]
    columns, rows = figure.axes[0].transData.transform(np.column_stack((x, y))).T
    return picture[picture.shape[0] - 1 - rows.astype(int), columns.astype(int), :3] / 255


def rotated(track: Track, yaw: float) -> Track:
    """The same grid turned about its corner; the centreline stays, so the walls lie elsewhere."""
    return dataclasses.replace(track, origin=(track.origin[0], track.origin[1], yaw))


@pytest.mark.parametrize("yaw", [0.0, 0.3])
def test_walls_are_drawn_where_they_are(track, yaw):
    drawn = rotated(track, yaw)
    figure = draw_track(drawn)
    low, high = drawn.centerline.points.min(axis=0), drawn.centerline.points.max(axis=0)
    x, y = np.random.default_rng(0).uniform(low, high, size=(4000, 2)).T
    around = [drawn.is_wall(x + dx, y + dy) for dx in (-0.4, 0, 0.4) for dy in (-0.4, 0, 0.4)]
    col, row = drawn.world_to_grid(x, y)
    inside = (col > 10) & (row > 10) & (col < track.occupancy.shape[1] - 10) & (row < track.occupancy.shape[0] - 10)
    colours = colours_at(figure, x, y)
    grey = np.all(np.abs(colours - to_rgb(WALL_GREY)) < 0.01, axis=1)
    wall, free = np.all(around, axis=0) & inside, ~np.any(around, axis=0)
    assert min(wall.sum(), free.sum()) > 100
    assert np.mean(grey[wall]) > 0.9  # marks and the arrow cover the rest
    assert np.mean(grey[free]) < 0.01


def test_thin_walls_of_a_large_map_do_not_vanish(track):
    occupancy = np.zeros((4000, 4000), dtype=bool)
    occupancy[1500] = True
    size = 100 / 4000
    low = track.centerline.points.mean(axis=0) - 50
    sparse = dataclasses.replace(track, occupancy=occupancy, resolution=size, origin=(*low, 0.0))
    figure = draw_track(sparse)
    left, right = figure.axes[0].get_xlim()
    x = np.linspace(left, right, 500)
    y = np.full(500, low[1] + 1500.5 * size)
    offsets = np.array([-0.1, -0.05, 0, 0.05, 0.1])[:, None]  # a printed pixel is up to 0.1 m
    colours = colours_at(figure, np.tile(x, 5), (y + offsets).ravel()).reshape(5, 500, 3)
    seen = np.any(np.abs(colours - 1) > 0.05, axis=2)
    assert np.mean(np.any(seen, axis=0)) > 0.95


def test_centreline_and_curvature_are_the_tracks_own(track):
    figure = draw_track(track)
    line = next(line for line in figure.axes[0].lines if line.get_color() == BLUE)
    _, offset = track.centerline.to_frenet(*np.asarray(line.get_xydata()).T)
    np.testing.assert_allclose(offset, 0, atol=1e-6)
    s, curvature = np.asarray(figure.axes[1].lines[0].get_xydata()).T
    assert s[-1] == pytest.approx(track.centerline.length)
    np.testing.assert_allclose(curvature, track.centerline.curvature(s))
    low, high = figure.axes[1].get_ylim()
    assert low < curvature.min() < curvature.max() < high


def test_whole_track_is_in_view_and_not_distorted(track):
    axes = draw_track(track).axes[0]
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    edges = track.centerline.to_cartesian(np.linspace(0, 90, 500)[:, None], np.array([-1.1, 1.1])).reshape(-1, 2)
    assert left < edges[:, 0].min() < edges[:, 0].max() < right
    assert bottom < edges[:, 1].min() < edges[:, 1].max() < top
    assert axes.get_aspect() == 1.0


def test_raceline_is_drawn_and_named_only_if_there_is_one(track):
    s = np.linspace(0, 90, 200, endpoint=False)
    x, y = track.centerline.to_cartesian(s, 0.5 * np.sin(s)).T
    raceline = Raceline(s=s, x=x, y=y, heading=0 * s, curvature=0 * s, speed=5 + 0 * s, acceleration=0 * s)

    def drawn(figure: Figure) -> tuple[int, bool]:
        lines = [line for line in figure.axes[0].lines if line.get_color() == VERMILION]
        return len(lines), any(text.get_text() == "racing line" for text in figure.legends[0].get_texts())

    assert drawn(draw_track(track)) == (0, False)
    with_raceline = draw_track(dataclasses.replace(track, raceline=raceline))
    assert drawn(with_raceline) == (1, True)


@pytest.mark.parametrize("clockwise", [True, False])
def test_title_says_name_length_and_direction(clockwise):
    figure = draw_track(generate_track(1, length=60.0, clockwise=clockwise, name="Testbourne"))
    title = figure.axes[0].get_title(loc="left")
    assert title == f"Testbourne: 60 m, {'clockwise' if clockwise else 'anticlockwise'}"


def test_saves_png_and_pdf(track, tmp_path):
    draw_track(track, tmp_path / "track.png")
    with Image.open(tmp_path / "track.png") as image:
        assert image.width >= 1200
        assert len(image.convert("RGB").getcolors(1 << 20) or ()) > 10
    draw_track(track, tmp_path / "track.pdf")
    assert (tmp_path / "track.pdf").read_bytes().startswith(b"%PDF")


def test_unknown_format_is_named(track, tmp_path):
    with pytest.raises(OutlapError, match=r"track\.xyz: ending is 'xyz'; must be png, pdf or svg"):
        draw_track(track, tmp_path / "track.xyz")


def test_leaves_matplotlibs_global_state_alone():
    code = "import sys, outlap.viewer.plots; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_raceline_is_coloured_by_its_speed(track, tmp_path):
    """The first half of the centreline is driven slowly and the rest fast: dark and bright in viridis."""
    line = track.centerline
    s = np.linspace(0.0, line.length, 400, endpoint=False)
    x, y = line.position(s).T
    speed = np.where(s < 0.5 * line.length, 2.0, 6.0)
    zero = np.zeros_like(s)
    raceline = Raceline(s, x, y, line.heading(s), line.curvature(s), speed, zero)
    figure = draw_raceline(track, raceline, tmp_path / "line.png", lap_time=12.345)
    colours = colours_at(figure, x, y)
    bright = colours.sum(axis=1)
    assert np.median(bright[speed < 3.0]) < 1.0 < 1.5 < np.median(bright[speed > 3.0])
    assert "lap 12.35 s" in figure.axes[0].get_title("left") or "lap 12.34 s" in figure.axes[0].get_title("left")
    assert min(Image.open(tmp_path / "line.png").size) > 500
