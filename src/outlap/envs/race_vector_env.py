"""RaceVectorEnv: the one implementation of the environment, for any number of worlds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from outlap.config import bounds
from outlap.drivers.driver import Driver
from outlap.drivers.find import find_drivers
from outlap.envs.actions import check_actions, commands, speed_spans
from outlap.envs.car_sets import CarSet, find_cars
from outlap.envs.episode_seeds import EpisodeSeeds
from outlap.envs.episodes import Episodes, final_info
from outlap.envs.observations import observation_space, observe
from outlap.envs.opponents import Opponents
from outlap.envs.race import EGO, RUNNING, Race
from outlap.envs.race_config import RaceConfig
from outlap.envs.racing_line import ReferenceSpeeds, racing_lines
from outlap.envs.rewards import CURRICULA, CURRICULUM_END, curriculum_scales, scaled_terms, weighted_terms
from outlap.envs.road import draw_road
from outlap.envs.starts import reset_worlds
from outlap.envs.tasks import TaskSet
from outlap.envs.terminations import outcomes
from outlap.envs.wrecks import Wrecks
from outlap.errors import OutlapError
from outlap.planning.limits import CarLimits
from outlap.simulator.simulator import Simulator
from outlap.simulator.vehicle import to_records
from outlap.track.catalog import load_tracks
from outlap.track.generate import BUILTIN_TRAIN
from outlap.track.track import Track

OFFERED_MODES = (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED)


class RaceVectorEnv(VectorEnv[dict[str, np.ndarray], np.ndarray, np.ndarray]):
    """F1TENTH races in many worlds at once; the learner drives the first car of each.

    Observation: a Dict of the terms in `config.observation`, (worlds, size) float32.
    Action: (worlds, 2) in [-1, 1], steering (left positive) and speed; larger values are clipped.
    An episode `terminated` when the ego crashed and is `truncated` otherwise; `info["outcome"]` says how.
    After the step that ends an episode the world is reset at once (AutoresetMode.SAME_STEP); what the
    episode's last observation was stands in `info["final_obs"]`, its summary in `info["final_info"]`.
    """

    single_observation_space: gym.Space[Any]
    single_action_space: gym.Space[Any]

    def __init__(
        self,
        num_envs: int,
        config: RaceConfig,
        tracks: Sequence[Track] | None = None,
        opponents: Sequence[Driver] | None = None,
        cars: CarSet | None = None,
        *,
        autoreset_mode: AutoresetMode = AutoresetMode.SAME_STEP,
    ) -> None:
        """Build `num_envs` worlds. `envs.keywords.make_race_vector` builds them from keywords.

        Args:
            num_envs: worlds.
            config: the race.
            tracks: to race on instead of those that `config.tracks` names.
            opponents: to draw from instead of those that `config.opponents` names. Without any, the caller drives all
                cars with `advance`.
            cars: to draw from instead of the set that `config.cars` names.
            autoreset_mode: SAME_STEP, or DISABLED for a caller that resets by `reset_mask`.

        Raises OutlapError for a wrong number of worlds, a mode that is not offered, and a track or an opponent that
        cannot be loaded.
        """
        if not isinstance(num_envs, (int, np.integer)) or num_envs < 1:  # pyright: ignore[reportUnnecessaryIsInstance]
            raise OutlapError(f"num_envs is {num_envs!r}; it must be a whole number, at least 1")
        if autoreset_mode not in OFFERED_MODES:
            raise OutlapError(f"autoreset_mode is {autoreset_mode!r}; SAME_STEP and DISABLED are offered")
        self.num_envs = num_envs
        self.config = config
        self.autoreset_mode = autoreset_mode
        self.render_mode = None
        loaded = load_tracks(config.tracks or BUILTIN_TRAIN if tracks is None else tracks, config.augment_tracks)
        drivers: Sequence[Driver] = ()
        if config.num_cars > 1:
            drivers = _drivers(config) if opponents is None else opponents
        if cars is None and config.cars:
            cars = find_cars(config.cars)
        self.tasks = TaskSet(loaded, config.vehicle, config.actuators, config.lidar, config.sensors, cars)
        self._weights = config.reward.resolved()
        self.race = _build_race(num_envs, config, self.tasks, drivers)
        self.opponents = Opponents(drivers, self.race, config.opponent_speed, config.opponent_noise)
        self.taken_over: dict[int, np.ndarray] = {}  # actions (2,) of cars that are driven in place of their drivers
        self.reward_terms: dict[int, dict[str, np.ndarray]] = {}  # weighted and scaled, of the last step, by car
        self._curriculum_terms = np.zeros((num_envs, len(CURRICULA)))
        # The cars without a driver: the caller drives them, and they have outcomes and rewards.
        self._learners = range(1 if drivers else config.num_cars)
        self._seeds = EpisodeSeeds(num_envs)
        self._episodes = Episodes(self.race, self.opponents, self._weights)
        self._wrecks = Wrecks(self.race, config.opponent_crash)
        self._over = np.ones(num_envs, bool)  # waits for a reset
        interval = config.control_interval * config.timestep
        self.metadata = {"autoreset_mode": autoreset_mode, "render_modes": [], "render_fps": round(1 / interval)}
        self.single_observation_space = observation_space(
            config.observation, config.beams, bounds(config.lidar.max_range)[1], config.nearby_cars,
            config.scale_observations,
        )  # fmt: skip
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    @property
    def training_progress(self) -> float:
        """Share of the training that is done, 0 … 1: where reward curricula stand. 1 unless a training sets it."""
        return self.race.training_progress

    @training_progress.setter
    def training_progress(self, progress: float) -> None:
        if not 0.0 <= progress <= CURRICULUM_END:
            raise OutlapError(f"training_progress is {progress!r}; must be the share of training done, 0 to 1")
        self.race.training_progress = float(progress)

    @property
    def curriculum_terms(self) -> np.ndarray:
        """The ego's weighted terms of `CURRICULA` in the last step, unscaled, 0 if unused: (worlds, terms)."""
        return self._curriculum_terms.copy()

    @property
    def curriculum_scales(self) -> np.ndarray:
        """What these terms are multiplied with at present: (terms,)."""
        return curriculum_scales(self.race.training_progress, self.config.reward)

    @property
    def wrecked(self) -> np.ndarray:
        """The opponents that crashed in the last step: bool (worlds, cars - 1)."""
        return self._wrecks.new

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode in every world, or in those of `options["reset_mask"]`, bool (worlds,).

        A seed of one number gives world i the seed + i. Without a seed the worlds go on with their streams,
        so that every episode differs. `options["cars"]`, int (worlds,), gives the egos cars of the list `config.cars`.
        """
        mask = None if options is None else options.get("reset_mask")
        mask = np.ones(self.num_envs, bool) if mask is None else np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise OutlapError(f"reset_mask is {mask.dtype} {mask.shape}; it must be bool ({self.num_envs},)")
        which = np.flatnonzero(mask)
        if seed is not None:
            first = self._seeds.seed(seed, which)
            self._np_random_seed = -1 if first is None else first
            self._np_random = np.random.default_rng(first)
        egos = None if options is None else options.get("cars")
        self._begin(which, None if egos is None else np.asarray(egos)[which])
        return self.observe(EGO), self._episodes.info(np.full(self.num_envs, RUNNING))

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Carry out one action (worlds, 2) a world for `control_interval` physics steps.

        Raises OutlapError for actions of a wrong shape, not finite, or before a reset.
        """
        self.advance(self._all_actions(actions))
        self._wrecks.update()
        self._episodes.update(self.reward_terms[EGO], self.wrecked.sum(axis=1))
        outcome, rewards = self.race.outcome[:, EGO].copy(), self.race.rewards[:, EGO].copy()
        terminated = self.race.crashed[:, EGO].copy()
        truncated = ~terminated & (outcome != RUNNING)
        info = self._episodes.info(outcome)
        over = terminated | truncated
        self._over = over.copy()  # which the next reset changes
        if over.any() and self.autoreset_mode == AutoresetMode.SAME_STEP:
            info = self._begin_again(over, info)
        return self.observe(EGO), rewards, terminated, truncated, info

    def advance(self, actions: np.ndarray) -> None:
        """Carry out an action (worlds, cars, 2) of every car; outcomes and rewards are in `race` afterwards.

        Raises OutlapError before a reset.
        """
        if self._over.any():
            raise OutlapError(f"world {np.argmax(self._over)}: its episode is over or never began; call reset first")
        race, config = self.race, self.config
        race.act(actions)
        race.simulator.step(
            commands(race.actions, race.worlds.params, race.speeds, config.command), config.control_interval
        )
        race.advance(config.termination.stall_distance)
        for car in self._learners:
            race.outcome[:, car] = outcomes(race, car, config.termination)
            self._reward(car)

    def observe(self, car: int) -> dict[str, np.ndarray]:
        """Return the observation of a car: (worlds, size) of every term, float32."""
        return observe(self.race, car, self.config.observation, self.config.scale_observations)

    def _reward(self, car: int) -> None:
        """Note the reward of a car for the last step, at present and as it is when the training ends."""
        race, config = self.race, self.config.reward
        terms = weighted_terms(race, car, config, self._weights)
        self.reward_terms[car] = scaled_terms(terms, race.training_progress, config)
        race.rewards[:, car] = sum(self.reward_terms[car].values())
        race.final_rewards[:, car] = sum(scaled_terms(terms, CURRICULUM_END, config).values())
        if car == EGO:
            for column, name in enumerate(CURRICULA):
                self._curriculum_terms[:, column] = terms.get(name, 0.0)

    def close_extras(self, **kwargs: Any) -> None:
        """Nothing is open."""

    def _begin(self, which: np.ndarray, egos: np.ndarray | None = None) -> None:
        """Draw a task and a start for some worlds, and reset them; `egos` are numbers of their first cars, (n,)."""
        keys, episodes = self._seeds.next_episodes(which)
        tracks, params, cars = self.tasks.draw(keys, episodes, self.config.num_cars, egos)
        self.race.speeds[which] = speed_spans(params, self.config.speed_range)
        if self.opponents.drivers:
            self.race.speeds[which, 1:] = self.opponents.draw(which, keys, episodes, params[:, 1:])
        road = draw_road(self.config.road, keys, episodes, self.race.track_lengths(tracks))
        reset_worlds(self.config.start, self.race.simulator, which, keys, episodes, tracks, params, road)
        self.race.begin(which, cars)
        self._wrecks.begin(which)
        self._episodes.begin(which)
        self._over[which] = False

    def _begin_again(self, over: np.ndarray, info: dict[str, Any]) -> dict[str, Any]:
        """Begin an episode in the worlds whose episode is over, bool (worlds,): the info of the new episodes.

        Args:
            over: these worlds.
            info: of the step that ended their episodes.
        """
        final, which = self.observe(EGO), np.flatnonzero(over)
        self._begin(which)
        final_obs = np.full(self.num_envs, None, dtype=object)
        for world in which:
            final_obs[world] = {name: value[world] for name, value in final.items()}
        return {
            **self._episodes.info(np.full(self.num_envs, RUNNING)),
            "final_obs": final_obs,
            "_final_obs": over,
            "final_info": final_info(info, over),
            "_final_info": over,
        }

    def _all_actions(self, actions: np.ndarray) -> np.ndarray:
        """The ego's actions, checked and clipped, with those of the opponents: (worlds, cars, 2)."""
        everyone = np.empty((self.num_envs, self.config.num_cars, 2), np.float32)
        everyone[:, EGO] = check_actions(actions, (self.num_envs, 2), "step: given")
        if self.config.num_cars > 1 and not self._over.any():
            if not self.opponents.drivers:
                raise OutlapError("opponents: none given; step drives the first car only, advance all of them")
            everyone[:, 1:] = self.opponents.act()
        for car, action in self.taken_over.items():
            everyone[:, car] = action
        return everyone


def _drivers(config: RaceConfig) -> list[Driver]:
    return find_drivers(config.opponents, config.field_of_view, config.opponent_split, config.opponent_code)


def _build_race(num_envs: int, config: RaceConfig, tasks: TaskSet, drivers: Sequence[Driver]) -> Race:
    """The race, with the lines that its observations and rewards need."""
    simulator = Simulator(
        tasks.tracks, num_envs, config.num_cars, config, tasks.max_delay, tasks.max_latency, config.road.bins
    )
    typical = CarLimits.of_record(to_records(np.mean(tasks.bounds, axis=0)), config.model)
    terms = {*config.observation, *(term for driver in drivers for term in driver.observation_terms)}
    choice = config.racing_line if "line_ahead" in terms else "track"
    line = racing_lines(tasks.tracks, simulator.atlas, typical, choice)
    reference = None
    if "velocity_matching" in config.reward.resolved():
        reference = ReferenceSpeeds(tasks.tracks, simulator.atlas, typical, config.model, num_envs, config.num_cars)
    return Race(simulator, config.nearby_cars, line, reference)
