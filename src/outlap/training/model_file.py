"""Models as Stable-Baselines3 writes them, read without running code of the file.

Such a zip holds weights, which PyTorch reads as numbers only, and the model's attributes. Those that a configuration
says are taken from there, and functions and classes with them. What is left is data: counters, the spaces, the
statistics of recent episodes. A pickle of anything else is refused.
"""

from __future__ import annotations

import base64
import io
import json
import os
import pickle
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from outlap.errors import OutlapError, brief

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

    from outlap.envs.sb3_vec_env import SB3VecEnv
    from outlap.training.config import TrainingConfig

PICKLED = ("observation_space", "action_space", "ep_info_buffer", "ep_success_buffer")  # attributes that are read
LARGEST = 2**31  # [bytes] of all that a file holds
DATA = {
    "collections": {"deque", "OrderedDict"},
    "gymnasium.spaces.box": {"Box"},
    "gymnasium.spaces.dict": {"Dict"},
    "numpy": {"dtype", "ndarray"},
    "numpy._core.multiarray": {"_reconstruct", "scalar"},
    "numpy._core.numeric": {"_frombuffer"},
    "numpy.random._pcg64": {"PCG64"},
    "numpy.random._pickle": {"__bit_generator_ctor", "__generator_ctor"},
    "numpy.random.bit_generator": {"SeedSequence", "__pyx_unpickle_SeedSequence"},
}  # what may be in a pickle, by module: nothing that runs what it is given


def load_model(
    config: TrainingConfig, path: str | os.PathLike[str], environment: SB3VecEnv | None = None, device: str = "cpu"
) -> BaseAlgorithm:
    """A model that was trained with a configuration.

    Args:
        config: the training's.
        path: of the zip.
        environment: to go on training in; none, to drive only.
        device: of its networks.

    Raises OutlapError for a file that is missing, broken, too large, of another algorithm or other networks, or that
    holds code in place of data.
    """
    if not Path(path).is_file():
        raise OutlapError(f"{path}: no such file; must be a policy that outlap train wrote")
    algorithm = config.model_class()
    try:
        taken = {"policy_class": config.policy_class(), "policy_kwargs": config.network()}
        taken |= config.constants()
        with zipfile.ZipFile(path) as file:
            size = sum(each.file_size for each in file.infolist())
            if size > LARGEST:
                raise ValueError(f"it holds {size:,} bytes, more than {LARGEST:,}")
            attributes = json.loads(file.read("data"))
        for name, value in attributes.items():
            if name not in taken and isinstance(value, dict) and ":serialized:" in value:
                taken[name] = _read(value[":serialized:"]) if name in PICKLED else None
        return algorithm.load(Path(path), env=environment, device=device, custom_objects=taken)
    except Exception as error:  # whatever a broken archive or pickle raises
        raise OutlapError(f"{path}: cannot be loaded as a {algorithm.__name__} model: {brief(error)}") from error


class _DataUnpickler(pickle.Unpickler):
    """Unpickler restricted to an allow-list of data types."""

    def find_class(self, module: str, name: str) -> Any:
        if name not in DATA.get(module, ()):
            raise pickle.UnpicklingError(f"{module}.{name} is code, and no data")
        return super().find_class(module, name)


def _read(text: str) -> Any:
    return _DataUnpickler(io.BytesIO(base64.b64decode(text))).load()
