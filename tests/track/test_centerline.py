"""The centreline against closed forms, brute force and its own inverse."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ellipe

from outlap.errors import OutlapError
from outlap.track.centerline import TABLE, Centerline
from synthetic_tracks import circular, wavy

CIRCUITS = [
    "BrandsHatch",
    "Hockenheim",
    "IMS",
    "Monza",
    "Nuerburgring",
    "Silverstone",
    "Spielberg",
    "YasMarina",
    "Zandvoort",
    "levine",
]


def ellipse(count: int, a: float = 30.0, b: float = 12.0) -> tuple[np.ndarray, np.ndarray]:
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return angle, np.column_stack([a * np.cos(angle), b * np.sin(angle)])


def brute_force_frenet(line: Centerline, x: float, y: float) -> tuple[float, float]:
    """The nearest of samples 1 mm apart, and the distance to it."""
    s = np.linspace(0.0, line.length, math.ceil(line.length / 1e-3), endpoint=False)
    position = line.position(s)
    distance = np.hypot(position[:, 0] - x, position[:, 1] - y)
    nearest = int(np.argmin(distance))
    return s[nearest], distance[nearest]


@pytest.mark.parametrize("direction", [1.0, -1.0], ids=["anticlockwise", "clockwise"])
def test_circle_has_its_length_heading_and_curvature(direction: float) -> None:
    radius = 5.0
    angle = direction * np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    line = Centerline.from_points(radius * np.column_stack([np.cos(angle), np.sin(angle)]), 1.0, 1.0)
    s = np.linspace(-3.0, 50.0, 1001)  # wraps round at both ends
    turned = direction * s / radius
    assert line.length == pytest.approx(2.0 * np.pi * radius, abs=1e-6)
    np.testing.assert_allclose(line.position(s), radius * np.column_stack([np.cos(turned), np.sin(turned)]), atol=1e-6)
    np.testing.assert_allclose(line.curvature(s), direction / radius, rtol=1e-3)
    heading = line.heading(s)
    assert np.all((heading > -np.pi) & (heading <= np.pi))
    np.testing.assert_allclose(np.exp(1j * (heading - turned)), direction * 1j, atol=1e-5)


def test_ellipse_has_its_circumference_and_curvature() -> None:
    a, b = 30.0, 12.0
    angle, points = ellipse(400, a, b)
    line = Centerline.from_points(points, 1.0, 1.0)
    assert line.length == pytest.approx(4.0 * a * ellipe(1.0 - (b / a) ** 2), abs=1e-4)
    speed = np.hypot(a * np.sin(angle), b * np.cos(angle))
    np.testing.assert_allclose(line.curvature(line.s), a * b / speed**3, rtol=2e-3)
    np.testing.assert_allclose(
        np.exp(1j * line.heading(line.s)), (-a * np.sin(angle) + 1j * b * np.cos(angle)) / speed, atol=1e-5
    )


def test_s_is_true_arc_length_though_the_points_are_unevenly_spread() -> None:
    rng = np.random.default_rng(3)
    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, 150))
    line = Centerline.from_points(np.column_stack([20.0 * np.cos(angle), 9.0 * np.sin(angle)]), 1.0, 1.0)
    s = np.linspace(0.0, line.length, 200_001)
    walked = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line.position(s), axis=0).T))])
    np.testing.assert_allclose(walked, s, atol=1e-4)


def test_the_line_goes_through_its_points_and_starts_at_the_first() -> None:
    _, points = ellipse(60)
    line = Centerline.from_points(points, 1.0, 1.0)
    assert line.s[0] == 0.0
    np.testing.assert_allclose(line.position(line.s), points, atol=1e-9)
    np.testing.assert_allclose(line.position(line.length), points[0], atol=1e-9)


def test_a_closed_last_point_and_repeated_points_change_nothing() -> None:
    _, points = ellipse(60)
    widths = np.linspace(0.5, 1.5, 60)
    plain = Centerline.from_points(points, widths, 1.0)
    closed = Centerline.from_points(np.vstack([points, points[:1]]), np.append(widths, widths[0]), 1.0)
    order = np.concatenate([[0, 0], np.arange(1, 30), [29, 29], np.arange(30, 60), [0, 0]])
    repeated = Centerline.from_points(points[order], widths[order], 1.0)
    for other in (closed, repeated):
        np.testing.assert_array_equal(other.points, points)
        np.testing.assert_array_equal(other.width_right, widths)
        assert other.length == plain.length


def test_widths_are_linear_between_points_and_over_the_start_line() -> None:
    _, points = ellipse(8)
    line = Centerline.from_points(points, np.arange(8.0), 2.0)
    middle = 0.5 * (line.s[2] + line.s[3])
    right, left = line.widths([middle, 0.5 * (line.s[7] + line.length), -0.5 * (line.length - line.s[7])])
    np.testing.assert_allclose(right, [2.5, 3.5, 3.5])
    np.testing.assert_allclose(left, 2.0)


def test_to_cartesian_puts_positive_offsets_on_the_left() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    line = Centerline.from_points(5.0 * np.column_stack([np.cos(angle), np.sin(angle)]), 1.0, 1.0)
    # driven anticlockwise, the centre is on the left
    np.testing.assert_allclose(line.to_cartesian(0.0, 1.0), [4.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(line.to_frenet(6.0, 0.0), (0.0, -1.0), atol=1e-5)


def test_to_frenet_finds_the_globally_nearest_point() -> None:
    line = wavy()
    rng = np.random.default_rng(4)
    x, y = rng.uniform(-20.0, 34.0, 60), rng.uniform(-31.0, 23.0, 60)
    s, d = line.to_frenet(x, y)
    for i in range(60):
        _, distance = brute_force_frenet(line, x[i], y[i])
        assert abs(d[i]) <= distance + 1e-9
        assert abs(d[i]) == pytest.approx(distance, abs=1e-5)
    np.testing.assert_allclose(line.to_cartesian(s, d), np.column_stack([x, y]), atol=1e-6)


def test_to_frenet_keeps_shapes() -> None:
    line = wavy()
    assert line.to_frenet(np.zeros((2, 3)), np.zeros((2, 3)))[0].shape == (2, 3)
    assert line.to_frenet(1.0, 2.0)[1].shape == ()
    assert line.to_cartesian(np.zeros((2, 3)), 0.1).shape == (2, 3, 2)


def check_round_trip(line: Centerline) -> None:
    rng = np.random.default_rng(5)
    s = np.concatenate([rng.uniform(0.0, line.length, 20_000), [0.0, 1e-9, line.length - 1e-9]])
    right, left = line.widths(s)
    d = rng.uniform(-right, left)
    x, y = line.to_cartesian(s, d).T
    s_back, d_back = line.to_frenet(x, y)
    assert np.all((s_back >= 0.0) & (s_back < line.length))
    np.testing.assert_allclose(line.to_cartesian(s_back, d_back), np.column_stack([x, y]), atol=1e-6)
    assert np.all(np.abs(d_back) <= np.abs(d) + 1e-9)  # never a point further away
    nearest = (np.abs(d_back) > np.abs(d) - 1e-6) & (np.abs(d * line.curvature(s)) < 0.99)
    assert nearest.mean() > 0.98
    np.testing.assert_allclose(circular(s_back - s, line.length)[nearest], 0.0, atol=1e-3)
    np.testing.assert_allclose((d_back - d)[nearest], 0.0, atol=1e-3)


def test_frenet_round_trip() -> None:
    check_round_trip(wavy())


@pytest.mark.parametrize("circuit", CIRCUITS)
def test_frenet_round_trip_on_real_circuits(real_tracks: Path, circuit: str) -> None:
    from outlap.track import load_track

    if not (real_tracks / circuit).is_dir():
        pytest.skip(f"needs real circuits: OUTLAP_TRACKS has no {circuit}")
    check_round_trip(load_track(real_tracks / circuit).centerline)


def test_points_traced_on_pixels_make_a_line_that_a_car_can_follow() -> None:
    # a rounded rectangle, its corners 1 m in radius, each point moved to its 0.05 m pixel
    quarter = np.linspace(0.0, np.pi / 2.0, 40)
    corners = [(8.0, 3.0, 0.0), (-8.0, 3.0, 0.5), (-8.0, -3.0, 1.0), (8.0, -3.0, 1.5)]
    arcs = [
        np.column_stack([x + np.cos(quarter + turn * np.pi), y + np.sin(quarter + turn * np.pi)])
        for x, y, turn in corners
    ]
    clean = Centerline.from_points(np.vstack(arcs), 1.0, 1.0)
    exact = clean.position(np.arange(0.0, clean.length, 0.04))
    pixels = np.round(exact / 0.05) * 0.05
    _, first = np.unique(np.round(pixels / 0.05).astype(int), axis=0, return_index=True)
    line = Centerline.from_points(pixels[np.sort(first)], 1.0, 1.0)
    s = np.arange(0.0, line.length, 0.01)
    assert np.abs(line.curvature(s)).max() <= 1.0 / 0.19
    s_clean, d = clean.to_frenet(*line.position(s).T)
    assert np.abs(d).max() < 0.15
    turned = np.angle(np.exp(1j * (line.heading(s) - clean.heading(s_clean))))
    assert np.abs(turned).max() < 0.35  # the pixels themselves turn by 0.8 at a time


@pytest.mark.parametrize(
    ("points", "right", "message"),
    [
        (np.zeros((3, 2)) + np.arange(3)[:, None], 1.0, "3 distinct points; .* at least 4"),
        (np.zeros((9, 2)), 1.0, "1 distinct points"),
        (np.zeros((5, 3)), 1.0, r"shape \(5, 3\)"),
        ([[0, 0], [1, 0], [1, np.nan], [0, 1]], 1.0, "y_m of point 3 is nan; it must be finite"),
        ([[0, 0], [np.inf, 0], [1, 1], [0, 1]], 1.0, "x_m of point 2 is inf"),
        ([[0, 0], [1, 0], [1, 1], [0, 1]], [1, 1, -0.5, 1], r"w_tr_right_m of point 3 is -0.5"),
        ([[0, 0], [1, 0], [1, 1], [0, 1]], [1, 1], r"w_tr_right_m has shape \(2,\)"),
    ],
)
def test_bad_points_are_named(points: object, right: object, message: str) -> None:
    with pytest.raises(OutlapError, match=message):
        Centerline.from_points(points, right, 1.0)  # type: ignore[arg-type]


def test_table_is_uniform_in_s_and_holds_the_line() -> None:
    line = wavy()
    table = line.table(0.1)
    h = line.length / len(table)
    assert table.dtype == TABLE
    assert 0.09 < h <= 0.1
    s = np.arange(len(table)) * h
    np.testing.assert_allclose(np.stack([table["x"], table["y"]], axis=-1), line.position(s), atol=1e-5)
    np.testing.assert_allclose(
        np.stack([table["tangent_x"], table["tangent_y"]], axis=-1),
        np.column_stack([np.cos(line.heading(s)), np.sin(line.heading(s))]),
        atol=1e-6,
    )
    np.testing.assert_allclose(table["curvature"], line.curvature(s), atol=1e-6)
    np.testing.assert_allclose(table["width_right"], 1.0)
    np.testing.assert_allclose(table["width_left"], 1.2)
    with pytest.raises(OutlapError, match="spacing is 0"):
        line.table(0.0)
