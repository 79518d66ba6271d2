"""RaceParallelEnv: one race as a PettingZoo `ParallelEnv`, every car an agent. Needs the extra `multiagent`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from pettingzoo import ParallelEnv  # pyright: ignore[reportMissingTypeStubs]

from outlap.envs.actions import check_actions
from outlap.envs.episodes import CONTACTS
from outlap.envs.race import RUNNING
from outlap.envs.race_config import RaceConfig
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.envs.terminations import CRASH
from outlap.errors import OutlapError
from outlap.track.track import Track


class RaceParallelEnv(ParallelEnv[str, dict[str, np.ndarray], np.ndarray]):
    """One race whose cars, `car_0`, `car_1`, …, are all driven by the caller.

    Observations, actions and rewards are for every agent what `RaceVectorEnv` has for its first car. An agent leaves
    `agents` when its race ends: terminated by a crash, truncated otherwise. Its car then leaves the track, but for a
    wreck with `opponent_crash="park"` (the default), which stays where it is.
    """

    metadata: dict[str, Any] = {"name": "outlap_race_v0", "render_modes": []}  # noqa: RUF012  # as PettingZoo has it

    def __init__(self, config: RaceConfig, tracks: Sequence[Track] | None = None) -> None:
        """Build a race. `envs.keywords.make_parallel` builds it from keywords.

        Args:
            config: the race of `num_cars` agents; its opponents are not used.
            tracks: to race on instead of those that `config.tracks` names.

        Raises OutlapError as `RaceVectorEnv` does, and for wrecks that respawn.
        """
        if config.opponent_crash == "respawn":
            raise OutlapError("opponent_crash is 'respawn'; must be park or remove: an agent that crashed is out")
        self._env = RaceVectorEnv(1, config, tracks, (), autoreset_mode=AutoresetMode.DISABLED)
        self.config = config
        self.render_mode = None
        self.possible_agents = [f"car_{i}" for i in range(config.num_cars)]
        self.agents: list[str] = []
        self._cars = {agent: car for car, agent in enumerate(self.possible_agents)}

    def observation_space(self, agent: str) -> gym.Space[Any]:
        """The same for every agent."""
        return self._env.single_observation_space

    def action_space(self, agent: str) -> gym.Space[Any]:
        """The same for every agent: (2,) in [-1, 1], steering and speed."""
        return self._env.single_action_space

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, dict[str, np.ndarray]], dict[str, dict[str, Any]]]:
        """Begin a race; a seed restarts the stream of races."""
        self._env.reset(seed=seed)
        self.agents = list(self.possible_agents)
        return self._observe(), {agent: self._info(agent) for agent in self.agents}

    def step(
        self, actions: dict[str, np.ndarray]
    ) -> tuple[
        dict[str, dict[str, np.ndarray]],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Carry out an action (2,) of every agent that still races.

        Raises OutlapError for an agent without an action, and one that is not (2,) finite numbers.
        """
        env, racing = self._env, self.agents
        env.advance(self._all_actions(actions))
        outcomes = {agent: str(env.race.outcome[0, self._cars[agent]]) for agent in racing}
        rewards = {agent: float(env.race.rewards[0, self._cars[agent]]) for agent in racing}
        observations = self._observe()
        infos = {agent: self._info(agent) for agent in racing}
        crashed = {agent: outcome == CRASH for agent, outcome in outcomes.items()}
        stopped = {agent: outcome not in (RUNNING, CRASH) for agent, outcome in outcomes.items()}
        gone = np.zeros((1, self.config.num_cars), bool)
        for agent in racing:
            gone[0, self._cars[agent]] = stopped[agent] or (crashed[agent] and self.config.opponent_crash == "remove")
        env.race.simulator.remove(gone)
        self.agents = [agent for agent in racing if outcomes[agent] == RUNNING]
        return observations, rewards, crashed, stopped, infos

    def _all_actions(self, actions: dict[str, np.ndarray]) -> np.ndarray:
        everyone = np.zeros((1, self.config.num_cars, 2), np.float32)
        for agent in self.agents:
            if agent not in actions:
                raise OutlapError(f"actions: none for {agent}; must have one for each of {', '.join(self.agents)}")
            everyone[0, self._cars[agent]] = check_actions(actions[agent], (2,), f"{agent}: given")
        return everyone

    def _observe(self) -> dict[str, dict[str, np.ndarray]]:
        return {
            agent: {name: value[0] for name, value in self._env.observe(self._cars[agent]).items()}
            for agent in self.agents
        }

    def _info(self, agent: str) -> dict[str, Any]:
        """Of a car: how its race ended, what it hit, laps and places so far."""
        race, car = self._env.race, self._cars[agent]
        return {
            "outcome": str(race.outcome[0, car]),
            "contact": CONTACTS[race.worlds.contact[0, car]],
            "impact_speed_mps": float(race.worlds.impact_speed[0, car]),
            "progress_m": float(race.distance[0, car] - race.start[0, car]),
            "laps": int(race.worlds.laps[0, car]),
            "place": 1 + int((race.distance[0] > race.distance[0, car]).sum()),
            "places_gained": int(race.places_gained[0, car]),
            "places_lost": int(race.places_lost[0, car]),
            "track": race.simulator.tracks[int(race.worlds.track[0])].name,
        }
