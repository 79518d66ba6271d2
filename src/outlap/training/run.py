"""A run folder: everything that is needed to repeat, resume and use a training.

config.yaml      the configuration
run.json         command, seed, versions, machine, how far it came
checkpoints/     step_N.zip, the newest few, and step_N.npz, the replay of the newest
policy.zip       the finished policy
replay.npz       what an off-policy learner has seen, the newest of it
tensorboard/
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from outlap.config import read_yaml, save_config, validate
from outlap.errors import OutlapError
from outlap.files import atomic_write, to_json
from outlap.provenance import provenance
from outlap.track.catalog import name_key
from outlap.track.generate import BUILTIN_TRAIN
from outlap.training.config import TrainingConfig, check_device
from outlap.training.model_file import load_model
from outlap.training.mql import MQLConfig
from outlap.training.ppo import PPOConfig, RecurrentPPOConfig

if TYPE_CHECKING:
    from outlap.drivers.policy import PolicyDriver
    from outlap.mql.mql import MQL

log = logging.getLogger(__name__)

ALGORITHMS: dict[str, type[TrainingConfig]] = {"ppo": PPOConfig, "recurrent-ppo": RecurrentPPOConfig, "mql": MQLConfig}
"""The algorithms of `outlap train`, by the name in their configuration."""


@dataclass(frozen=True)
class Run:
    """A run folder that exists."""

    folder: Path
    config: TrainingConfig

    @property
    def method(self) -> str:
        """What its configuration says but for the seed and the machine: the same for all seeds of one method."""
        content = self.config.model_dump(mode="json")
        return to_json({name: value for name, value in content.items() if name not in ("seed", "threads", "device")})

    @property
    def policy_path(self) -> Path:
        """The finished policy, or else the newest checkpoint. Raises OutlapError where there is neither."""
        for path in (self.folder / "policy.zip", *self.checkpoints()):
            if zipfile.is_zipfile(path):
                return path
            if path.exists():
                log.warning("%s: is broken; the checkpoint before it is taken", path)
        command = f"outlap train {self.config.algorithm} --resume {self.folder}"
        raise OutlapError(f"{self.folder}: holds no policy yet; train it with: {command}")

    @property
    def replay_path(self) -> Path:
        """The replay of the finished policy, or else of the newest checkpoint, for a learner that has one."""
        finished = self.folder / "replay.npz"
        return finished if finished.exists() else max(self.replays(), key=_steps_of, default=finished)

    def driver(self, *, deterministic: bool = True, seed: int = 0) -> PolicyDriver:
        """The policy as a driver."""
        from outlap.drivers.policy import PolicyDriver

        env = self.config.env
        return PolicyDriver(
            load_model(self.config, self.policy_path),
            scale_observations=env.scale_observations,
            deterministic=deterministic,
            seed=seed,
            name=self.folder.resolve().name,
            speeds=env.commanded_speeds,
            reward=env.reward,
        )

    def policy_record(self) -> dict[str, Any]:
        """Return which policy a result is of: the run, the file and its SHA-256."""
        path = self.policy_path
        return {
            "run": self.folder.resolve(),
            "policy": path.relative_to(self.folder),
            "policy_sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        }

    def trained_on(self, tracks: Sequence[str]) -> list[str]:
        """Return the names of tracks that the run was trained on, of those given."""
        trained = {name_key(Path(name).name) for name in self.config.env.tracks or BUILTIN_TRAIN}
        return [name for name in tracks if name_key(name) in trained]

    def checkpoints(self) -> list[Path]:
        """Checkpoints, newest first."""
        return sorted(self._of_checkpoints(".zip"), key=_steps_of, reverse=True)

    def replays(self) -> list[Path]:
        """Replays of checkpoints: the newest one's, and another while it is written."""
        return self._of_checkpoints(".npz")

    def _of_checkpoints(self, suffix: str) -> list[Path]:
        found = (self.folder / "checkpoints").glob(f"step_*{suffix}")
        return [path for path in found if re.fullmatch(r"step_\d+", path.stem)]

    @property
    def finished(self) -> bool:
        """Whether the training came to its end."""
        return bool(self.record().get("finished"))

    def note_pace(self, steps: int, seconds: float, **facts: Any) -> None:
        """Note in run.json how far the training is, and how long all its sessions together took so far."""
        self.write_record(
            steps=steps, seconds=round(seconds, 2), steps_per_second=round(steps / max(seconds, 1e-9)), **facts
        )

    def record(self) -> dict[str, Any]:
        """What run.json says."""
        path = self.folder / "run.json"
        return json.loads(path.read_text()) if path.exists() else {}

    def write_record(self, **facts: Any) -> None:
        """Add facts to run.json."""
        atomic_write(self.folder / "run.json", to_json({**self.record(), **facts}) + "\n")


def create_run(folder: Path, config: TrainingConfig) -> Run:
    """Make a run folder. Raises OutlapError if there is one already, or it cannot be written."""
    if (folder / "config.yaml").exists():
        raise OutlapError(f"{folder}: holds a run already; resume it with --resume {folder}, or give another --out")
    run = Run(folder, config)
    try:
        (folder / "checkpoints").mkdir(parents=True, exist_ok=True)
        run.write_record(**provenance(), seed=config.seed, finished=False)
        save_config(config, folder / "config.yaml")  # the last: what has it is a whole run
    except OSError as error:
        raise OutlapError(f"{folder}: cannot be written: {error.strerror}; give another --out") from None
    return run


def is_run(folder: str | os.PathLike[str]) -> bool:
    """Return whether a folder holds a run."""
    return (Path(folder) / "config.yaml").is_file()


def load_run(folder: str | os.PathLike[str]) -> Run:
    """A run folder made by `outlap train`. Raises OutlapError where it is missing or broken."""
    folder = Path(folder)
    if not is_run(folder):
        raise OutlapError(f"{folder}: is not a run folder, it has no config.yaml; make one with outlap train")
    path = folder / "config.yaml"
    content = read_yaml(path)
    return Run(folder, validate(_config_class(content, path), content, str(path)))


def load_driver(folder: str | os.PathLike[str]) -> PolicyDriver:
    """Return the policy of a run folder as a driver: the entry point `run` of `outlap.driver_loaders`."""
    return load_run(folder).driver()


def load_meta(run: Run) -> MQL:
    """Load a meta-trained policy with its replay buffer, on the device of its training, or on the CPU without that.

    Raises OutlapError for a run of another algorithm, and for broken files.
    """
    if run.config.algorithm != "mql":
        raise OutlapError(f"{run.folder}: was trained with {run.config.algorithm}; must be one of outlap train mql")
    device = run.config.device
    try:
        check_device(device)
    except OutlapError:
        log.warning("%s: was trained on device %s, which is not available; continuing on the CPU", run.folder, device)
        device = "cpu"
    meta: Any = load_model(run.config, run.policy_path, device=device)
    meta.load_replay_buffer(run.replay_path)
    return meta


def _config_class(content: Any, path: Path) -> type[TrainingConfig]:
    """Return the configuration class of the algorithm that a file's content names; PPO's if it names none."""
    name = content.get("algorithm", "ppo") if isinstance(content, Mapping) else "ppo"
    if name not in ALGORITHMS:
        raise OutlapError(f"{path}: algorithm is {name!r:.60}; must be one of {', '.join(ALGORITHMS)}")
    return ALGORITHMS[name]


def _steps_of(checkpoint: Path) -> int:
    return int(checkpoint.stem.removeprefix("step_"))
