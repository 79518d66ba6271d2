"""`outlap train ppo`."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, arg

from outlap.cli.output import CommandResult
from outlap.cli.progress import progress_bar
from outlap.errors import OutlapError
from outlap.training.ppo import PPOConfig, Progress, train_ppo
from outlap.training.run import Run, load_run

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class TrainPPO:
    """Train a policy with PPO and domain randomization (the paper's Vanilla DR).

    Any vehicle, sensor or actuator parameter given as two numbers is drawn anew at each reset:
    --env.vehicle.mu 0.5 1.1. Without --env.tracks it trains on the built-in circuits.
    """

    settings: Annotated[PPOConfig, arg(name="")] = field(default_factory=PPOConfig)

    config: Path | None = None
    """YAML file with values in place of the defaults; flags override it."""

    out: Path | None = None
    """The run folder; by default a new one under runs/."""

    resume: Path | None = None
    """Continue this run, with its own configuration, from its newest checkpoint."""

    quiet: FlagCreatePairsOff[bool] = False
    """Show no progress."""

    json: str | None = None
    """Write the result as JSON to this file; - for standard output."""

    @classmethod
    def from_config(cls, path: Path) -> TrainPPO:
        """The defaults of `--config`."""
        from outlap.config import load_config

        return cls(settings=load_config(PPOConfig, path))

    def run(self) -> CommandResult:
        if self.resume and (self.out or self.config or self.settings != PPOConfig()):
            raise OutlapError("--resume goes on with the run's own configuration and folder; leave the other flags out")
        resumed = load_run(self.resume) if self.resume else None
        config = resumed.config if resumed else self.settings
        folder = resumed.folder if resumed else self.out or Path("runs") / time.strftime("ppo-%Y%m%d-%H%M%S")
        run = train_with_progress(config, folder, resumed, self.quiet)
        return training_result(run)


def train_with_progress(config: PPOConfig, folder: Path, resumed: Run | None, quiet: bool) -> Run:
    """Train with a progress bar; after Ctrl-C say how to go on."""
    # Numba's threads and torch's take turns: those that wait must not keep a core busy.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    with progress_bar("training", config.total_steps, "steps", quiet) as update:

        def on_progress(progress: Progress) -> None:
            note = ""
            if progress.crash_rate is not None:
                note = (
                    f"crashes {progress.crash_rate:.0%}  speed {progress.mean_speed_mps:.2f} m/s  "
                    f"progress {progress.progress_m:.0f} m"
                )
            update(progress.steps, note)

        try:
            return train_ppo(config, folder, resume=resumed, on_progress=on_progress)
        except KeyboardInterrupt:
            print(f"\nsaved; go on with: outlap train ppo --resume {folder}", file=sys.stderr)
            raise


def training_result(run: Run) -> CommandResult:
    """What `outlap train` prints and writes about a finished run."""
    record = run.record()
    data = {
        "run": run.folder,
        "policy": run.policy_path,
        "steps": record["steps"],
        "seconds": record["seconds"],
        "env_steps_per_second": record["steps_per_second"],
    }

    def show(console: Console) -> None:
        console.print(
            f"trained {data['steps']:,} steps in {data['seconds']} s ({data['env_steps_per_second']:,} steps/s)",
            highlight=False,
        )
        console.print(f"run folder: {run.folder}", highlight=False, soft_wrap=True)
        console.print(f"evaluate it: outlap evaluate {run.folder}", highlight=False, soft_wrap=True)

    return CommandResult(data, show)
