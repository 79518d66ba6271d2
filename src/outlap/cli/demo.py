"""`outlap demo`: the main job from end to end, on the built-in circuits, in minutes."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import FlagCreatePairsOff

from outlap.cli.output import CommandResult


@dataclass(frozen=True)
class Demo:
    """Train a policy on the built-in training circuits, then race it on circuits that it never saw.

    The same as `outlap train ppo` and `outlap evaluate` with their defaults, but shorter.
    """

    steps: int = 1_200_000
    """Actions to train for, all worlds together."""

    episodes: int = 30
    """To race on each held-out circuit."""

    seed: int = 0
    """Of the training and of the evaluation."""

    out: Path | None = None
    """The run folder; by default a new one under runs/."""

    quiet: FlagCreatePairsOff[bool] = False
    """Show no progress."""

    json: str | None = None
    """Write the result as JSON to this file; - for standard output."""

    def run(self) -> CommandResult:
        from outlap.cli.evaluate import Evaluate
        from outlap.cli.train import TrainPPO
        from outlap.config import validate
        from outlap.track.generate import BUILTIN_HELD_OUT
        from outlap.training.ppo import PPOConfig

        settings = {"total_steps": self.steps, "seed": self.seed, "held_out_tracks": BUILTIN_HELD_OUT}
        config = validate(PPOConfig, settings, "outlap demo")
        folder = self.out or Path("runs") / time.strftime("demo-%Y%m%d-%H%M%S")
        trained = TrainPPO(settings=config, out=folder, quiet=self.quiet).run()
        evaluated = Evaluate(str(folder), episodes=self.episodes, seed=self.seed, quiet=self.quiet).run()

        def show(console) -> None:
            trained.show(console)
            evaluated.show(console)

        return CommandResult({"training": trained.data, "evaluation": evaluated.data}, show)
