"""The device that networks are trained on."""

from __future__ import annotations

from outlap.errors import OutlapError, brief


def check_device(device: str) -> None:
    """Raises OutlapError for a device that PyTorch does not know, or that this machine does not have.

    Stable-Baselines3 takes the CPU then, and says nothing.
    """
    import torch

    if device == "auto":  # a GPU if there is one
        return
    try:
        torch.empty(1, device=device).cpu()
    except Exception as error:  # RuntimeError, AssertionError, NotImplementedError: that hangs on the device
        raise OutlapError(
            f"device is {device!r}: {brief(error)}; must be cpu, auto, or a device that PyTorch has here, such as cuda"
        ) from error
