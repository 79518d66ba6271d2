"""`outlap train ppo | recurrent-ppo | mql`."""

from __future__ import annotations

import shlex
import sys
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self, get_type_hints

from pydantic.dataclasses import dataclass
from tyro.conf import arg

from outlap.cli.command import LongCommand
from outlap.cli.output import NOTHING_KEPT, CommandResult, dated_folder, lines
from outlap.cli.progress import progress_bar
from outlap.config import load_config
from outlap.errors import OutlapError
from outlap.training.config import TrainingConfig
from outlap.training.mql import MQLConfig
from outlap.training.ppo import PPOConfig, RecurrentPPOConfig
from outlap.training.run import Run, load_run

if TYPE_CHECKING:
    from outlap.training.callback import Progress


@dataclass(frozen=True)
class _Train(LongCommand):
    """What the trainings of all algorithms have in common; each says what its `settings` are."""

    settings: TrainingConfig

    config: Path | None = None
    """YAML file with values in place of the defaults; flags override it."""

    out: Path | None = None
    """The run folder; by default a new one under runs/."""

    resume: Path | None = None
    """Continue this run, with its own configuration, from its newest checkpoint."""

    @classmethod
    def from_config(cls, path: Path) -> Self:
        """The defaults of `--config`."""
        settings_class: type[TrainingConfig] = get_type_hints(cls)["settings"]
        return cls(settings=load_config(settings_class, path))

    def run(self) -> CommandResult:
        settings, name = self.settings, self.settings.algorithm
        if self.resume and (self.out or self.config or settings != type(settings).model_validate({})):
            raise OutlapError("--resume goes on with the run's own configuration and folder; leave the other flags out")
        resumed = load_run(self.resume) if self.resume else None
        if resumed and resumed.config.algorithm != name:
            raise OutlapError(f"--resume {self.resume}: was trained with {resumed.config.algorithm}, not {name}")
        config = resumed.config if resumed else settings
        folder = resumed.folder if resumed else self.out or dated_folder(Path("runs"), f"{name}-")
        run = train_with_progress(config, folder, resumed, self.quiet)
        return training_result(run)


@dataclass(frozen=True)
class TrainPPO(_Train):
    """Train a policy with PPO and domain randomization (the paper's Vanilla DR).

    Any vehicle, sensor or actuator parameter given as two numbers is drawn anew at each reset:
    --env.vehicle.mu 0.5 1.1. Without --env.tracks it trains on the built-in circuits.
    """

    settings: Annotated[PPOConfig, arg(name="")] = field(default_factory=PPOConfig)


@dataclass(frozen=True)
class TrainRecurrentPPO(_Train):
    """Train a policy with RecurrentPPO: PPO with an LSTM, and domain randomization.

    Any vehicle, sensor or actuator parameter given as two numbers is drawn anew at each reset:
    --env.vehicle.mu 0.5 1.1. Without --env.tracks it trains on the built-in circuits.
    """

    settings: Annotated[RecurrentPPOConfig, arg(name="")] = field(default_factory=RecurrentPPOConfig)


@dataclass(frozen=True)
class TrainMQL(_Train):
    """Meta-train a policy with Meta-Q-Learning: TD3 with a context of the last steps.

    Any vehicle, sensor or actuator parameter given as two numbers is drawn anew at each reset:
    --env.vehicle.mu 0.5 1.1. Without --env.tracks it trains on the built-in circuits.
    """

    settings: Annotated[MQLConfig, arg(name="")] = field(default_factory=MQLConfig)


def train_with_progress(config: TrainingConfig, folder: Path, resumed: Run | None, quiet: bool) -> Run:
    """Train with a progress bar; after Ctrl-C say how to go on."""
    from outlap.training.session import train

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
            return train(config, folder, resume=resumed, on_progress=on_progress)
        except KeyboardInterrupt:
            again = f"outlap train {config.algorithm} --resume {shlex.quote(str(folder))}"
            begun = (folder / "config.yaml").is_file()
            print(f"\nsaved; go on with: {again}" if begun else f"\n{NOTHING_KEPT}", file=sys.stderr)
            raise


def training_result(run: Run) -> CommandResult:
    """What `outlap train` prints and writes about a finished run."""
    record = run.record()
    data = {
        "run": run.folder, "policy": run.policy_path, "steps": record["steps"], "seconds": record["seconds"],
        "env_steps_per_second": record["steps_per_second"],
    }  # fmt: skip
    show = lines(
        f"trained {data['steps']:,} steps in {data['seconds']} s ({data['env_steps_per_second']:,} steps/s)",
        f"run folder: {run.folder}",
        f"evaluate it: outlap evaluate {run.folder}",
    )
    return CommandResult(data, show)
