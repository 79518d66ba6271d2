"""The population that comes with outlap: whole, verified, small, and able to race."""

from __future__ import annotations

import numpy as np
import pytest

from outlap.drivers.population import SHIPPED, load_population, read_manifest
from outlap.envs.race_config import RaceConfig
from outlap.evaluation.protocol import standing_starts
from outlap.evaluation.rollout import evaluate
from outlap.simulator.vehicle import VehicleParams
from outlap.track import load_track
from outlap.training.opponents import opponent_defaults, verify


def test_its_members_are_the_papers_speeds_and_all_verified() -> None:
    members = read_manifest(SHIPPED)
    halves = {split: [m.max_speed_mps for m in members if m.split == split] for split in ("train", "held_out")}
    assert halves == {"train": [2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5, 6.0], "held_out": [6.5, 7.0]}
    assert all(member.verified_laps >= 5 and member.crash_rate == 0.0 for member in members)
    assert sum(path.stat().st_size for path in SHIPPED.iterdir()) < 4e6


@pytest.mark.parametrize("number", [0, 10])
def test_its_slowest_and_its_fastest_lap_their_circuit_as_the_manifest_says(number: int) -> None:
    member = read_manifest(SHIPPED)[number]
    (driver,) = load_population(SHIPPED, None, member.name)
    rows = verify(driver, opponent_defaults().env, load_track(member.track), laps=1, starts=3, seed=5)
    assert rows["outcome"].tolist() == ["finished"] * 3
    assert np.allclose(rows["lap_time_s"].to_numpy(), member.lap_time_s, rtol=0.03)


def test_a_field_of_them_can_be_raced_against() -> None:
    track = load_track(read_manifest(SHIPPED)[0].track)
    env = RaceConfig(
        beams=108, control_interval=4, num_cars=4, opponents=("population",), speed_range=(0.0, 8.0),
        vehicle=VehicleParams(v_max=8.0),
    )  # fmt: skip
    env = standing_starts(env, [track], laps=0, time_limit=4.0)
    (driver,) = load_population(SHIPPED, None, "Emberley-4.0")
    rows = evaluate(driver, env, [track], episodes=6, seed=0)
    assert {name for i in (1, 2, 3) for name in rows[f"opponent_{i}"]} <= {m.name for m in read_manifest(SHIPPED)}
    assert rows["mean_speed_mps"].to_numpy().max() > 1.0
