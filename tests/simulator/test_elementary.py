"""The polynomials against the standard library over their domains."""

from __future__ import annotations

import math

import numpy as np
import pytest

from outlap.simulator.elementary import arctangent, arctangent_of_ratio, cosine_wide, sine, sine_wide

ACCURACY = 1e-12


@pytest.mark.parametrize(
    ("ours", "exact", "largest"),
    [
        (sine, math.sin, math.pi / 2),
        (sine_wide, math.sin, math.pi),
        (cosine_wide, math.cos, math.pi),
    ],
)
def test_sine_and_cosine(ours, exact, largest):
    for x in np.linspace(-largest, largest, 20001):
        assert abs(ours(x) - exact(x)) <= ACCURACY, x


def test_arctangent():
    for x in (0.0, *np.geomspace(1e-12, 1e12, 20001)):
        assert abs(arctangent(x) - math.atan(x)) <= ACCURACY, x


def test_arctangent_of_ratio_over_the_whole_quadrant():
    for angle in np.linspace(0.0, math.pi / 2, 2001):
        for size in (1e-300, 1.0, 1e6):
            above, below = size * math.sin(angle), size * max(math.cos(angle), 0.0)
            assert abs(arctangent_of_ratio(above, below) - math.atan2(above, below)) <= ACCURACY, (angle, size)
    assert arctangent_of_ratio(0.0, 1.0) == 0.0
    assert arctangent_of_ratio(1.0, 0.0) == math.pi / 2
