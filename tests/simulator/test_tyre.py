"""The Magic Formula's defining properties."""

from __future__ import annotations

import numpy as np
import pytest

from cars import small_row
from outlap.simulator.tyre import tyre_forces

LOAD = 18.0  # [N] an axle of the small car


def symmetric_row():
    row = small_row()
    row["p_hx1"] = row["p_vx1"] = row["r_hx1"] = row["r_by3"] = row["r_hy1"] = row["r_vy1"] = 0.0
    return row


@pytest.mark.parametrize("mu", [0.4, 0.8, 1.0489])
def test_the_lateral_peak_is_mu_times_load(mu):
    row = symmetric_row()
    row["mu"] = mu
    forces = [tyre_forces(0.0, angle, LOAD, row)[1] for angle in np.linspace(-1.2, 1.2, 4801)]
    assert max(forces) == pytest.approx(mu * LOAD, rel=1e-5)
    assert min(forces) == pytest.approx(-mu * LOAD, rel=1e-5)


@pytest.mark.parametrize("mu", [0.4, 1.0489])
def test_friction_scales_peaks_and_leaves_slopes(mu):
    row = symmetric_row()
    row["mu"] = mu
    forces = [tyre_forces(slip, 0.0, LOAD, row)[0] for slip in np.linspace(-1, 1, 4001)]
    assert max(forces) == pytest.approx(row["p_dx1"] * mu / row["p_dy1"] * LOAD, rel=1e-4)
    e = 1e-6
    assert tyre_forces(-e, 0.0, LOAD, row)[0] == pytest.approx(row["p_kx1"] * LOAD * e, rel=1e-4)
    assert tyre_forces(0.0, e, LOAD, row)[1] == pytest.approx(row["p_ky1"] * LOAD * e, rel=1e-4)


def test_forces_oppose_slip_and_mirror():
    row = symmetric_row()
    for slip, angle in [(0.05, 0.03), (0.3, 0.1), (-0.1, 0.2)]:
        push, side = tyre_forces(slip, angle, LOAD, row)
        assert push * slip < 0
        assert side * angle < 0
        assert tyre_forces(-slip, -angle, LOAD, row) == pytest.approx((-push, -side), rel=1e-12)


def test_combined_slip_takes_from_both_forces():
    row = symmetric_row()
    push, side = tyre_forces(0.1, 0.1, LOAD, row)
    assert abs(push) < abs(tyre_forces(0.1, 0.0, LOAD, row)[0])
    assert abs(side) < abs(tyre_forces(0.0, 0.1, LOAD, row)[1])


def test_no_load_no_force():
    assert tyre_forces(0.3, 0.2, 0.0, small_row()) == (0.0, 0.0)
