"""A training that is stopped on its way."""

from __future__ import annotations

from pathlib import Path

import pytest

from outlap.training.config import TrainingConfig
from outlap.training.session import Progress, train


def stopped_after(steps: int, config: TrainingConfig, folder: Path) -> None:
    """Train as Ctrl-C would end it, after so many actions."""

    def stop(progress: Progress) -> None:
        if progress.steps >= steps:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(config, folder, on_progress=stop)
