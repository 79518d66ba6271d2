"""Planned lines: closed forms, the map, the limits, each other, real circuits, and the simulator."""

from __future__ import annotations

import math
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path as FilePath

import numpy as np
import pytest

from outlap.drivers.classical import PurePursuit
from outlap.envs.race_config import RaceConfig
from outlap.errors import OutlapError
from outlap.evaluation.protocol import standing_starts
from outlap.evaluation.rollout import evaluate
from outlap.planning import min_time
from outlap.planning.friction import FrictionMap
from outlap.planning.limits import CarLimits
from outlap.planning.line_cache import cached_line
from outlap.planning.min_laps import min_laps
from outlap.planning.plan import DEFAULT_MARGIN, METHODS, PlannedLine, plan_line
from outlap.simulator.vehicle import AxleTyres, VehicleParams, parameter_bounds, to_records
from outlap.track import Track, load_track
from outlap.track.centerline import Centerline
from outlap.track.generate import generate_track
from outlap.track.map_io import read_raceline_csv, write_raceline_csv
from outlap.track.walls import draw_walls
from synthetic_tracks import ring

CAR = CarLimits.of(VehicleParams(v_max=8.0))


def drawn(name: str, points: np.ndarray, half_width: float) -> Track:
    """A track with walls at this distance from a line."""
    line = Centerline.from_points(points, half_width, half_width)
    walls, origin = draw_walls(line, 0.02, margin=0.5)
    return Track(name, walls, 0.02, origin, line)


def stadium(straight: float, radius: float, half_width: float) -> Track:
    along = np.arange(-0.5 * straight, 0.5 * straight, 0.1)
    angle = np.linspace(-0.5 * math.pi, 0.5 * math.pi, round(math.pi * radius / 0.1), endpoint=False)
    half = np.concatenate([
        np.stack([along, np.full_like(along, -radius)], 1),
        np.stack([0.5 * straight + radius * np.cos(angle), radius * np.sin(angle)], 1),
    ])  # fmt: skip
    return drawn("stadium", np.concatenate([half, -half]), half_width)


@pytest.fixture(scope="module")
def circuit() -> Track:
    return generate_track(11, length=90.0, min_radius=1.2)


@pytest.fixture(scope="module")
def lines(circuit) -> dict[str, PlannedLine]:
    return {method: plan_line(circuit, CAR, method) for method in METHODS}


@pytest.mark.parametrize("method", ["min-curvature", "min-time"])
@pytest.mark.parametrize("mu", [1.0489, 0.4])
def test_a_circle_takes_what_the_closed_form_says(method, mu):
    """Least time is on the inside, radius r: 2 pi sqrt(r / (mu g)); least curvature as far out as corners allow."""
    track, car, margin = ring(5.0, half_width=1.0, resolution=0.02), replace(CAR, mu=mu), 0.1
    line = plan_line(track, car, method, margin)
    inside, outside = 5.0 - 1.0 + 0.155 + margin, 5.0 + 1.0 - 0.155 - margin - 0.58**2 / 8.0 / 5.0
    radius = inside if method == "min-time" else outside
    assert line.lap_time == pytest.approx(2.0 * math.pi * math.sqrt(radius / (mu * 9.81)), rel=0.01)


def test_a_stadium_that_the_car_drives_flat_out_takes_the_shortest_way_around():
    """Two straights and two half circles of the inner radius, at v_max."""
    straight, radius, margin = 20.0, 5.0, 0.1
    line = plan_line(stadium(straight, radius, 1.0), replace(CAR, v_max=6.0), "min-time", margin)
    inside = radius - 1.0 + 0.155 + margin
    assert line.speed.min() > 5.9, "grip is no limit here"
    assert line.lap_time == pytest.approx((2.0 * straight + 2.0 * math.pi * inside) / 6.0, rel=0.01)


def test_a_track_hardly_wider_than_the_car_is_driven_along_its_middle():
    track = stadium(20.0, 8.0, 0.155 + 0.05)
    for method in ("min-curvature", "min-time"):
        line = plan_line(track, CAR, method, margin=0.02)
        assert np.abs(track.centerline.to_frenet(*line.path.points.T)[1]).max() < 0.05
        assert line.min_margin > 0.0


def test_least_time_is_no_slower_than_least_curvature_and_that_than_the_centreline(lines):
    assert lines["min-time"].lap_time <= lines["min-curvature"].lap_time < lines["centerline"].lap_time
    assert lines["min-time"].lap_time < 0.995 * lines["min-curvature"].lap_time, "the track has corners to cut"


def test_no_method_leaves_the_track_or_breaks_a_limit(circuit, lines):
    for method, line in lines.items():
        speed, curvature = line.speed, line.path.curvature
        raceline = line.raceline
        assert line.min_margin >= (0.0 if method == "centerline" else DEFAULT_MARGIN - 0.01)
        across = speed**2 * np.abs(curvature) / CAR.grip
        along = raceline.acceleration / min(CAR.a_max, CAR.grip)
        # An acceleration holds up to the next point: braking is what the corner there leaves of it.
        assert np.hypot(along, np.where(along < 0.0, np.roll(across, -1), across)).max() < 1.0 + 1e-6
        assert speed.max() <= CAR.v_max + 1e-9
        assert method == "centerline" or np.abs(curvature).max() <= 1.02 * CAR.max_curvature


def test_curvature_and_heading_are_those_of_the_points(lines):
    for line in lines.values():
        x, y = line.path.points.T
        dx, dy = np.roll(x, -1) - np.roll(x, 1), np.roll(y, -1) - np.roll(y, 1)
        turn = np.angle(np.exp(1j * (np.arctan2(dy, dx) - line.path.heading)))
        assert np.abs(turn).max() < 0.02
        np.testing.assert_allclose(np.hypot(dx, dy), 2.0 * line.path.spacing, rtol=0.02)
        turned = np.sum(line.path.curvature) * line.path.spacing
        assert abs(turned) == pytest.approx(2.0 * math.pi, rel=0.01)


def test_the_file_is_read_back_with_the_same_lap(lines, tmp_path):
    line = lines["min-time"]
    back = read_raceline_csv(write_raceline_csv(line.raceline, tmp_path / "a_raceline.csv"))
    assert back.lap_time == pytest.approx(line.lap_time, rel=1e-3)


def test_a_slippery_side_is_driven_around(circuit):
    """Ice on the right half of the whole lap: the line keeps to the left where it corners, and the lap takes longer."""
    d = np.linspace(-1.1, 1.1, 12)
    mu = np.where(d < 0.0, 0.3, CAR.mu)
    ice = FrictionMap(np.array([0.0]), d, mu[None], circuit.centerline.length)
    plain, iced = plan_line(circuit, CAR), plan_line(circuit, CAR, friction=ice)
    assert iced.lap_time > 1.02 * plain.lap_time
    across = [circuit.centerline.to_frenet(*line.path.points.T)[1] for line in (plain, iced)]
    bent = [np.abs(line.path.curvature) > 0.2 for line in (plain, iced)]
    share_on_ice = [np.mean(d[b] < 0.0) for d, b in zip(across, bent, strict=True)]
    assert share_on_ice[1] < 0.6 * share_on_ice[0]
    everywhere = plan_line(circuit, replace(CAR, mu=0.3))
    assert iced.lap_time < everywhere.lap_time


def test_one_point_of_friction_is_the_same_everywhere(tmp_path):
    (tmp_path / "wet.csv").write_text("s_m, d_m, mu\n0, 0, 0.6\n")
    wet = FrictionMap.read(tmp_path / "wet.csv", length=30.0)
    np.testing.assert_allclose(wet.at([0.0, 12.0, 29.0], [-1.0, 0.0, 2.0]), 0.6)


def test_a_friction_map_is_linear_between_its_points_and_goes_around(tmp_path):
    file = tmp_path / "friction.csv"
    rows = [(s, d, 0.5 + 0.1 * s / 10.0 + 0.2 * d) for s in (0.0, 10.0, 20.0) for d in (-1.0, 1.0)]
    file.write_text("# s_m, d_m, mu\n" + "\n".join(f"{s}, {d}, {mu}" for s, d, mu in rows))
    friction = FrictionMap.read(file, length=30.0)
    assert friction.at(5.0, 0.0) == pytest.approx(0.55)
    assert friction.at(25.0, 0.5) == pytest.approx(0.5 * (0.7 + 0.5) + 0.1)  # between the last and the first
    assert friction.at(35.0, 3.0) == pytest.approx(0.55 + 0.2)  # once around; beyond the last offset


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("0, -1, 0.5\n0, 1, 0.5\n5, -1, 0.5\n6, 1, 0.5", "has 4 rows for 3 values of s_m and 2 of d_m"),
        ("0, -1, 0.5\n0, 1, -0.5\n5, -1, 0.5\n5, 1, 0.5", "mu is -0.5 at s_m = 0, d_m = 1"),
        ("0, -1, 0.5\n0, 1, 0.5\n50, -1, 0.5\n50, 1, 0.5", "must lie on the lap, from 0 to 30 m"),
    ],
)
def test_a_friction_file_that_is_wrong_is_named(tmp_path, text, complaint):
    file = tmp_path / "friction.csv"
    file.write_text(text)
    with pytest.raises(OutlapError, match=complaint) as error:
        FrictionMap.read(file, length=30.0)
    assert "friction.csv" in str(error.value)


def test_a_hairpin_tighter_than_the_steering_names_the_place_and_the_constraint():
    track = stadium(10.0, 1.0, 0.3)
    cannot = replace(CAR, max_curvature=0.5)
    with pytest.raises(OutlapError, match=r"at s = (\d+\.\d) m, where the steering is at its lock, .* broken") as error:
        plan_line(track, cannot, "min-time", margin=0.0)
    x, _ = track.centerline.position(float(re.findall(r"s = (\d+\.\d) m", str(error.value))[0]))
    assert abs(x) > 4.0, "in a half circle, not on a straight"
    with pytest.raises(OutlapError, match=r"at s = \d+\.\d m the min-curvature line has a curvature of 1\.\d+ 1/m"):
        plan_line(track, cannot, "min-curvature", margin=0.0)


def test_a_solver_that_stops_early_says_so(monkeypatch):
    monkeypatch.setattr(min_time, "ITERATIONS", 2)
    with pytest.raises(OutlapError, match=r"track ring5: .*Maximum_Iterations_Exceeded.* at s = \d+\.\d m"):
        plan_line(ring(5.0), CAR)


def test_ctrl_c_stops_the_solver_and_is_no_planning_error(circuit):
    """IPOPT would take it for an error of its own, and the rounds for one that there is no room."""
    code = (
        "import signal, threading, sys, os\n"
        "from outlap.planning import plan\nfrom outlap.planning.limits import CarLimits\n"
        "from outlap.simulator.vehicle import VehicleParams\nfrom outlap.track.generate import generate_track\n"
        "track = generate_track(11, length=300.0)\n"
        "plan.log.info = lambda *words: words[-1] == 1 and threading.Timer(1.0, os.kill, (os.getpid(), 2)).start()\n"
        "try:\n    plan.plan_line(track, CarLimits.of(VehicleParams()))\n"
        "except KeyboardInterrupt:\n    sys.exit(7)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        check=False,
        timeout=120,
        # A test run in the background hands down an ignored SIGINT.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert done.returncode == 7


def test_limits_that_make_no_sense_are_refused():
    with pytest.raises(OutlapError, match="mu is 0"):
        replace(CAR, mu=0.0)
    with pytest.raises(OutlapError, match="margin is -1"):
        plan_line(ring(5.0), CAR, margin=-1.0)
    with pytest.raises(OutlapError, match="method is 'fastest'"):
        plan_line(ring(5.0), CAR, "fastest")  # type: ignore[arg-type]


def test_a_kept_line_is_the_same_and_a_broken_file_is_planned_anew(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("OUTLAP_CACHE", str(tmp_path))
    track = ring(4.0)
    first, second = cached_line(track, CAR), cached_line(track, CAR)
    np.testing.assert_array_equal(first.path.points, second.path.points)
    assert (first.lap_time, first.solve_time) == (second.lap_time, second.solve_time), "planned once"
    (file,) = tmp_path.rglob("*.npz")
    assert not caplog.records
    whole = file.read_bytes()
    needed = whole.index(b"PK\x01\x02") + 6  # version of ZIP, of the first member in the archive's directory
    for broken in (whole[:100], whole[:needed] + b"\x5d" + whole[needed + 1 :]):
        file.write_bytes(broken)
        assert cached_line(track, CAR).solve_time != first.solve_time
        assert "is made anew" in caplog.records.pop().message
    assert cached_line(track, replace(CAR, mu=0.5)).lap_time > first.lap_time
    assert len(list(tmp_path.rglob("*.npz"))) == 2


def test_the_yardstick_of_one_car_is_its_planned_lap(circuit):
    table = min_laps(circuit, parameter_bounds(VehicleParams(v_max=8.0)), "single_track")
    assert table.error == 0.0
    assert table.of([CAR])[0] == pytest.approx(cached_line(circuit, CAR).lap_time, rel=1e-9)


def test_the_yardstick_of_a_car_that_is_drawn_is_the_lap_planned_for_it(circuit):
    table = min_laps(
        circuit, parameter_bounds(VehicleParams(mu=(0.5, 1.1), a_max=(6.0, 12.0), v_max=8.0)), "single_track"
    )
    low, car, high = (replace(CAR, mu=mu, a_max=a, a_brake=a) for mu, a in ((0.5, 6.0), (0.62, 10.5), (1.1, 12.0)))
    own = plan_line(circuit, car).lap_time
    assert 0.0 <= table.error < 0.01
    assert len(table.lines) == 5
    assert table.of([car])[0] == pytest.approx(own, rel=0.01)
    assert table.of([low])[0] > table.of([car])[0] > table.of([high])[0]


def test_limits_follow_from_forces_and_mass_under_the_nonlinear_model():
    """a = F / m, v_switch = P / F, and the axle with less friction limits the grip; other models go by a_max."""
    vehicle = VehicleParams(
        mu=0.9, m=3.0, motor_force=24.0, brake_force=36.0, motor_power=120.0, a_max=9.0, v_switch=7.0,
        axles=AxleTyres(front_peak=1.1, rear_peak=0.8),
    )  # fmt: skip
    record = to_records(parameter_bounds(vehicle)[0])
    ours, theirs = (CarLimits.of_record(record, model) for model in ("nonlinear_single_track", "single_track"))
    assert (ours.mu, ours.a_max, ours.a_brake, ours.v_switch) == pytest.approx((0.72, 8.0, 12.0, 5.0), rel=1e-5)
    assert (theirs.mu, theirs.a_max, theirs.a_brake, theirs.v_switch) == pytest.approx((0.9, 9.0, 9.0, 7.0), rel=1e-5)
    assert CarLimits.of(vehicle, "nonlinear_single_track") == ours
    assert replace(ours, **{name: getattr(theirs, name) for name in ("mu", "a_max", "a_brake", "v_switch")}) == theirs


def test_the_yardstick_of_cars_that_differ_in_mass_and_forces(circuit):
    """Each of two cars at opposite ends laps as planned for it alone, within the table's own error and 1 %."""
    low, high = parameter_bounds(
        VehicleParams(mu=(0.5, 1.0), m=(3.0, 4.5), motor_force=(25.0, 40.0), brake_force=(25.0, 45.0), v_max=8.0)
    )
    table = min_laps(circuit, (low, high), "nonlinear_single_track")
    assert 0.0 <= table.error < 0.02
    weak, strong = to_records(low.copy()), to_records(high.copy())
    weak["m"], strong["m"] = 4.5, 3.0
    times = table.of([CarLimits.of_record(car, "nonlinear_single_track") for car in (weak, strong)])
    for car, time in zip((weak, strong), times, strict=True):
        own = plan_line(circuit, CarLimits.of_record(car, "nonlinear_single_track")).lap_time
        assert time == pytest.approx(own, rel=max(0.01, table.error))
    assert times[0] > 1.1 * times[1]


def test_pure_pursuit_drives_the_planned_lap(circuit):
    task = RaceConfig(vehicle=VehicleParams(v_max=8.0), racing_line="min-time", beams=0)
    rows = evaluate(PurePursuit(), standing_starts(task, [circuit], laps=2), [circuit], episodes=12, seed=0)
    under_way = rows[rows["duration_s"].to_numpy() > 3.0]  # some starts, far beside the line in a bend, end at once
    assert len(under_way) >= 8
    assert set(under_way["outcome"]) == {"finished"}
    ratios = np.asarray(under_way["lap_time_ratio"])
    assert 0.98 < ratios.min() <= ratios.max() < 1.05


@pytest.mark.parametrize("name", ["levine", "IMS"])
def test_real_circuits_are_lapped_no_slower_than_their_own_racelines(real_tracks: FilePath, name):
    track = load_track(real_tracks / name)
    theirs = track.raceline
    assert theirs is not None
    line = plan_line(track, CAR.implied_by(theirs), margin=0.05)
    assert line.lap_time <= 1.01 * theirs.lap_time
    assert line.min_margin > 0.0


def test_pure_pursuit_drives_the_planned_lap_of_a_real_circuit(real_tracks: FilePath):
    track = load_track(real_tracks / "IMS")
    task = RaceConfig(vehicle=VehicleParams(v_max=8.0), racing_line="min-time", beams=0)
    rows = evaluate(PurePursuit(), standing_starts(task, [track], laps=1), [track], episodes=4, seed=0)
    assert rows["outcome"].tolist() == ["finished"] * 4
    ratios = rows["lap_time_ratio"].to_numpy()
    assert 0.99 < ratios.min() <= ratios.max() < 1.05
