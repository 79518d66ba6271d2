"""RaceVectorEnv: the one implementation of the environment, for any number of worlds."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from outlap.config import bounds, validate
from outlap.drivers.centerline_follower import CenterlineFollower
from outlap.envs.actions import commands
from outlap.envs.observations import observation_space, observe
from outlap.envs.race import EGO, Race
from outlap.envs.race_config import RaceConfig
from outlap.envs.rewards import REWARD_TERMS, reference_speeds
from outlap.envs.tasks import TaskSet, load_tracks, track_name
from outlap.envs.terminations import RUNNING, STALLED, outcomes
from outlap.errors import OutlapError
from outlap.seeding import DRIVER_STREAM, START_STREAM, uniform, world_keys
from outlap.simulator.atlas import FIRST_ROW, ROWS, SPACING
from outlap.simulator.collision import FREE
from outlap.simulator.simulator import Simulator
from outlap.simulator.vehicle import LENGTH, V_MAX, V_MIN, WIDTH, parameter_bounds
from outlap.track.centerline import WIDTH_LEFT, WIDTH_RIGHT
from outlap.track.track import Track

START_MARGIN = 0.1  # [m] that a start leaves between the car and the track's edge
START_ATTEMPTS = 20
OFFERED_MODES = (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED)
EPISODE_FIELDS = (
    "episode_return", "episode_steps", "progress_m", "mean_speed_mps", "completed_laps", "lap_time_s",
    "overtakes", "places_lost", "impact_speed_mps",
)  # fmt: skip


class RaceVectorEnv(VectorEnv):
    """F1TENTH races in many worlds at once; the learner drives the first car of each.

    Observation: a Dict of the terms in `config.observation`, (worlds, size) float32.
    Action: (worlds, 2) in [-1, 1], steering (left positive) and speed; larger values are clipped.
    An episode `terminated` when the ego crashed and is `truncated` otherwise; `info["outcome"]` says how.
    After the step that ends an episode the world is reset at once (AutoresetMode.SAME_STEP); what the
    episode's last observation was stands in `info["final_obs"]`, its summary in `info["final_info"]`.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        tracks: Sequence[str | os.PathLike[str] | Track] | str | os.PathLike[str] | Track = (),
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        render_mode: None = None,
        **config: Any,
    ) -> None:
        """Build `num_envs` worlds.

        Args:
            num_envs: worlds.
            tracks: names, map folders or `Track`s, one of which is drawn at each reset; none of them gives the
                built-in training set.
            autoreset_mode: SAME_STEP, or DISABLED for a caller that resets by `reset_mask`.
            render_mode: only None; races are looked at through `outlap`'s viewers.
            **config: the fields of `RaceConfig`.

        Raises OutlapError for an unknown or wrong field, a track that cannot be loaded.
        """
        names = list(tracks) if isinstance(tracks, Sequence) and not isinstance(tracks, str) else [tracks]
        if not names:
            from outlap.track.generate import BUILTIN_TRAIN

            names = list(BUILTIN_TRAIN)
        self.config = validate(RaceConfig, {**config, "tracks": tuple(map(track_name, names))}, "outlap/Race-v0")
        if autoreset_mode not in (*OFFERED_MODES, *(mode.value for mode in OFFERED_MODES)):
            raise OutlapError(f"autoreset_mode is {autoreset_mode!r}; SAME_STEP and DISABLED are offered")
        loaded = load_tracks(names, self.config.augment_tracks)
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        if render_mode is not None:
            raise OutlapError(f"render_mode is {render_mode!r}; only None is offered")
        if not isinstance(num_envs, (int, np.integer)) or num_envs < 1:
            raise OutlapError(f"num_envs is {num_envs!r}; it must be a whole number, at least 1")
        self.num_envs = num_envs
        self.render_mode = None

        self.tasks = TaskSet(loaded, self.config.vehicle, self.config.actuators, self.config.lidar)
        simulator = Simulator(loaded, num_envs, self.config.num_cars, self.config, self.tasks.max_delay)
        typical = np.mean(parameter_bounds(self.config.vehicle), axis=0)
        self.race = Race(simulator, reference_speeds(loaded, simulator.atlas, typical))
        self._weights = self.config.reward.resolved()
        interval = self.config.control_interval * self.config.timestep
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": [], "render_fps": round(1 / interval)}

        self.single_observation_space = observation_space(
            self.config.observation, self.config.beams, bounds(self.config.lidar.max_range)[1],
            self.config.scale_observations,
        )  # fmt: skip
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

        self._opponents = CenterlineFollower(speed_action=1.0)
        self._opponent_speed = np.zeros((num_envs, self.config.num_cars), np.float32)
        self._keys: np.ndarray | None = None
        self._episode = np.zeros(num_envs, np.int64)  # number of each world's episode since it was seeded
        self._over = np.ones(num_envs, bool)  # waits for a reset
        self._names = np.array([track.name for track in loaded], dtype=object)
        self._totals = {name: np.zeros(num_envs) for name in (*EPISODE_FIELDS, *self._weights)}

    @property
    def training_steps(self) -> int:
        """Environment steps so far, all worlds together: what curricula go by."""
        return self.race.training_steps

    @training_steps.setter
    def training_steps(self, steps: int) -> None:
        self.race.training_steps = int(steps)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode in every world, or in those of `options["reset_mask"]`, bool (worlds,).

        A seed of one number gives world i the seed + i. Without a seed the worlds go on with their streams,
        so that every episode differs.
        """
        mask = None if options is None else options.get("reset_mask")
        mask = np.ones(self.num_envs, bool) if mask is None else np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise OutlapError(f"reset_mask is {mask.dtype} {mask.shape}; it must be bool ({self.num_envs},)")
        which = np.flatnonzero(mask)
        self._seed(seed, which)
        self._begin(which)
        return self._observe(), self._info()

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Carry out one action (worlds, 2) a world for `control_interval` physics steps.

        Raises OutlapError for actions of a wrong shape, not finite, or before a reset.
        """
        race, config = self.race, self.config
        race.act(self._all_actions(actions))
        limits = race.worlds.params
        command = commands(race.actions, limits, config.speed_range)
        if config.num_cars > 1:
            command[:, 1:, 1] = 0.5 * (race.actions[:, 1:, 1] + 1.0) * self._opponent_speed[:, 1:]
        race.simulator.step(command, config.control_interval)
        race.advance(config.termination.stall_distance)
        race.training_steps += self.num_envs

        outcome = outcomes(race, config.termination)
        race.stalled[:] = outcome == STALLED
        rewards = self._reward()
        terminated = race.crashed.copy()
        truncated = ~terminated & (outcome != RUNNING)
        self._count(rewards)

        info = self._info(outcome)
        over = terminated | truncated
        self._over = over.copy()  # which the next reset changes
        if over.any() and self.autoreset_mode == AutoresetMode.SAME_STEP:
            final = self._observe()
            final_info = {name: value.copy() for name, value in info.items() if not name.startswith("_")}
            which = np.flatnonzero(over)
            self._begin(which)
            observation = self._observe()
            final_obs = np.full(self.num_envs, None, dtype=object)
            for world in which:
                final_obs[world] = {name: value[world] for name, value in final.items()}
            known, info = info, self._info()
            info["final_obs"], info["_final_obs"] = final_obs, over
            info["final_info"] = {**final_info, **{f"_{name}": over & known[f"_{name}"] for name in final_info}}
            info["_final_info"] = over
            return observation, rewards, terminated, truncated, info
        return self._observe(), rewards, terminated, truncated, info

    def close_extras(self, **kwargs: Any) -> None:
        """Nothing is open."""

    def _seed(self, seed: int | Sequence[int | None] | None, which: np.ndarray) -> None:
        if self._keys is None:  # random until a seed is given
            self._keys = np.random.SeedSequence().generate_state(self.num_envs, np.uint64)
        if seed is None:
            return
        if isinstance(seed, (int, np.integer)):
            seeds = [int(seed) + i for i in range(self.num_envs)]
        else:
            seeds = list(seed) if isinstance(seed, (Sequence, np.ndarray)) else [seed]
        for each in seeds:
            if each is not None and not (isinstance(each, (int, np.integer)) and each >= 0):
                raise OutlapError(f"seed is {each!r}; it must be a whole number, 0 or more")
        if len(seeds) != self.num_envs:
            raise OutlapError(f"seed: {len(seeds)} given for {self.num_envs} worlds; give one, or one a world")
        self._np_random_seed = seeds[0] if seeds[0] is not None else -1
        self._np_random = np.random.default_rng(seeds[0])
        chosen = [world for world in which if seeds[world] is not None]
        self._keys[chosen] = world_keys([int(seeds[world]) for world in chosen])  # type: ignore[arg-type]
        self._episode[chosen] = 0

    def _begin(self, which: np.ndarray) -> None:
        """Draw a task and a start for some worlds, and reset them."""
        assert self._keys is not None
        worlds, cars = self.race.worlds, self.config.num_cars
        keys = self._keys[which]
        self._episode[which] += 1
        episodes = self._episode[which]
        tracks, params = self.tasks.draw(keys, episodes, cars)
        low, high = bounds(self.config.opponent_speed)
        share = uniform(keys, episodes, DRIVER_STREAM, cars)
        self._opponent_speed[which] = low + share * (high - low)
        noise_keys = keys ^ (episodes.astype(np.uint64) << np.uint64(32))
        waiting = np.arange(len(which))
        for attempt in range(START_ATTEMPTS):
            # The later the attempt, the nearer to the centreline: a narrow place ends the loop all the same.
            spread = 1.0 - attempt / (START_ATTEMPTS - 1)
            starts = self._draw_starts(
                keys[waiting],
                episodes[waiting] * START_ATTEMPTS + attempt,
                tracks[waiting],
                params[waiting],
                spread,
            )
            self.race.simulator.reset(
                which[waiting], keys=noise_keys[waiting], tracks=tracks[waiting], params=params[waiting],
                starts=starts,
            )  # fmt: skip
            waiting = waiting[(worlds.contact[which[waiting]] != FREE).any(axis=1)]
            if not len(waiting):
                break
        else:
            name = self._names[tracks[waiting[0]]]
            raise OutlapError(
                f"track {name}: found no start free of contact; is it as wide as a car, and long enough for all?"
            )
        self.race.begin(which)
        self._over[which] = False
        for total in self._totals.values():
            total[which] = 0.0
        self._totals["lap_time_s"][which] = np.nan

    def _draw_starts(
        self, keys: np.ndarray, episodes: np.ndarray, tracks: np.ndarray, params: np.ndarray, spread: float
    ) -> np.ndarray:
        """Starts (n, cars, 4) for `Simulator.reset`; the cars stand one behind another in random order."""
        config, cars = self.config.start, self.config.num_cars
        atlas = self.race.simulator.atlas
        share = uniform(keys, episodes, START_STREAM, 1 + 5 * cars)
        each = share[:, 1:].reshape(len(keys), cars, 5)
        rows, spacing = atlas.index[tracks, ROWS, None], atlas.frame[tracks, SPACING, None]
        length = rows * spacing
        low, high = bounds(config.gap)
        slots = np.cumsum(low + each[..., 0] * (high - low) + params[..., LENGTH], axis=1)
        place = np.argsort(np.argsort(each[..., 1], axis=1), axis=1)
        behind = np.take_along_axis(slots, place, axis=1)
        behind -= behind[:, [EGO]]
        base = share[:, :1] * length if config.anywhere else np.zeros((len(keys), 1))
        s = base - behind
        row = atlas.index[tracks, FIRST_ROW, None] + (s / spacing).astype(np.int64) % rows
        # The body's half diagonal stays on the track whichever way the car points.
        body = 0.5 * np.hypot(params[..., LENGTH], params[..., WIDTH]) + START_MARGIN
        side = 2.0 * each[..., 2] - 1.0
        room = np.where(side > 0.0, atlas.line[row, WIDTH_LEFT], atlas.line[row, WIDTH_RIGHT]) - body
        offset = side * np.maximum(room, 0.0) * config.offset * spread
        error = (2.0 * each[..., 3] - 1.0) * config.heading_error * spread
        low, high = bounds(config.speed)
        speed = np.clip(low + each[..., 4] * (high - low), params[..., V_MIN], params[..., V_MAX])
        return np.stack([s, offset, error, speed], axis=-1)

    def _all_actions(self, actions: np.ndarray) -> np.ndarray:
        """The ego's actions, checked and clipped, with those of the opponents: (worlds, cars, 2)."""
        try:
            actions = np.asarray(actions, np.float32)
        except (TypeError, ValueError):
            raise OutlapError(f"actions are {actions!r:.60}; they must be numbers ({self.num_envs}, 2)") from None
        if actions.shape != (self.num_envs, 2):
            raise OutlapError(f"actions have shape {actions.shape}; they must be ({self.num_envs}, 2)")
        if self._over.any():
            raise OutlapError(f"world {np.argmax(self._over)}: its episode is over or never began; call reset first")
        if not np.isfinite(actions).all():
            world = int(np.argwhere(~np.isfinite(actions))[0, 0])
            raise OutlapError(f"actions: that of world {world} is {actions[world].tolist()}; it must be finite")
        everyone = np.empty((self.num_envs, self.config.num_cars, 2), np.float32)
        everyone[:, EGO] = np.clip(actions, -1.0, 1.0)
        driver = self._opponents
        for car in range(1, self.config.num_cars):
            seen = observe(self.race, car, driver.observation_terms, driver.scale_observations)
            everyone[:, car] = driver.act(seen)
        return everyone

    def _reward(self) -> np.ndarray:
        total = np.zeros(self.num_envs)
        for name, weight in self._weights.items():
            value = weight * REWARD_TERMS[name](self.race, self.config.reward)
            self._totals[name] += value
            total += value
        self.race.rewards[:] = total
        return total

    def _count(self, rewards: np.ndarray) -> None:
        """Add a step to what is told about each episode."""
        race, totals, worlds = self.race, self._totals, self.race.worlds
        totals["episode_return"] += rewards
        totals["episode_steps"] += 1
        totals["mean_speed_mps"] += (race.speed - totals["mean_speed_mps"]) / totals["episode_steps"]
        totals["progress_m"][:] = race.distance - race.start
        # The mean of all laps so far: each new one moves it by its share.
        new = worlds.laps[:, EGO] > totals["completed_laps"]
        totals["completed_laps"][:] = worlds.laps[:, EGO]
        if new.any():
            before = np.nan_to_num(totals["lap_time_s"][new])
            totals["lap_time_s"][new] = before + (worlds.lap_time[new, EGO] - before) / worlds.laps[new, EGO]
        totals["overtakes"] += race.places_gained
        totals["places_lost"] += race.places_lost
        totals["impact_speed_mps"][:] = worlds.impact_speed[:, EGO]

    def _observe(self) -> dict[str, np.ndarray]:
        return observe(self.race, EGO, self.config.observation, self.config.scale_observations)

    def _info(self, outcome: np.ndarray | None = None) -> dict[str, Any]:
        """What is known of each world; a key's mask says for which."""
        worlds = self.race.worlds
        info: dict[str, Any] = {
            "outcome": np.full(self.num_envs, RUNNING) if outcome is None else outcome,
            "track": self._names[worlds.track],
            "vehicle": worlds.params.copy(),
            "opponent_speed_mps": self._opponent_speed[:, 1:].copy(),
            "laps": worlds.laps[:, EGO].copy(),
            "last_lap_time_s": worlds.lap_time[:, EGO].copy(),
            "time_s": worlds.time.copy(),
            **{name: total.copy() for name, total in self._totals.items() if name in EPISODE_FIELDS},
            **{f"reward_{name}": self._totals[name].copy() for name in self._weights},
        }
        known = dict.fromkeys(info, np.ones(self.num_envs, bool))
        known["lap_time_s"] = known["last_lap_time_s"] = worlds.laps[:, EGO] > 0
        return {**info, **{f"_{name}": mask for name, mask in known.items()}}
