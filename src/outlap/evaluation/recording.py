"""Recording episodes to be looked at again, and laps for a ghost to drive again."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from gymnasium.vector import AutoresetMode

from outlap.config import Config, validate
from outlap.drivers.driver import Driver
from outlap.envs.actions import driver_actions
from outlap.envs.frame import MOTION, Cast, Frame, Words, X, Y, between, cast_of, frame_of
from outlap.envs.race import EGO
from outlap.envs.race_config import RaceConfig
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.envs.rewards import CURRICULA_OVER
from outlap.envs.terminations import CRASH
from outlap.errors import OutlapError, brief
from outlap.evaluation.rollout import episode_seeds, episode_task, single_race, standing_starts
from outlap.files import atomic_write
from outlap.simulator import state as column
from outlap.track.track import Track

SUFFIX = ".npz"
RECORDINGS = "recordings"  # folder of them in that of an evaluation
LARGEST_FILE = 512 * 2**20  # bytes, unpacked, that a recording may have


class Event(Config):
    """Something that happened in an episode."""

    time_s: float
    car: int  # number; 0 is the ego
    kind: Literal["start", "overtake", "place lost", "lap", "contact", "end"]
    text: Words


class RecordingInfo(Config):
    """What a recording says in words."""

    title: Words
    track: Words
    track_fingerprint: str
    seed: int
    cast: Cast
    outcome: Words
    events: tuple[Event, ...]
    terms: tuple[str, ...]  # of the reward


@dataclass(frozen=True)
class Recording:
    """An episode, frame by frame; a frame is an action of the ego. Frame 0 is the start."""

    info: RecordingInfo
    time: np.ndarray  # float32 (frames,) [s]
    motion: np.ndarray  # float32 (frames, cars, 6), see `Frame`
    distance: np.ndarray  # float32 (frames, cars)
    laps: np.ndarray  # int16 (frames, cars)
    lap_time: np.ndarray  # float32 (frames, cars)
    contact: np.ndarray  # uint8 (frames, cars)
    scan: np.ndarray  # float16 (frames, beams)
    action: np.ndarray  # float32 (frames, 2) of the ego: steer, speed; what led to the frame, 0 in the first
    rewards: np.ndarray  # float32 (frames, terms), weighted
    context: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.float32))  # (frames, hidden), or empty

    @property
    def seconds(self) -> float:
        """From its first frame to its last one."""
        return float(self.time[-1] - self.time[0])

    def frame(self, number: int) -> Frame:
        """A frame of it."""
        values = {name: getattr(self, name)[number] for name in STORED}
        return Frame(**{**values, "time": float(values["time"]), "motion": values["motion"].astype(float)})

    def at(self, time: float) -> Frame:
        """What was to be seen at a time [s] since its start, between two frames as well."""
        now = min(max(time, 0.0), self.seconds) + float(self.time[0])
        number = min(int(np.searchsorted(self.time, now, side="right")) - 1, len(self.time) - 2)
        if number < 0:
            return self.frame(0)
        before, after = self.frame(number), self.frame(number + 1)
        return between(before, after, (now - before.time) / (after.time - before.time))

    @cached_property
    def path(self) -> np.ndarray:
        """Of the ego: (frames, 2) [m]."""
        return self.motion[:, EGO, [X, Y]]

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write it as a NumPy archive that holds no code."""
        buffer = io.BytesIO()
        arrays = {name: getattr(self, name) for name in ARRAYS}
        words = np.frombuffer(self.info.model_dump_json().encode(), np.uint8)
        np.savez_compressed(buffer, info=words, **arrays)
        return atomic_write(path, buffer.getvalue())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Recording:
        """Read what `save` wrote; runs no code. Raises OutlapError for a file that is missing or broken."""
        path = Path(path)
        try:
            with np.load(path, allow_pickle=False) as archive:
                if sum(member.file_size for member in archive.zip.infolist()) > LARGEST_FILE:  # type: ignore[union-attr]
                    raise ValueError("it is too large")
                words = archive["info"].tobytes()
                arrays = {name: archive[name].astype(TYPES[name]) for name in ARRAYS}
            info = validate(RecordingInfo, json.loads(words), str(path))
        except FileNotFoundError:
            raise OutlapError(f"{path}: no such file; record episodes with outlap evaluate --record") from None
        except OutlapError:
            raise
        except Exception as error:  # whatever a broken archive raises
            raise OutlapError(f"{path}: is no recording: {brief(error)}") from None
        frames, cars = len(arrays["time"]), len(info.cast.drivers)
        shapes = {
            "time": (frames,), "motion": (frames, cars, len(MOTION)), "distance": (frames, cars),
            "laps": (frames, cars), "lap_time": (frames, cars), "contact": (frames, cars), "action": (frames, 2),
            "rewards": (frames, len(info.terms)),
        }  # fmt: skip
        if not frames or not cars or cars != len(info.cast.sizes) or min(map(min, info.cast.sizes)) <= 0.0:
            raise OutlapError(f"{path}: has {frames} frames, {cars} drivers and cars of {info.cast.sizes} m")
        for name, shape in shapes.items():
            if arrays[name].shape != shape:
                raise OutlapError(f"{path}: {name} has shape {arrays[name].shape}; must be {shape}")
        for name, lengths in (("scan", (frames,)), ("context", (0, frames))):
            if arrays[name].ndim != 2 or len(arrays[name]) not in lengths:
                raise OutlapError(f"{path}: {name} has shape {arrays[name].shape}; must be ({frames}, any)")
        for name in ARRAYS:
            if name != "lap_time" and not np.isfinite(arrays[name]).all():
                raise OutlapError(f"{path}: {name} holds numbers that are not finite")
        if (np.diff(arrays["time"]) <= 0.0).any():
            raise OutlapError(f"{path}: time does not grow from frame to frame")
        return cls(info, **arrays)


# Of a frame, as they are stored; then what a recording has beside them.
STORED = {"time": "f4", "motion": "f4", "distance": "f4", "laps": "i2", "lap_time": "f4", "contact": "u1", "scan": "f2"}
TYPES = {**STORED, "action": "f4", "rewards": "f4", "context": "f4"}
ARRAYS = tuple(TYPES)


def check_together(recordings: Sequence[Recording], track: Track, most: int) -> None:
    """Raises OutlapError for no recording, too many to tell apart, or one of another track."""
    if not 1 <= len(recordings) <= most:
        raise OutlapError(f"{len(recordings)} recordings; 1 to {most} can be shown together")
    for recording in recordings:
        if recording.info.track_fingerprint != track.fingerprint:
            raise OutlapError(
                f"{recording.info.title}: was raced on {recording.info.track}, and {track.name} is another track, or "
                "another version of it; show races on one track together"
            )


def record_episode(
    driver: Driver,
    env: RaceConfig,
    track: Track,
    seed: int,
    title: str | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> Recording:
    """Race the episode of a seed, as `evaluate` does, and keep what can be seen of it.

    Args:
        driver: of the first car.
        env: the task, see `rollout.standing_starts`; its beams are recorded, even of a driver without a scanner.
            Rewards are those that the driver is shown.
        track: to race on.
        seed: of the episode: of a row of `evaluate`, for example.
        title: of the recording; by default the driver's name.
        on_progress: called with the seconds of the episode now and then.
    """
    race = single_race(driver, env, track)
    observation, info = race.reset(seed=[seed])
    driver.begin(np.ones(1, bool))
    terms = tuple(name.removeprefix("reward_") for name in info if name.startswith("reward_"))
    watcher = _Watcher(race, driver, terms)
    watcher.see(info, np.zeros(2, np.float32))
    over = False
    while not over:
        race.training_steps = CURRICULA_OVER
        action = driver_actions(driver, observation, 1)
        observation, _, terminated, truncated, info = race.step(action)
        watcher.see(info, action[0])
        over = bool(terminated[0] or truncated[0])
        if on_progress is not None:
            on_progress(float(race.race.worlds.time[0]))
    outcome = str(info["outcome"][0])
    watcher.note(EGO, "end", how_it_ended(info))
    words = RecordingInfo(
        title=title or driver.name,
        track=track.name,
        track_fingerprint=track.fingerprint,
        seed=seed,
        cast=watcher.cast,
        outcome=outcome,
        events=tuple(watcher.events),
        terms=terms,
    )
    return watcher.recording(words)


def record_episodes(
    driver: Driver,
    env: RaceConfig,
    track: Track,
    seed: int,
    number: int,
    folder: Path,
    title: str | None = None,
    suffix: str = "",
    on_recorded: Callable[[Path], None] | None = None,
) -> None:
    """Race and record the first episodes of a track again, those of `evaluate` with this seed.

    Args:
        driver: who drives.
        env: the races.
        track: where.
        seed: of the evaluation.
        number: of episodes.
        folder: for the recordings, TRACK-EPISODE and `suffix` each.
        title: see `record_episode`.
        suffix: of the names of the files.
        on_recorded: called with each file.
    """
    for episode, own in enumerate(episode_seeds(seed, track.name, number).tolist()):
        recording = record_episode(driver, env, track, own, title)
        path = recording.save(folder / f"{track.name.replace('/', '-')}-{episode:03d}{suffix}{SUFFIX}")
        if on_recorded is not None:
            on_recorded(path)


class _Watcher:
    """Takes down what happens in a race of one world."""

    def __init__(self, env: RaceVectorEnv, driver: Driver, terms: tuple[str, ...]) -> None:
        self.env, self.driver, self.terms = env, driver, terms
        self.cast = cast_of(env, driver.name)
        self.frames: list[Frame] = []
        self.actions: list[np.ndarray] = []
        self.rewards: list[np.ndarray] = []  # of all steps until each frame
        self.contexts: list[np.ndarray] = []
        self.events: list[Event] = []

    def see(self, info: dict[str, Any], action: np.ndarray) -> None:
        """Take down a frame, and what happened since the one before."""
        before = self.frames[-1] if self.frames else None
        self.frames.append(frame_of(self.env))
        self.actions.append(np.asarray(action, np.float32))
        self.rewards.append(np.array([float(info[f"reward_{name}"][0]) for name in self.terms]))
        if before is None:
            self.note(EGO, "start", f"start on {info['track'][0]}")
            return
        context = self.driver.context()
        if context is not None:  # of the decision that led here
            self.contexts.append(np.asarray(context[0], np.float32))
        self._compare(before, self.frames[-1])

    def _compare(self, before: Frame, now: Frame) -> None:
        for car, name in enumerate(self.cast.drivers):
            if now.laps[car] > before.laps[car]:
                self.note(car, "lap", f"{name}: lap {now.laps[car]} in {now.lap_time[car]:.2f} s")
            if car != EGO and self.env.wrecked[0, car - 1]:
                self.note(car, "contact", f"{name} crashes")
        ego, race = self.cast.drivers[EGO], self.env.race
        if gained := int(race.places_gained[0, EGO]):
            self.note(EGO, "overtake", f"{ego} gains {_places(gained)}")
        if lost := int(race.places_lost[0, EGO]):
            self.note(EGO, "place lost", f"{ego} loses {_places(lost)}")

    def note(self, car: int, kind: Any, text: str) -> None:
        """An event of this moment."""
        self.events.append(Event(time_s=self.frames[-1].time, car=car, kind=kind, text=text))

    def recording(self, info: RecordingInfo) -> Recording:
        """All frames together."""
        arrays = {
            name: np.array([getattr(frame, name) for frame in self.frames], kind) for name, kind in STORED.items()
        }
        rewards = np.diff(np.array(self.rewards), axis=0, prepend=0.0).astype(np.float32)
        if self.contexts:
            arrays["context"] = np.array([self.contexts[0], *self.contexts])  # at the start nothing is decided yet
        return Recording(info, **arrays, action=np.array(self.actions), rewards=rewards)


def _places(count: int) -> str:
    return "a place" if count == 1 else f"{count} places"


def how_it_ended(info: Mapping[str, Any]) -> str:
    """How an episode of the only world ended, in words, from what its last step told."""
    outcome = str(info["outcome"][0])
    if outcome == CRASH:
        return f"{outcome} into a {info['contact'][0]} at {info['impact_speed_mps'][0]:.1f} m/s"
    return outcome


def record_lap(driver: Driver, env: RaceConfig, track: Track, seed: int = 0) -> np.ndarray:
    """The first flying lap of a driver alone on a track: (n, 5), see `drivers.ghost.COLUMNS`, a row an action.

    Raises OutlapError where the driver does not complete it.
    """
    alone = standing_starts(env.model_copy(update={"num_cars": 1}), [track], laps=1)
    task, _ = episode_task(driver, alone)
    race = RaceVectorEnv(1, task, [track], autoreset_mode=AutoresetMode.DISABLED)
    observation, info = race.reset(seed=seed)
    driver.begin(np.ones(1, bool))
    worlds, lap = race.race.worlds, []
    while True:
        observation, _, terminated, truncated, info = race.step(driver_actions(driver, observation, 1))
        begun = worlds.lap_start[0, EGO]
        if not (np.isnan(begun) or worlds.laps[0, EGO]):
            state = worlds.state[0, EGO]
            lap.append([worlds.time[0] - begun, *state[[column.X, column.Y, column.YAW, column.SPEED]]])
        if terminated[0] or truncated[0]:
            if worlds.laps[0, EGO] == 0:
                raise OutlapError(
                    f"driver {driver.name}: completed no lap of {track.name} ({info['outcome'][0]} after "
                    f"{info['progress_m'][0]:.0f} m); try another --seed, or another driver"
                )
            return np.array(lap)
