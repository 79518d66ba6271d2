"""The map of crashes has a dot for each, and names the hot spots."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from outlap.errors import OutlapError
from outlap.viewer.crash_map import draw_crashes
from synthetic_tracks import ring

LARGE, SMALL = ring(radius=8.0), ring(radius=4.0)


def rows(*crashes: tuple[str, float, float]) -> pd.DataFrame:
    """Rows of one finished episode on each ring, and of crashes: track, arc length and offset [m]."""
    finished = [(name, "finished", np.nan, np.nan) for name in ("ring8", "ring4")]
    found = [*finished, *((track, "crash", s, d) for track, s, d in crashes)]
    return pd.DataFrame(found, columns=["track", "outcome", "crash_s_m", "crash_d_m"]).assign(driver="me")


def test_crashes_are_dots_where_they_happened(tmp_path: Path):
    quarter = 0.5 * np.pi
    episodes = rows(("ring4", 0.0, -1.0), ("ring8", 8.0 * quarter, 1.0), ("ring8", 0.0, 0.0))
    figure = draw_crashes([SMALL, LARGE], episodes, [], tmp_path / "crashes.png")
    assert (tmp_path / "crashes.png").stat().st_size > 5_000
    # The ring with most crashes comes first. To the left of an anticlockwise circle is its inside.
    expected = {"ring8: 2 of 3 crashed": [[0.0, 7.0], [8.0, 0.0]], "ring4: 1 of 2 crashed": [[5.0, 0.0]]}
    panels = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_title(loc="left") for axes in panels] == list(expected)
    for axes, places in zip(panels, expected.values(), strict=True):
        np.testing.assert_allclose(np.asarray(axes.collections[0].get_offsets()), places, atol=0.01)


def test_hot_spots_are_labelled_on_their_track():
    spots = [{"track": "ring8", "s_m": 12.4, "crashes": 3, "share": 0.75}]
    episodes = rows(*[("ring8", 12.4, 0.9)] * 3, ("ring8", 40.0, 0.9), ("ring4", 3.0, 0.0))
    large, small = draw_crashes([SMALL, LARGE], episodes, spots).axes[:2]
    assert [text.get_text() for text in large.texts] == ["12 m: 3 (75 %)"]
    assert not small.texts
    (ring_around,) = large.patches
    np.testing.assert_allclose(ring_around.center, LARGE.centerline.position(12.4))  # type: ignore[attr-defined]


def test_a_label_does_not_cover_the_track():
    spots = [{"track": "ring8", "s_m": 0.0, "crashes": 3, "share": 1.0}]
    axes = draw_crashes([LARGE], rows(*[("ring8", 0.0, 0.9)] * 3), spots).axes[0]
    x, y = axes.texts[0].xyann  # type: ignore[attr-defined]
    assert np.hypot(x, y) < 6.8  # inside of the ring: outside of it there is no room


def test_no_more_panels_than_fit_and_nothing_without_a_crash():
    tracks = [ring(radius=3.0 + 0.25 * number) for number in range(14)]
    names = [track.name for track in tracks]
    episodes = pd.DataFrame({"track": names, "outcome": "crash", "crash_s_m": 1.0, "crash_d_m": 0.0, "driver": "me"})
    figure = draw_crashes(tracks, episodes, [])
    assert [axes.get_title(loc="left") for axes in figure.axes] == [f"{name}: 1 of 1 crashed" for name in names[:12]]
    assert "2 more have crashes" in figure.get_suptitle().replace("\n", " ")
    with pytest.raises(OutlapError, match="no episode ended in a crash"):
        draw_crashes([LARGE], rows(), [])
