"""The device of a training: one that is not there is told of, and not replaced."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from outlap.errors import OutlapError
from outlap.training.config import check_device
from outlap.training.ppo import PPOConfig
from outlap.training.session import train


@pytest.mark.parametrize("device", ["cpu", "cpu:0", "auto"])
def test_devices_that_are_there_are_taken(device: str) -> None:
    check_device(device)


@pytest.mark.parametrize("device", ["nope", "", "meta", "cuda:99"])
def test_others_are_told_of(device: str) -> None:
    with pytest.raises(OutlapError, match=rf"device is '{device}': .*; must be cpu, auto, or a device"):
        check_device(device)


@pytest.mark.skipif(torch.cuda.is_available(), reason="of machines without a GPU")
def test_a_training_for_a_gpu_that_is_not_there_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(OutlapError, match="device is 'cuda'"):
        train(PPOConfig(device="cuda"), tmp_path / "run")
    assert not (tmp_path / "run").exists()
