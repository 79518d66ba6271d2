"""The Frenet kernels against the centreline's own projection."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numba import njit

from outlap.simulator.frenet import frenet_point, frenet_project
from outlap.track import load_track
from outlap.track.centerline import TABLE, Centerline
from synthetic_tracks import circular, wavy


@njit
def project_all(table, row0, rows, h, x, y, guess):
    out = np.empty((len(x), 3))
    for i in range(len(x)):
        out[i] = frenet_project(table, row0, rows, h, x[i], y[i], guess[i])
    return out


@njit
def point_all(table, row0, rows, h, s, d):
    out = np.empty((len(s), 3))
    for i in range(len(s)):
        out[i] = frenet_point(table, row0, rows, h, s[i], d[i])
    return out


def check_kernels(line: Centerline, before: int, widest: float) -> None:
    """Project from guesses 0.5 m off either way, start line included; and back."""
    own = line.table()
    rows, h = len(own), line.length / len(own)
    table = np.full(before + rows + 3, 1e6, TABLE)  # others' rows: never to be read
    table[before : before + rows] = own
    rng = np.random.default_rng(6)
    near_start = np.linspace(-0.6, 0.6, 500) % line.length
    s = np.concatenate([rng.uniform(0.0, line.length, 5000), near_start])
    right, left = line.widths(s)
    d = rng.uniform(-np.minimum(right, widest), np.minimum(left, widest))
    # inside the tightest bend around, so that no other point near the guess is nearest too
    around = np.abs(line.curvature(s[:, None] + np.linspace(-1.0, 1.0, 41))).max(axis=1)
    d = np.where(np.abs(d) * around < 0.6, d, 0.0)
    x, y = line.to_cartesian(s, d).T
    for off in (-0.5, 0.0, 0.5):
        found = project_all(table, before, rows, h, x, y, s + off)
        assert np.all((found[:, 0] >= 0.0) & (found[:, 0] < line.length))
        np.testing.assert_allclose(circular(found[:, 0] - s, line.length), 0.0, atol=5e-4)
        np.testing.assert_allclose(found[:, 1], d, atol=2e-4)
        np.testing.assert_allclose(np.exp(1j * (found[:, 2] - line.heading(s))), 1.0, atol=2e-3)
        back = point_all(table, before, rows, h, found[:, 0], found[:, 1])
        np.testing.assert_allclose(back[:, :2], np.column_stack([x, y]), atol=1e-4)
        np.testing.assert_allclose(np.exp(1j * (back[:, 2] - found[:, 2])), 1.0, atol=1e-4)


def test_kernels_match_the_class_and_each_other() -> None:
    check_kernels(wavy(), before=17, widest=1.2)


def test_kernels_match_the_class_on_real_circuits(real_tracks: Path) -> None:
    for folder in sorted(path for path in real_tracks.iterdir() if path.is_dir())[:10]:
        check_kernels(load_track(folder).centerline, before=5, widest=0.8)


def test_frenet_project_walks_from_a_far_guess() -> None:
    line = wavy()
    table = line.table()
    h = line.length / len(table)
    s = np.linspace(0.0, line.length, 50, endpoint=False)
    x, y = line.position(s).T
    found = project_all(table, 0, len(table), h, x, y, s + 1.5)
    np.testing.assert_allclose(circular(found[:, 0] - s, line.length), 0.0, atol=1e-3)


def test_frenet_project_stays_inside_the_table_whatever_it_is_given() -> None:
    line = wavy()
    table = line.table()
    rows, h = len(table), line.length / len(table)
    awkward = [0.0, -1e-12, line.length, np.nextafter(line.length, 0.0), -1e9, 1e30, np.nan, np.inf]
    for x in (0.0, 1e12, np.nan, -np.inf):
        for guess in awkward:
            s, d, heading = frenet_project(table, 0, rows, h, x, 3.0, guess)
            assert 0.0 <= s < line.length
            assert not math.isfinite(x) or (math.isfinite(d) and math.isfinite(heading))
    for s in awkward:
        assert np.all(np.isfinite(frenet_point(table, 0, rows, h, s, 0.5)))
