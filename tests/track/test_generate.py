"""Generated circuits keep what they promise: length, width, radius, no overlap, direction, variety."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import ndimage

from circuit_features import measure_features
from outlap.errors import OutlapError
from outlap.track import circuit, generate
from outlap.track.centerline import Centerline
from outlap.track.generate import BUILTIN_HELD_OUT, BUILTIN_TRAIN, builtin_track, generate_track

CASES = [
    {"seed": 1},
    {"seed": 2, "length": 40.0, "min_radius": 1.2},
    {"seed": 3, "length": 150.0, "width": 1.0, "min_radius": 0.6},
    {"seed": 4, "length": 300.0, "width": 4.0, "min_radius": 10.0, "resolution": 0.08},
    {"seed": 5, "length": 600.0, "resolution": 0.08},
    {"seed": 6, "length": 19.0, "width": 2.0, "min_radius": 1.5},  # hardly longer than a circle
]


@pytest.fixture(scope="module", params=CASES, ids=lambda case: f"seed{case['seed']}")
def made(request: pytest.FixtureRequest):
    """A track and the arguments that it was made from."""
    return generate_track(**request.param), {
        "length": 300.0,
        "width": 2.2,
        "min_radius": 1.5,
        **request.param,
    }


def test_length_and_widths_are_as_asked(made):
    track, asked = made
    assert track.centerline.length == pytest.approx(asked["length"], rel=0.01)
    right, left = track.centerline.widths(np.linspace(0, asked["length"], 50))
    np.testing.assert_allclose(right, asked["width"] / 2)
    np.testing.assert_allclose(left, asked["width"] / 2)


def test_radius_is_never_below_the_minimum(made):
    track, asked = made
    s = np.arange(0, track.centerline.length, 0.01)
    assert np.max(np.abs(track.centerline.curvature(s))) <= 1.02 / asked["min_radius"]


def test_turns_once_around(made):
    """A simple closed curve turns by ±2π (Hopf's Umlaufsatz), in the direction that its area says."""
    track, _ = made
    s = np.linspace(0, track.centerline.length, 20_000, endpoint=False)
    turned = np.mean(track.centerline.curvature(s)) * track.centerline.length
    assert turned == pytest.approx(2 * math.pi * np.sign(signed_area(track)), rel=1e-3)


def test_band_never_overlaps(made):
    """The band around a curve has the area length × width only where it does not meet itself (Pappus)."""
    track, asked = made
    free = np.count_nonzero(~track.occupancy) * track.resolution**2
    assert free == pytest.approx(asked["length"] * asked["width"], rel=0.01)


def test_band_is_a_ring(made):
    track, _ = made
    _, bands = ndimage.label(~track.occupancy)  # pyright: ignore[reportGeneralTypeIssues]
    assert bands == 1
    walls, count = ndimage.label(track.occupancy, structure=np.ones((3, 3)))  # pyright: ignore[reportGeneralTypeIssues]
    assert count == 2  # inside and outside the lap
    edge = np.concatenate((walls[0], walls[-1], walls[:, 0], walls[:, -1]))
    assert len(np.unique(edge)) == 1


def test_a_wall_stands_between_neighbouring_stretches(made):
    track, asked = made
    spacing = 0.2
    points = track.centerline.position(np.arange(0, track.centerline.length, spacing))[:, None]
    distance = np.linalg.norm(points - points.swapaxes(0, 1), axis=-1)
    index = np.arange(len(points))
    apart = np.abs(index[:, None] - index)
    apart = np.minimum(apart, len(points) - apart) * spacing
    half_circle = math.pi / 2 * (asked["width"] + circuit.WALL)
    assert np.min(distance[apart > 1.1 * half_circle]) > asked["width"] + 0.9 * circuit.WALL


def test_starts_on_the_longest_straight_at_the_origin(made):
    track, _ = made
    np.testing.assert_allclose(track.centerline.position(0.0), 0.0, atol=1e-9)
    nearby = np.linspace(-1, 1, 21) * min(0.45 * max(measure_features(track.centerline).straights, default=0), 10)
    np.testing.assert_allclose(track.centerline.curvature(nearby), 0, atol=0.02)


def test_same_seed_same_track_bit_for_bit():
    first = generate_track(11, length=100.0)
    second = generate_track(11, length=100.0)
    assert np.array_equal(first.centerline.points, second.centerline.points)
    assert np.array_equal(first.occupancy, second.occupancy)
    assert first.origin == second.origin
    other = generate_track(12, length=100.0)
    assert not np.array_equal(first.centerline.points, other.centerline.points)


@pytest.mark.parametrize("clockwise", [True, False])
def test_direction_is_as_asked(clockwise):
    for seed in range(4):
        assert (signed_area(generate_track(seed, length=80.0, clockwise=clockwise)) < 0) == clockwise


def test_direction_is_drawn_where_not_asked():
    areas = [polygon_area(circuit.circuit_points(seed, 80.0, 2.2, 1.5)) for seed in range(20)]
    assert 4 <= np.count_nonzero(np.array(areas) > 0) <= 16


def test_generated_circuits_have_what_circuits_have():
    """Of seeds that nobody chose, all have a long straight and most have hairpins and chicanes."""
    features = [
        measure_features(Centerline.from_points(circuit.circuit_points(seed, 300.0, 2.2, 1.5), 1.1, 1.1))
        for seed in range(24)
    ]
    assert all(feature.straights[0] >= 29 for feature in features)
    assert 12 <= sum(feature.hairpins > 0 for feature in features) < 24
    assert sum(feature.chicanes > 0 for feature in features) >= 12
    assert np.std([feature.turning for feature in features]) > 0.5 * math.pi


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": -1}, "seed is -1; must be a whole number"),
        ({"seed": 1.5}, "seed is 1.5; must be a whole number"),
        ({"length": math.nan}, "length is nan; must be a positive"),
        ({"length": 1e9}, "length is 1000000000.0; must be at most"),
        ({"length": 5.0}, "length is 5.0; must be at least 18.0 m"),
        ({"width": 0.0}, "width is 0.0; must be a positive"),
        ({"width": "wide"}, "width is 'wide'; must be a positive"),
        ({"min_radius": -2.0}, "min_radius is -2.0; must be a positive"),
        ({"min_radius": 1.0}, "min_radius is 1.0; must be at least half the width, 1.1 m"),
        ({"min_radius": 50.0}, "length is 300.0; must be at least 600.0 m for min_radius 50.0"),
        ({"resolution": 0.5}, "resolution is 0.5; must be at most a tenth of the width, 0.22 m"),
        ({"resolution": 2e-3}, "resolution is 0.002"),
        ({"resolution": math.inf}, "resolution is inf; must be a positive"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(OutlapError, match=message) as error:
        generate_track(**{"seed": 0, **arguments})
    assert "\n" not in str(error.value)


def test_gives_up_after_a_bounded_number_of_attempts(monkeypatch):
    monkeypatch.setattr(circuit, "_keeps_clear", lambda *_: False)
    with pytest.raises(OutlapError, match=r"none of 300 circuits fits: give a greater length"):
        generate_track(0, length=60.0)


@pytest.mark.parametrize("turn", np.radians([10, 60, 90, 165]))
def test_corner_touches_both_edges(turn):
    """Integrated step by step, clothoid, arc, clothoid leave the corner where its tangent length says."""
    ramp, arc = 0.5 * turn, 0.5 * turn  # lengths for radius 1: the clothoids together turn by half
    steps = 200_000
    s = (np.arange(steps) + 0.5) * (2 * ramp + arc) / steps
    curvature = np.minimum(1, np.minimum(s, 2 * ramp + arc - s) / ramp)
    heading = np.cumsum(curvature) * (s[1] - s[0])
    end = np.sum(np.exp(1j * heading)) * (s[1] - s[0])
    tangent = float(circuit._tangent(turn))
    assert heading[-1] == pytest.approx(turn, rel=1e-4)
    assert end == pytest.approx(tangent + tangent * np.exp(1j * turn), rel=1e-3)


@pytest.mark.parametrize(("gap", "clear"), [(2.5, False), (2.9, True)])
def test_stretches_too_close_are_noticed(gap, clear):
    """A lap of two parallel straights, `gap` apart, with 2.7 m needed."""
    points, _ = circuit._trace(np.array([0, 40, 40 + 1j * gap, 1j * gap]), np.full(4, 0.3), 0.05)
    assert circuit._keeps_clear(points, 80 + 2 * gap, 2.7) == clear


def test_features_of_a_stadium():
    """Two straights of 40 m and two half circles of 2 m radius."""
    along, around = np.arange(0, 40, 0.05), np.arange(0, math.pi, 0.025)
    half = np.concatenate((along - 2j, 40 + 2 * np.exp(1j * (around - math.pi / 2))))
    lap = np.concatenate((half, 40 - half))
    features = measure_features(Centerline.from_points(np.column_stack((lap.real, lap.imag)), 1.0, 1.0))
    assert features.length == pytest.approx(80 + 4 * math.pi, rel=1e-3)
    assert features.turning == pytest.approx(2 * math.pi, rel=1e-2)
    assert features.tightest_radius == pytest.approx(2, rel=0.1)
    np.testing.assert_allclose(features.straights, 40, atol=0.6)
    assert (features.hairpins, features.chicanes) == (2, 0)


def test_features_of_a_rectangle_with_a_bypass():
    """A square lap, one side of which steps aside and back by 45°: two chicanes, 15 m apart."""
    vertices = np.array([0, 20, 23 - 3j, 38 - 3j, 41, 60, 60 + 40j, 40j])
    points, straight = circuit._trace(vertices, np.full(8, 1.5), 0.1)
    lap = Centerline.from_points(np.column_stack((np.real(points), np.imag(points))), 1.0, 1.0)
    features = measure_features(lap)
    assert (features.hairpins, features.chicanes) == (0, 2)
    assert features.straights[0] == pytest.approx(straight, abs=0.5)
    assert features.turning == pytest.approx(math.pi * (2 + 1), rel=5e-3)


def test_builtin_set_is_large_and_split():
    assert len(BUILTIN_TRAIN) >= 10
    assert len(BUILTIN_HELD_OUT) >= 3
    assert len({*BUILTIN_TRAIN, *BUILTIN_HELD_OUT}) == len(BUILTIN_TRAIN) + len(BUILTIN_HELD_OUT)
    seeds = [(c.seed, c.length) for c in (generate.TRAINING_CIRCUITS | generate.HELD_OUT_CIRCUITS).values()]
    assert len(set(seeds)) == len(seeds)


@pytest.mark.parametrize("name", BUILTIN_TRAIN + BUILTIN_HELD_OUT)
def test_builtin_track_is_what_its_data_say(name):
    track = builtin_track(name)
    data = (generate.TRAINING_CIRCUITS | generate.HELD_OUT_CIRCUITS)[name]
    assert builtin_track(name) is track
    assert track.name == name
    assert 150 <= track.centerline.length <= 450
    assert track.centerline.length == pytest.approx(data.length, rel=0.01)
    assert (signed_area(track) < 0) == data.clockwise
    assert measure_features(track.centerline).tightest_radius >= data.min_radius / 1.02
    free = np.count_nonzero(~track.occupancy) * track.resolution**2
    assert free == pytest.approx(data.length * data.width, rel=0.01)


@pytest.mark.parametrize("names", [BUILTIN_TRAIN, BUILTIN_HELD_OUT], ids=["train", "held_out"])
def test_builtin_set_is_varied(names):
    tracks = [builtin_track(name) for name in names]
    features = [measure_features(track.centerline) for track in tracks]
    assert {signed_area(track) > 0 for track in tracks} == {True, False}
    assert sum(feature.straights[0] >= 30 for feature in features) >= 0.8 * len(names)
    assert sum(feature.hairpins > 0 for feature in features) >= 0.6 * len(names)
    assert sum(feature.chicanes > 0 for feature in features) >= 0.6 * len(names)
    lengths = [feature.length for feature in features]
    assert max(lengths) / min(lengths) > 1.5
    turning = [feature.turning for feature in features]
    assert max(turning) / min(turning) > 1.3


def test_unknown_builtin_name_lists_the_known_ones():
    with pytest.raises(OutlapError, match=f"name is 'Monaco'; must be one of {BUILTIN_TRAIN[0]}, "):
        builtin_track("Monaco")


def polygon_area(points: np.ndarray) -> float:
    x, y = points.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)


def signed_area(track) -> float:
    return polygon_area(track.centerline.points)
