"""Record episodes to look at, and laps for a ghost to drive."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from outlap.drivers.driver import Driver
from outlap.envs.actions import driver_actions
from outlap.envs.race import EGO
from outlap.envs.race_config import RaceConfig
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.envs.terminations import CRASH
from outlap.errors import OutlapError
from outlap.evaluation.frame import Frame, cast_of, frame_of
from outlap.evaluation.protocol import episode_seeds, episode_task, single_race, standing_starts
from outlap.evaluation.recording import STORED, SUFFIX, Event, Recording, RecordingInfo
from outlap.simulator import state as column
from outlap.track.track import Track


def record_episodes(
    driver: Driver,
    env: RaceConfig,
    track: Track,
    seed: int,
    number: int,
    folder: Path,
    title: str | None = None,
    on_recorded: Callable[[Path], None] | None = None,
) -> None:
    """Race the first episodes that `evaluate` races on a track with this seed again, and record each in a folder.

    Args:
        driver, env, track, title: see `record_episode`.
        seed: of the evaluation.
        number: of episodes.
        folder: of the files TRACK-EPISODE.npz.
        on_recorded: called with the path of each file.
    """
    for episode, own in enumerate(episode_seeds(seed, track.name, number).tolist()):
        recording = record_episode(driver, env, track, own, title)
        path = recording.save(folder / f"{track.name.replace('/', '-')}-{episode:03d}{SUFFIX}")
        if on_recorded is not None:
            on_recorded(path)


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
        env: the task, see `protocol.standing_starts`; its beams are recorded, even of a driver without a scanner.
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
    recorder = _Recorder(race, driver, terms)
    recorder.see(info, np.zeros(2, np.float32))
    over = False
    while not over:
        action = driver_actions(driver, observation, 1)
        observation, _, terminated, truncated, info = race.step(action)
        recorder.see(info, action[0])
        over = bool(terminated[0] or truncated[0])
        if on_progress is not None:
            on_progress(float(race.race.worlds.time[0]))
    outcome = str(info["outcome"][0])
    recorder.note(EGO, "end", how_it_ended(info))
    words = RecordingInfo(
        title=title or driver.name,
        track=track.name,
        track_fingerprint=track.fingerprint,
        seed=seed,
        cast=recorder.cast,
        outcome=outcome,
        events=tuple(recorder.events),
        terms=terms,
    )
    return recorder.recording(words)


class _Recorder:
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
    """Return in words how the episode of the only world ended, from the information of its last step."""
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
