"""Writing a trained policy as one ONNX file: scaling, history, networks and the meaning of actions in one graph.

The graph takes every observation term in its own units and a `state`, zeros at the begin, and gives the `command`
(steering angle [rad], speed [m/s]), the `action` in [-1, 1] and the `next_state`. The state is what the policy
remembers: the last action, and the context's window or the LSTM's memory.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import math
import os
import warnings
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn

from outlap.config import bounds
from outlap.deploy.car_driver import ACTION, COMMAND, FORMAT, METADATA, NEXT_STATE, STATE
from outlap.envs.observations import scale_of
from outlap.errors import OutlapError
from outlap.files import atomic_write
from outlap.mql.networks import PREVIOUS_REWARD
from outlap.mql.policies import MQLPolicy
from outlap.training.model_file import load_model

if TYPE_CHECKING:
    from outlap.deploy.car_driver import CarDriver
    from outlap.training.run import Run

PREVIOUS_ACTION = "previous_action"
ON_A_CAR = ("scan", "vel", "heading", PREVIOUS_ACTION, PREVIOUS_REWARD, "action_span")  # terms that need no map
TOLD_BY_THE_CAR = ("progress", "steering_change", "speed_change")  # rewards that a car can estimate,
NEVER_WHILE_DRIVING = ("collision", "stall", "overtake", "overtaken")  # and those of rare events, which it leaves out
OPSET = 18
LARGEST_DIFFERENCE = 1e-5  # of an action, between the file and the policy


def export_policy(run: Run, path: str | os.PathLike[str]) -> dict[str, Any]:
    """Write a run's policy as an ONNX file; gives what the file says about itself.

    Raises OutlapError for a policy whose observation a car does not have, or a package that is not installed.
    """
    try:
        import onnx
    except ImportError:
        raise OutlapError("onnx is not installed; pip install 'outlap[deploy]'") from None
    if run.config.env.command != "speed":
        raise OutlapError(f"{run.folder}: commands the {run.config.env.command}; a car takes speeds, train with speed")
    model = load_model(run.config, run.policy_path)
    observed = model.observation_space
    assert isinstance(observed, gym.spaces.Dict)
    reads_reward = not isinstance(model.policy, MQLPolicy) or model.policy.uses_reward
    space = gym.spaces.Dict({name: observed[name] for name in observed if reads_reward or name != PREVIOUS_REWARD})
    facts = describe(run, space)
    graph = Graph(_policy(model.policy), space, facts, run.config.env.scale_observations).eval()
    names = [name for name in facts["terms"] if name != PREVIOUS_ACTION]
    terms = tuple(torch.zeros(_shape(space[name])) for name in names)
    with _without_chatter():
        written = torch.onnx.export(
            graph, (torch.zeros(graph.state_size), *terms), dynamo=True, verbose=False, opset_version=OPSET,
            input_names=[STATE, *names], output_names=[COMMAND, ACTION, NEXT_STATE],
        )  # fmt: skip
    assert written is not None
    proto = written.model_proto
    onnx.helper.set_model_props(proto, {METADATA: json.dumps({**facts, "terms": names})})
    onnx.checker.check_model(proto)
    buffer = io.BytesIO()
    onnx.save_model(proto, buffer)
    atomic_write(Path(path), buffer.getvalue())
    return facts


@contextlib.contextmanager
def _without_chatter() -> Iterator[None]:
    """Without what PyTorch's exporter tells of packages that are not there."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)


def _shape(box: gym.Space) -> tuple[int, ...]:
    assert box.shape is not None
    return box.shape


def describe(run: Run, space: gym.spaces.Dict) -> dict[str, Any]:
    """What a driver needs to know about a policy beside its graph.

    Raises OutlapError for observation terms that need a map or other cars' places, and for rewards that do.
    """
    env = run.config.env
    terms = list(space.spaces)
    for name in terms:
        if name not in ON_A_CAR:
            raise OutlapError(
                f"{run.folder}: observes {name!r}, which a car cannot tell; train with --env.observation "
                f"{' '.join(term for term in ON_A_CAR if term != PREVIOUS_REWARD)}"
            )
    weights = env.reward.resolved()
    unknown = [name for name in weights if name not in (*TOLD_BY_THE_CAR, *NEVER_WHILE_DRIVING)]
    if PREVIOUS_REWARD in terms and unknown:
        raise OutlapError(
            f"{run.folder}: observes rewards for {unknown[0]}, which a car cannot tell; train with another reward, or "
            "without previous_reward (Meta-Q-Learning: with --no-uses-reward)"
        )
    vehicle = env.vehicle
    slowest, fastest = env.speed_range or (bounds(vehicle.v_min)[0], None)
    return {
        "format": FORMAT,
        "outlap": version("outlap"),
        "run": run.folder.resolve().name,
        "algorithm": run.config.algorithm,
        "terms": terms,
        "beams": _shape(space["scan"])[0] if "scan" in terms else 0,
        "field_of_view": env.field_of_view,
        "max_range": bounds(env.lidar.max_range)[1],
        "interval_s": env.control_interval * env.timestep,
        "speeds": [slowest, float(np.mean(bounds(vehicle.v_max))) if fastest is None else fastest],
        "steering": [float(np.mean(bounds(vehicle.steer_min))), float(np.mean(bounds(vehicle.steer_max)))],
        "reward": {name: weights[name] for name in TOLD_BY_THE_CAR if name in weights},
    }


class Graph(nn.Module):
    """Everything between what sensors say and what the car is to do."""

    def __init__(self, policy: Remembering, space: gym.spaces.Dict, facts: dict[str, Any], scaled: bool) -> None:
        super().__init__()
        self.policy = policy
        self.terms = list(space.spaces)
        self.names = [name for name in self.terms if name != PREVIOUS_ACTION]
        self.state_size = 2 + policy.memory_size
        self.scales = nn.ParameterDict()
        for name, box in space.spaces.items():
            (size,) = _shape(box)
            scale = scale_of(name, size).copy() if scaled else np.ones(size, np.float32)
            self.scales[name] = nn.Parameter(torch.from_numpy(scale), requires_grad=False)
        self.steering, self.speeds = facts["steering"], facts["speeds"]

    def forward(self, state: Tensor, *terms: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        raw = dict(zip(self.names, terms, strict=True))
        before = state[:2]
        if PREVIOUS_ACTION in self.terms:
            raw[PREVIOUS_ACTION] = before
        seen = {name: (raw[name] / self.scales[name]).unsqueeze(0) for name in self.terms}
        action, memory = self.policy(seen, before.unsqueeze(0), state[2:])
        action = action[0].clamp(-1.0, 1.0)
        steer, speed = action[0], action[1]
        lock = torch.where(steer >= 0.0, self.steering[1], -self.steering[0])
        low, high = self.speeds
        command = torch.stack([steer * lock, low + 0.5 * (speed + 1.0) * (high - low)])
        return command, action, torch.cat([action, memory])


class Remembering(nn.Module):
    """A policy as a function of what it sees, its last action and its memory."""

    memory_size = 0

    def forward(self, seen: dict[str, Tensor], before: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Actions (1, 2) and the memory (memory_size,) for the next step."""
        raise NotImplementedError


class FeedForward(Remembering):
    """PPO's."""

    def __init__(self, policy: Any) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, seen: dict[str, Tensor], before: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        features = self.policy.extract_features(seen, self.policy.pi_features_extractor)
        return self.policy.action_net(self.policy.mlp_extractor.forward_actor(features)), memory


class Recurrent(Remembering):
    """RecurrentPPO's: the memory is the LSTM's hidden state and its cell."""

    def __init__(self, policy: Any) -> None:
        super().__init__()
        self.policy = policy
        self.shape = (policy.lstm_actor.num_layers, 1, policy.lstm_actor.hidden_size)
        self.memory_size = 2 * policy.lstm_actor.num_layers * policy.lstm_actor.hidden_size

    def forward(self, seen: dict[str, Tensor], before: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        hidden, cell = memory.reshape(2, *self.shape).unbind()
        features = self.policy.extract_features(seen, self.policy.pi_features_extractor)
        out, (hidden, cell) = self.policy.lstm_actor(features.unsqueeze(0), (hidden.contiguous(), cell.contiguous()))
        latent = self.policy.mlp_extractor.forward_actor(out.squeeze(0))
        return self.policy.action_net(latent), torch.cat([hidden.flatten(), cell.flatten()])


class WithContext(Remembering):
    """Meta-Q-Learning's: the memory is the window that the context is made of, and which of its steps there were.

    A step is kept as the context reads it: what follows from stored numbers is computed once.
    """

    def __init__(self, policy: MQLPolicy) -> None:
        super().__init__()
        self.actor, self.encoder = policy.actor, policy.critic.encoder if policy.shares_encoder else None
        self.context = policy.context if policy.uses_context else None
        self.hidden = policy.context.hidden
        self.context_terms, self.uses_reward = policy.context_terms, policy.uses_reward
        self.rows, self.inputs = policy.history - 1, policy.context.inputs
        self.memory_size = self.rows * (self.inputs + 1) if policy.uses_context else 0

    def forward(self, seen: dict[str, Tensor], before: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        embedding = self.actor.encoder({name: seen[name] for name in self.actor.encoder.encoders})
        if self.context is None:
            return self.actor(embedding, embedding.new_zeros(1, self.hidden)), memory
        step = torch.cat(self._read(seen, before), -1)
        valid, window = memory[: self.rows], memory[self.rows :].reshape(self.rows, self.inputs)
        valid = torch.cat([valid, valid.new_ones(1)])
        window = torch.cat([window, step])
        kept = torch.cat([valid[1:], window[1:].flatten()])
        context = self.context(window.unsqueeze(1), valid.unsqueeze(1) > 0.0)
        return self.actor(embedding, context), kept

    def _read(self, seen: dict[str, Tensor], before: Tensor) -> list[Tensor]:
        """What the context reads of a step, as `MQLPolicy.steps` has it."""
        read = [before]
        if self.uses_reward:
            read.append(seen[PREVIOUS_REWARD])
        for name in self.context_terms:
            # The replay keeps scans in half precision, and so does the memory of `predict`.
            term = seen[name].half().float() if name == "scan" else seen[name]
            read.append(term if self.encoder is None else self.encoder.encoders[name](term))
        return read


def _policy(policy: Any) -> Remembering:
    if isinstance(policy, MQLPolicy):
        return WithContext(policy)
    return Recurrent(policy) if hasattr(policy, "lstm_actor") else FeedForward(policy)


def compare(
    run: Run, driver: CarDriver, steps: int = 1000, seed: int = 0, on_step: Callable[[int], None] | None = None
) -> tuple[float, float]:
    """How far an exported policy is from the run's own, while that one races in its training's environment.

    Args:
        run: whose policy it is.
        driver: of the exported file.
        steps: actions to compare.
        seed: of the race.
        on_step: called with the number of actions that are compared.

    Returns:
        The largest difference of an action (in [-1, 1]) and of a command ([rad] or [m/s]); NaN where either has one.
    """
    from outlap.envs.actions import commands
    from outlap.envs.race import EGO
    from outlap.envs.race_vector_env import RaceVectorEnv

    env = run.config.env
    own = run.driver()
    shown = {"observation": own.observation_terms, "scale_observations": False, "augment_tracks": False}
    race = RaceVectorEnv(1, env.model_copy(update=shown))
    observation, _ = race.reset(seed=seed)
    begins = np.ones(1, bool)
    of_action = of_command = 0.0
    for step in range(1, steps + 1):
        if begins[0]:
            driver.begin()
            own.begin(begins)
        command = driver.act({name: observation[name][0] for name in driver.terms})
        action = own.act(
            {name: _as_trained(name, value, env.scale_observations) for name, value in observation.items()}
        )
        action = np.clip(action, -1.0, 1.0)
        wanted = commands(action, race.race.worlds.params[:, EGO], race.race.speeds[:, EGO])
        # NumPy's maximum keeps a NaN, and Python's does not.
        of_action = float(np.maximum(of_action, np.abs(action[0] - driver.action).max()))
        of_command = float(np.maximum(of_command, np.abs(wanted[0] - command).max()))
        observation, _, terminated, truncated, _ = race.step(action)
        begins = terminated | truncated
        if on_step is not None:
            on_step(step)
    return of_action, of_command


def _as_trained(name: str, value: np.ndarray, scaled: bool) -> np.ndarray:
    return np.divide(value, scale_of(name, value.shape[1]), dtype=np.float32) if scaled else value


def export_and_compare(run: Run, path: Path, steps: int, on_step: Callable[[int], None]) -> dict[str, Any]:
    """Write a run's policy as an ONNX file, compare both, and return what the file says and how far they differ.

    Args:
        run: whose policy it is.
        path: of the file; removed again if it differs from the policy by more than `LARGEST_DIFFERENCE`.
        steps, on_step: see `compare`; called every 50 steps.

    Raises OutlapError for a file that differs, and what `export_policy` raises.
    """
    from outlap.deploy.car_driver import CarDriver

    facts = export_policy(run, path)
    of_action, of_command = compare(
        run, CarDriver(path), steps, on_step=lambda done: on_step(done) if done % 50 == 0 else None
    )
    if not of_action <= LARGEST_DIFFERENCE or math.isnan(of_command):  # NaN is not either
        path.unlink()
        raise OutlapError(
            f"{run.folder}: the file differs from the policy by {of_action:.2g} in its actions and "
            f"{of_command:.2g} in its commands; please report this"
        )
    return {"largest_action_difference": of_action, "largest_command_difference": of_command, **facts}
