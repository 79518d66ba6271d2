"""Recordings as a video, an animated picture or a still one, drawn without a display."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

from outlap.errors import OutlapError
from outlap.evaluation.recording import Recording, check_together
from outlap.figure_style import COLOURS
from outlap.files import replacing
from outlap.track.track import Track
from outlap.viewer.scene import CRASH_RED, RACELINE, Entry, Scene, mixed_with_white

View = Literal["follow", "track"]
ENDINGS = (".mp4", ".gif")
LAST_PICTURE = 1.0  # [s] that the end is shown
FASTEST_GIF = 50  # pictures a second
LARGEST_GIF = 2**29  # pixels of all pictures together: half a gigabyte of memory
MIXES = (0.0, 0.25, 0.5, 0.75)
QUALITY = 6  # of imageio-ffmpeg's 0 to 10


def write_video(
    recordings: Sequence[Recording],
    track: Track,
    path: str | os.PathLike[str],
    *,
    size: tuple[int, int] = (1280, 720),
    frames_per_second: int = 30,
    view: View = "follow",
    speed: float = 1.0,
    on_progress: Callable[[int], None] | None = None,
) -> Path:
    """Write races on one track, over one another, to an MP4 (H.264) or an animated GIF.

    Args:
        recordings: to show; each in its own colour.
        track: that they were raced on.
        path: whose ending, .mp4 or .gif, says what it becomes.
        size: (width, height) in pixels, even numbers.
        frames_per_second: of the video; motion between the recorded frames is interpolated.
        view: follow the first recording's ego, or show the whole track.
        speed: times real time.
        on_progress: called with the number of pictures that are done, of `count_pictures`.

    Raises OutlapError for recordings that cannot be shown together, and for what the format does not have.
    """
    path = Path(path)
    check_video(path, size, frames_per_second)
    check_together(recordings, track, len(COLOURS))
    count = count_pictures(recordings, frames_per_second, speed)
    pictures = _pictures(recordings, Scene(track, size), count, speed / frames_per_second, view, on_progress)
    write = _write_mp4 if path.suffix.lower() == ".mp4" else _write_gif
    with replacing(path) as partial:
        write(pictures, partial, size, frames_per_second)
    return path


def write_picture(
    recordings: Sequence[Recording],
    track: Track,
    path: str | os.PathLike[str],
    *,
    at: float | None = None,
    size: tuple[int, int] = (1280, 720),
    view: View = "follow",
) -> Path:
    """Write races on one track at a moment to a PNG.

    Args:
        recordings, track, size, view: see `write_video`.
        at: [s] since the start; by default the end of the longest.

    Raises OutlapError for recordings that cannot be shown together.
    """
    check_together(recordings, track, len(COLOURS))
    moment = max(recording.seconds for recording in recordings) if at is None else at
    scene = Scene(track, size)
    _draw(recordings, scene, moment, view)
    with replacing(path) as partial:
        _image(scene.buffer(), size).save(partial, format="png", optimize=True)
    return Path(path)


def count_pictures(recordings: Sequence[Recording], frames_per_second: int, speed: float = 1.0) -> int:
    """Of the video that shows recordings to the end of the longest."""
    longest = max(recording.seconds for recording in recordings)
    return max(1, round((longest / speed + LAST_PICTURE) * frames_per_second))


def check_video(path: Path, size: tuple[int, int], frames_per_second: int) -> None:
    """Raises OutlapError for an ending that is no video's, and a size or a pace that its format does not have."""
    if path.suffix.lower() not in ENDINGS:
        raise OutlapError(f"{path}: ending is {path.suffix!r}; must be {' or '.join(ENDINGS)}")
    width, height = size
    if width % 2 or height % 2 or min(size) < 64:
        raise OutlapError(f"size is {width} × {height}; must be even numbers, 64 or more")
    if path.suffix.lower() == ".gif" and frames_per_second > FASTEST_GIF:
        raise OutlapError(
            f"{path}: {frames_per_second} pictures a second; browsers show at most {FASTEST_GIF} of a .gif"
        )


def _pictures(
    recordings: Sequence[Recording],
    scene: Scene,
    count: int,
    step: float,
    view: View,
    on_progress: Callable[[int], None] | None,
) -> Iterator[bytes]:
    """Every picture, see `Scene.buffer`; each is done when the next one is asked for."""
    for number in range(count):
        _draw(recordings, scene, number * step, view)
        yield scene.buffer()
        if on_progress is not None:
            on_progress(number + 1)


def _image(picture: bytes, size: tuple[int, int]) -> Image.Image:
    return Image.frombuffer("RGB", size, picture, "raw", "BGRX", 0, 1)


def _draw(recordings: Sequence[Recording], scene: Scene, time: float, view: View) -> None:
    """Draw recordings at a time since their starts, with how those that are over came out."""
    entries = []
    for recording in recordings:
        frame = recording.at(time)
        passed = int(np.searchsorted(recording.time, frame.time, side="right"))
        entries.append(Entry(recording.info.cast, frame, recording.path[:passed], recording.info.title))
    if view == "follow":
        scene.follow(entries[0].frame, 0, scene.nearby())
    over = [recording.info for recording in recordings if time >= recording.seconds]
    scene.draw(entries, "   ".join(f"{info.title}: {info.outcome}" for info in over))


def _write_mp4(pictures: Iterator[bytes], path: Path, size: tuple[int, int], frames_per_second: int) -> None:
    try:
        from imageio_ffmpeg import write_frames
    except ImportError as error:
        raise OutlapError("imageio-ffmpeg is not installed; pip install 'outlap[viewer]'") from error
    options = ["-preset", "veryfast", "-movflags", "+faststart", "-f", "mp4"]
    writer = write_frames(
        str(path), size, pix_fmt_in="bgr0", fps=frames_per_second, codec="libx264", quality=QUALITY, macro_block_size=2,
        output_params=options,
    )  # fmt: skip
    writer.send(None)
    try:
        for picture in pictures:
            writer.send(picture)
    finally:
        writer.close()


def _write_gif(pictures: Iterator[bytes], path: Path, size: tuple[int, int], frames_per_second: int) -> None:
    palette = _palette()
    images: list[Image.Image] = []
    for number, picture in enumerate(pictures, start=1):
        images.append(_image(picture, size).quantize(palette=palette, dither=Image.Dither.NONE))
        if number * size[0] * size[1] > LARGEST_GIF:
            raise OutlapError(f"{path.name}: is too long for a .gif; make it smaller, shorter or slower, or an .mp4")
    # A GIF counts in hundredths of a second: every picture ends at the nearest one.
    ends = np.rint(100.0 / frames_per_second * np.arange(1, len(images) + 1)).astype(int)
    durations = (10 * np.diff(ends, prepend=0)).tolist()
    images[0].save(path, format="gif", save_all=True, append_images=images[1:], duration=durations, loop=0)


def _palette() -> Image.Image:
    """Every colour of a scene, mixed with white where lines are smoothed; the same for all pictures."""
    mixed = [mixed_with_white(colour, share) for colour in (*COLOURS, CRASH_RED, RACELINE) for share in MIXES]
    greys = [(level, level, level) for level in range(0, 256, 15)]
    image = Image.new("P", (1, 1))
    image.putpalette([value for colour in dict.fromkeys([*mixed, *greys]) for value in colour])
    return image
