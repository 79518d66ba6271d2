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
from outlap.drivers.driver import Driver
from outlap.drivers.find import Named, driver_name, find_drivers
from outlap.envs.actions import check_actions, commands, speed_spans
from outlap.envs.observations import observation_space, observe
from outlap.envs.opponents import Opponents
from outlap.envs.race import EGO, Race
from outlap.envs.race_config import RaceConfig
from outlap.envs.racing_line import ReferenceSpeeds, racing_lines
from outlap.envs.rewards import REWARD_TERMS
from outlap.envs.starts import draw_starts
from outlap.envs.tasks import TaskSet, track_name
from outlap.envs.terminations import RUNNING, STALLED, outcomes
from outlap.errors import OutlapError
from outlap.seeding import world_keys
from outlap.simulator.collision import FREE, HIT_CAR, HIT_WALL
from outlap.simulator.simulator import Simulator
from outlap.simulator.vehicle import parameter_bounds, to_records, to_values
from outlap.track.catalog import load_tracks
from outlap.track.track import Track

START_ATTEMPTS = 20
RESPAWN_CLEARANCE = 3.0  # [m] to the middle of every other car, before an opponent comes back
CONTACTS = np.array(["", "wall", "car", ""], dtype=object)  # what was hit, by FREE, HIT_WALL, HIT_CAR, REMOVED
OFFERED_MODES = (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED)
EPISODE_FIELDS = (
    "episode_return", "episode_steps", "progress_m", "mean_speed_mps", "completed_laps", "lap_time_s",
    "overtakes", "places_lost", "impact_speed_mps", "opponent_crashes",
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
        opponents: Sequence[Named] | Named | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        render_mode: None = None,
        **config: Any,
    ) -> None:
        """Build `num_envs` worlds.

        Args:
            num_envs: worlds.
            tracks: names, map folders or `Track`s, one of which is drawn at each reset; none of them gives the
                built-in training set.
            opponents: names (see `drivers.find`), `Driver`s or functions, one of which is drawn for each opponent at
                each reset; by default pure pursuit.
            autoreset_mode: SAME_STEP, or DISABLED for a caller that resets by `reset_mask`.
            render_mode: only None; `RaceEnv` draws.
            **config: the fields of `RaceConfig`.

        Raises OutlapError for an unknown or wrong field, a track or an opponent that cannot be loaded.
        """
        names: list[Any] = list(tracks) if isinstance(tracks, Sequence) and not isinstance(tracks, str) else [tracks]
        if not names:
            from outlap.track.generate import BUILTIN_TRAIN

            names = list(BUILTIN_TRAIN)
        config["tracks"] = tuple(map(track_name, names))
        rivals: Sequence[Named] | None = None
        if opponents is not None:
            rivals = opponents if isinstance(opponents, (list, tuple)) else [opponents]  # type: ignore[list-item]
            config["opponents"] = tuple(driver_name(rival) for rival in rivals)  # type: ignore[union-attr]
        self.config = validate(RaceConfig, config, "outlap/Race-v0")
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
        typical = to_records(np.mean(parameter_bounds(self.config.vehicle), axis=0))
        drivers = self._find_opponents(self.config.opponents if rivals is None else rivals)
        looked_at = any(
            "line_ahead" in terms
            for terms in (self.config.observation, *(driver.observation_terms for driver in drivers))
        )
        line = racing_lines(loaded, simulator.atlas, typical, self.config.racing_line if looked_at else "track")
        self._weights = self.config.reward.resolved()
        reference = None
        if "velocity_matching" in self._weights:
            reference = ReferenceSpeeds(loaded, simulator.atlas, typical, num_envs, self.config.num_cars)
        self.race = Race(simulator, self.config.nearby_cars, line, reference)
        interval = self.config.control_interval * self.config.timestep
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": [], "render_fps": round(1 / interval)}

        self.single_observation_space = observation_space(
            self.config.observation, self.config.beams, bounds(self.config.lidar.max_range)[1],
            self.config.nearby_cars, self.config.scale_observations,
        )  # fmt: skip
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

        self._opponents = None
        if drivers:
            self._opponents = Opponents(drivers, self.race, self.config.opponent_speed, self.config.opponent_noise)
        self.taken_over: dict[int, np.ndarray] = {}  # actions (2,) of cars that are driven in place of their drivers
        self._keys: np.ndarray | None = None
        self._episode = np.zeros(num_envs, np.int64)  # number of each world's episode since it was seeded
        self._over = np.ones(num_envs, bool)  # waits for a reset
        self._task = np.full(num_envs, "", object)  # name of each world's
        self._down = np.zeros((num_envs, self.config.num_cars - 1), bool)  # opponents that have crashed
        self.wrecked = np.zeros_like(self._down)  # opponents that crashed in the last step
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
        return self.observe(EGO), self._info()

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Carry out one action (worlds, 2) a world for `control_interval` physics steps.

        Raises OutlapError for actions of a wrong shape, not finite, or before a reset.
        """
        self.advance(self._all_actions(actions))
        outcome = self.outcomes(EGO)
        rewards = self.rewards(EGO, self._totals)
        terminated = self.race.crashed[:, EGO].copy()
        truncated = ~terminated & (outcome != RUNNING)
        self._count(rewards)

        info = self._info(outcome)
        over = terminated | truncated
        self._over = over.copy()  # which the next reset changes
        if over.any() and self.autoreset_mode == AutoresetMode.SAME_STEP:
            final = self.observe(EGO)
            final_info = {name: value.copy() for name, value in info.items() if not name.startswith("_")}
            which = np.flatnonzero(over)
            self._begin(which)
            observation = self.observe(EGO)
            final_obs = np.full(self.num_envs, None, dtype=object)
            for world in which:
                final_obs[world] = {name: value[world] for name, value in final.items()}
            known, info = info, self._info()
            info["final_obs"], info["_final_obs"] = final_obs, over
            info["final_info"] = {**final_info, **{f"_{name}": over & known[f"_{name}"] for name in final_info}}
            info["_final_info"] = over
            return observation, rewards, terminated, truncated, info
        return self.observe(EGO), rewards, terminated, truncated, info

    def advance(self, actions: np.ndarray) -> None:
        """Carry out an action (worlds, cars, 2) of every car: a step, of which the methods below then tell.

        Raises OutlapError before a reset.
        """
        if self._over.any():
            raise OutlapError(f"world {np.argmax(self._over)}: its episode is over or never began; call reset first")
        race, config = self.race, self.config
        race.act(actions)
        race.simulator.step(commands(race.actions, race.worlds.params, race.speeds), config.control_interval)
        race.advance(config.termination.stall_distance)
        race.training_steps += self.num_envs

    def observe(self, car: int) -> dict[str, np.ndarray]:
        """What a car is told: (worlds, size) of every term, float32."""
        return observe(self.race, car, self.config.observation, self.config.scale_observations)

    def outcomes(self, car: int) -> np.ndarray:
        """How the last step ended each world's episode for a car, "" where it did not: str (worlds,)."""
        found = outcomes(self.race, car, self.config.termination)
        self.race.stalled[:, car] = found == STALLED
        return found

    def rewards(self, car: int, totals: dict[str, np.ndarray] | None = None) -> np.ndarray:
        """A car's reward for the last step, after `outcomes`: (worlds,). Each term is added to its total."""
        reward = np.zeros(self.num_envs)
        for name, weight in self._weights.items():
            value = weight * REWARD_TERMS[name](self.race, car, self.config.reward)
            if totals is not None:
                totals[name] += value
            reward += value
        self.race.rewards[:, car] = reward
        return reward

    def rivals(self, world: int) -> list[str]:
        """Names of the drivers of the other cars in a world, in their order."""
        if self._opponents is None:
            return [f"car {car}" for car in range(1, self.config.num_cars)]
        return self._opponents.names()[world].tolist()

    def opponent_names(self) -> list[str]:
        """Of the drivers that opponents are drawn from."""
        return [] if self._opponents is None else [driver.name for driver in self._opponents.drivers]

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
        self.race.speeds[which] = speed_spans(params, self.config.speed_range)
        if self._opponents is not None:
            self.race.speeds[which, 1:] = self._opponents.draw(which, keys, episodes, params[:, 1:])
        noise_keys = keys ^ (episodes.astype(np.uint64) << np.uint64(32))
        waiting = np.arange(len(which))
        for attempt in range(START_ATTEMPTS):
            # The later the attempt, the nearer to the centreline: a narrow place ends the loop all the same.
            spread = 1.0 - attempt / (START_ATTEMPTS - 1)
            starts = draw_starts(
                self.config.start, self.race.simulator.atlas, keys[waiting],
                episodes[waiting] * START_ATTEMPTS + attempt, tracks[waiting], params[waiting], spread,
            )  # fmt: skip
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
        self._down[which] = False
        self._task[which] = self._task_names(which)
        for total in self._totals.values():
            total[which] = 0.0
        self._totals["lap_time_s"][which] = np.nan

    def _all_actions(self, actions: np.ndarray) -> np.ndarray:
        """The ego's actions, checked and clipped, with those of the opponents: (worlds, cars, 2)."""
        everyone = np.empty((self.num_envs, self.config.num_cars, 2), np.float32)
        everyone[:, EGO] = check_actions(actions, (self.num_envs, 2), "step: given")
        if self.config.num_cars > 1 and not self._over.any():
            if self._opponents is None:
                raise OutlapError("opponents: none given; step drives the first car only, advance all of them")
            everyone[:, 1:] = self._opponents.act()
        for car, action in self.taken_over.items():
            everyone[:, car] = action
        return everyone

    def _find_opponents(self, names: Sequence[Named]) -> list[Driver]:
        config = self.config
        if config.num_cars == 1:
            return []
        return find_drivers(names, config.field_of_view, config.opponent_split, config.opponent_code)

    def _clear_wrecks(self) -> None:
        """Do with opponents that crashed as configured, and count them."""
        simulator, contact = self.race.simulator, self.race.worlds.contact
        wrecks = (contact == HIT_WALL) | (contact == HIT_CAR)
        wrecks[:, EGO] = False
        self.wrecked[:] = wrecks[:, 1:] & ~self._down
        self._totals["opponent_crashes"] += self.wrecked.sum(axis=1)
        self._down[:] = contact[:, 1:] != FREE
        if self.config.opponent_crash != "park" and self._down.any():
            simulator.remove(wrecks)
            if self.config.opponent_crash == "respawn":
                simulator.respawn(RESPAWN_CLEARANCE)

    def _count(self, rewards: np.ndarray) -> None:
        """Add a step to what is told about each episode."""
        race, totals, worlds = self.race, self._totals, self.race.worlds
        totals["episode_return"] += rewards
        totals["episode_steps"] += 1
        totals["mean_speed_mps"] += (race.speed[:, EGO] - totals["mean_speed_mps"]) / totals["episode_steps"]
        totals["progress_m"][:] = race.distance[:, EGO] - race.start[:, EGO]
        # The mean of all laps so far: each new one moves it by its share.
        new = worlds.laps[:, EGO] > totals["completed_laps"]
        totals["completed_laps"][:] = worlds.laps[:, EGO]
        if new.any():
            before = np.nan_to_num(totals["lap_time_s"][new])
            totals["lap_time_s"][new] = before + (worlds.lap_time[new, EGO] - before) / worlds.laps[new, EGO]
        totals["overtakes"] += race.places_gained[:, EGO]
        totals["places_lost"] += race.places_lost[:, EGO]
        totals["impact_speed_mps"][:] = worlds.impact_speed[:, EGO]
        if self.config.num_cars > 1:
            self._clear_wrecks()

    def _task_names(self, which: np.ndarray) -> list[str]:
        """What tells the tasks of some worlds apart: the track, and the drivers of the opponents."""
        tracks = self._names[self.race.worlds.track[which]].tolist()
        if self._opponents is None:
            return tracks
        rivals = self._opponents.names()[which].tolist()
        return [f"{track} against {', '.join(sorted(names))}" for track, names in zip(tracks, rivals, strict=True)]

    def _info(self, outcome: np.ndarray | None = None) -> dict[str, Any]:
        """What is known of each world; a key's mask says for which."""
        worlds, opponents = self.race.worlds, self._opponents
        nobody = np.zeros((self.num_envs, self.config.num_cars - 1))
        info: dict[str, Any] = {
            "outcome": np.full(self.num_envs, RUNNING) if outcome is None else outcome,
            "track": self._names[worlds.track],
            "task": self._task.copy(),
            "vehicle": to_values(worlds.params).copy(),
            "contact": CONTACTS[worlds.contact[:, EGO]],
            "opponents": np.full(nobody.shape, "", object) if opponents is None else opponents.names(),
            "opponent_speed_mps": nobody if opponents is None else opponents.top_speed.copy(),
            "laps": worlds.laps[:, EGO].copy(),
            "last_lap_time_s": worlds.lap_time[:, EGO].copy(),
            "time_s": worlds.time.copy(),
            **{name: total.copy() for name, total in self._totals.items() if name in EPISODE_FIELDS},
            **{f"reward_{name}": self._totals[name].copy() for name in self._weights},
        }
        known = dict.fromkeys(info, np.ones(self.num_envs, bool))
        known["lap_time_s"] = known["last_lap_time_s"] = worlds.laps[:, EGO] > 0
        return {**info, **{f"_{name}": mask for name, mask in known.items()}}
