"""Figures of episodes say what the episodes say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from outlap.errors import OutlapError
from outlap.evaluation.frame import SPEED, X, Y
from outlap.viewer.episode_plots import (
    accelerations,
    confusion,
    draw_contexts,
    draw_friction_circles,
    draw_lap_time_ratios,
    draw_trajectories,
)
from recordings import circling
from synthetic_tracks import ring

TRACK = ring()


def test_accelerations_on_a_circle_are_speed_squared_over_radius():
    along, across = accelerations(circling(TRACK, radius=8.0, speed=4.0)).T
    np.testing.assert_allclose(across, 4.0**2 / 8.0, rtol=1e-3)
    np.testing.assert_allclose(along, 0.0, atol=1e-4)


def test_accelerations_on_a_straight_are_the_change_of_speed():
    race = circling(TRACK)
    race.motion[:, 0] = 0.0
    race.motion[:, 0, SPEED] = 3.0 * race.time
    along, across = accelerations(race).T
    np.testing.assert_allclose(along, 3.0, rtol=1e-3)
    np.testing.assert_allclose(across, 0.0, atol=1e-6)


def test_trajectories_lie_where_cars_drove_with_one_scale(tmp_path: Path):
    races = [circling(TRACK, speed=2.0, title="slow"), circling(TRACK, speed=6.0, title="fast")]
    figure = draw_trajectories(TRACK, races, tmp_path / "t.png")
    assert (tmp_path / "t.png").stat().st_size > 5_000
    lines = [axes.collections[0] for axes in figure.axes[:2]]
    for race, line in zip(races, lines, strict=True):
        np.testing.assert_allclose(line.get_segments()[3][0], race.motion[3, 0, [X, Y]], atol=1e-5)  # type: ignore[attr-defined]
        assert line.get_clim() == (0.0, 6.0)
    assert [axes.get_title(loc="left") for axes in figure.axes[:2]] == ["slow: timeout, 4.0 s", "fast: timeout, 4.0 s"]
    with pytest.raises(OutlapError, match="7 recordings"):
        draw_trajectories(TRACK, [circling(TRACK)] * 7)


def test_the_friction_circle_has_the_radius_of_the_grip():
    figure = draw_friction_circles([circling(TRACK, speed=8.0)])
    axes = figure.axes[0]
    (circle,) = axes.patches
    assert circle.get_radius() == pytest.approx(9.81)  # type: ignore[attr-defined]
    assert "mean 82% of μ g = 9.8 m/s², above 80% for 100%" in axes.get_title(loc="left")


def test_lap_time_ratios_are_means_of_episodes_by_track_and_driver():
    rows = pd.DataFrame(
        {
            "track": ["a", "a", "b", "a"],
            "driver": ["x", "x", "x", "y"],
            "lap_time_ratio": [1.1, 1.3, 1.5, np.nan],
        }
    )
    (axes,) = draw_lap_time_ratios(rows).axes
    points = [np.ravel(line.get_xdata()) for line in axes.lines if line.get_marker() == "o"]
    means = [float(x[0]) for x in points if len(x)]
    assert means == pytest.approx([1.2, 1.5])
    assert [label.get_text() for label in axes.get_yticklabels()] == ["a", "b"]
    assert axes.get_legend_handles_labels()[1] == ["x"]  # y has no lap
    with pytest.raises(OutlapError, match="no episode has a completed lap"):
        draw_lap_time_ratios(rows.assign(lap_time_ratio=np.nan))


def test_contexts_that_differ_are_told_apart_and_equal_ones_are_not():
    rng = np.random.default_rng(0)
    apart = [[rng.standard_normal((200, 6)) + 8.0 * shift] for shift in np.eye(6)[:3]]
    np.testing.assert_allclose(confusion(apart), np.eye(3), atol=0.02)
    same = [[rng.standard_normal((2000, 6))] for _ in range(3)]
    np.testing.assert_allclose(confusion(same), 1 / 3, atol=0.12)


def test_contexts_are_drawn_by_task_and_wrong_ones_refused():
    rng = np.random.default_rng(0)

    def race(title: str, frames: int = 101):
        return circling(TRACK, title=title, context=rng.standard_normal((frames, 4)))

    figure = draw_contexts([race("wet"), race("dry"), race("dry")])
    assert [line.get_label() for line in figure.axes[0].lines] == ["wet", "dry"]
    for races, said in (
        ([circling(TRACK, title="blind"), race("dry")], "blind: its recording has no context"),
        ([race("dry"), race("dry")], "recordings of 1 tasks"),
        ([race("dry"), race("wet", frames=9)], "wet: is over after a few actions"),
    ):
        with pytest.raises(OutlapError, match=said):
            draw_contexts(races)
