"""Videos have the pictures that they should, and show what was raced."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from imageio_ffmpeg import read_frames
from PIL import Image

from outlap.errors import OutlapError
from outlap.figure_style import BLUE, COLOURS, VERMILION
from outlap.viewer.scene import bytes_of
from outlap.viewer.video import count_pictures, write_video
from recordings import circling
from synthetic_tracks import ring

TRACK = ring()
SMALL = (320, 240)


def near(picture: np.ndarray, colour: str) -> int:
    """How many pixels have about this colour: compression changes it a little."""
    return int((np.abs(picture.astype(int) - bytes_of(colour)).max(axis=2) < 60).sum())


def test_an_mp4_has_every_picture(tmp_path: Path):
    races = [circling(TRACK, seconds=1.0), circling(TRACK, seconds=2.0, speed=2.0)]
    done: list[int] = []
    path = write_video(
        races, TRACK, tmp_path / "race.mp4", size=SMALL, frames_per_second=20, view="track", on_progress=done.append
    )
    reader = read_frames(str(path))
    meta = next(reader)
    assert (meta["size"], meta["fps"], meta["codec"]) == (SMALL, 20.0, "h264")
    pictures = [np.frombuffer(frame, np.uint8).reshape(240, 320, 3) for frame in reader]
    assert len(pictures) == count_pictures(races, 20) == 60  # two seconds, and one at the end
    assert done == list(range(1, 61))
    assert near(pictures[20], BLUE) > 20
    assert near(pictures[20], VERMILION) > 20
    assert np.abs(pictures[0].astype(int) - pictures[30]).max() > 100


def test_speed_is_in_times_of_real_time():
    race = [circling(TRACK, seconds=4.0)]
    assert count_pictures(race, 10) == 50
    assert count_pictures(race, 10, speed=4.0) == 20


def test_a_gif_moves_for_ever_and_keeps_time(tmp_path: Path):
    race = circling(TRACK, seconds=1.0)
    path = write_video([race], TRACK, tmp_path / "race.gif", size=SMALL, frames_per_second=30)
    with Image.open(path) as image:
        assert image.info["loop"] == 0
        assert image.size == SMALL
        milliseconds, shown = 0, 0
        for number in range(image.n_frames):  # type: ignore[attr-defined]
            image.seek(number)
            milliseconds += image.info["duration"]
            shown += near(np.asarray(image.convert("RGB")), BLUE) > 20
    assert milliseconds == pytest.approx(2000, abs=10)  # a second of the race, and one at the end
    assert shown > 20
    with pytest.raises(OutlapError, match=r"60 pictures a second; browsers show at most 50 of a \.gif"):
        write_video([race], TRACK, tmp_path / "fast.gif", size=SMALL, frames_per_second=60)


def test_what_cannot_be_written_is_said_before_the_work(tmp_path: Path):
    race = circling(TRACK)
    for path, size, races, said in (
        ("race.avi", SMALL, [race], r"ending is '\.avi'; must be \.mp4 or \.gif"),
        ("race.mp4", (321, 240), [race], "size is 321 × 240; must be even numbers"),
        ("race.mp4", SMALL, [], "0 recordings; 1 to 8"),
        ("race.mp4", SMALL, [circling(ring(radius=5.0), radius=5.0)], "was raced on ring5"),
        ("race.mp4", SMALL, [race] * (len(COLOURS) + 1), "9 recordings; 1 to 8"),
    ):
        with pytest.raises(OutlapError, match=said):
            write_video(races, TRACK, tmp_path / path, size=size)
    assert not list(tmp_path.iterdir())
