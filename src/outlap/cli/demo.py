"""`outlap demo`: the main job from end to end, on the built-in circuits, in minutes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pydantic.dataclasses import dataclass

from outlap.cli.command import Count, CountOrZero, LongCommand
from outlap.cli.output import CommandResult, dated_folder

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Demo(LongCommand):
    """Meta-train a policy on the built-in training circuits; race it on three that it never saw, adapt, race again.

    The same as `outlap train mql` and `outlap adapt --clip abc` with their defaults, but shorter, and the penalty for
    crashing grows less.
    """

    steps: int = 350_000
    """Actions to train for, all worlds together."""

    episodes: Count = 30
    """To race on each held-out circuit before the adaptation to it, and after."""

    seed: CountOrZero = 0
    """Of the training, the adaptation and the episodes."""

    out: Path | None = None
    """The run folder; by default a new one under runs/."""

    def run(self) -> CommandResult:
        from outlap.cli.adapt import Adapt
        from outlap.cli.train import TrainMQL
        from outlap.config import validate
        from outlap.track.generate import BUILTIN_HELD_OUT
        from outlap.training.mql import MQLConfig

        usual = MQLConfig()
        # So short a training has not learnt to drive when the penalty is high, and then creeps.
        reward = usual.env.reward.model_copy(update={"collision_max": 3.5, "collision_growth": 3.4})
        env = usual.env.model_copy(update={"reward": reward})
        settings = {"total_steps": self.steps, "seed": self.seed, "held_out_tracks": BUILTIN_HELD_OUT, "env": env}
        config = validate(MQLConfig, settings, "outlap demo")
        folder = self.out or dated_folder(Path("runs"), "demo-")
        trained = TrainMQL(settings=config, out=folder, quiet=self.quiet).run()
        adapted = Adapt(
            folder, clip=("abc",), seeds=1, episodes=self.episodes, seed=self.seed, record=1, quiet=self.quiet
        ).run()

        data = {"training": trained.data, "adaptation": adapted.data}

        def show(console: Console) -> None:
            trained.show(console)
            adapted.show(console)

        return CommandResult(data, show)
