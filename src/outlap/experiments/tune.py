"""A sweep by Ray Tune: trials that fall behind are stopped early (ASHA), those that are promising go to their end."""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from outlap.errors import OutlapError
from outlap.experiments.ray_engine import Surroundings, import_ray, join_cluster
from outlap.experiments.sweep import Range, SweepConfig
from outlap.training.run import Run, load_run
from outlap.training.session import Progress, train

SCORE = "progress_m"  # of a training's recent episodes
RETRIES = 5  # of a trial whose process or machine is lost
FIRST_CUT = 8  # trials are compared for the first time after this part of their steps
STEPS = "steps"


def tune_trials(
    sweep: SweepConfig,
    folder: Path,
    address: str | None = None,
    store: str | None = None,
    jobs: int = 0,
    gpu_share: float = 1.0,
    on_trials: Callable[[int, int], None] | None = None,
) -> pd.DataFrame:
    """Search with Ray Tune; what was begun in the folder, or the store, goes on.

    Args:
        sweep: what is varied; each trial is trained once.
        folder: for Tune's own files, and the best run.
        address: of a Ray cluster, see `join_cluster`.
        store: URL of an object store for the trials; None: all machines see `folder` under the same path.
        jobs: trials at a time; 0: as many as there are cores.
        gpu_share: of a GPU, for each trial on one.
        on_trials: called with the trials that are done and that run, now and then.

    Returns:
        A row a trial, the best first, and those that were stopped early behind the others: the values that are
        varied, progress_m, crash_rate and mean_speed_mps of its last episodes, and the steps that it came to.

    Raises OutlapError where Ray is not installed, or all trials failed.
    """
    import_ray()
    from ray import tune
    from ray.tune.schedulers import ASHAScheduler

    if sweep.seeds != 1:
        raise OutlapError(f"seeds is {sweep.seeds}; must be 1 here: each trial is trained once")
    for values in sweep.draw():
        sweep.trial_config(values)  # now, and not in an hour
    config = sweep.trial_config({})
    total = config.total_steps
    os.environ.setdefault("TUNE_WARN_EXCESSIVE_EXPERIMENT_CHECKPOINT_SYNC_THRESHOLD_S", "0")
    began = join_cluster(address)
    try:
        surroundings = Surroundings.here()
        gpu = {"gpu": gpu_share} if config.device.startswith("cuda") else {}
        trainable = tune.with_resources(lambda values: _trial(sweep, values, surroundings), {"cpu": 1, **gpu})
        storage = store or str(folder.absolute())
        if tune.Tuner.can_restore(f"{storage}/tune"):
            tuner = tune.Tuner.restore(f"{storage}/tune", trainable, restart_errored=True)
        else:
            tuner = tune.Tuner(
                trainable,
                param_space={name: _space(each, grid=not sweep.trials) for name, each in sweep.search.items()},
                tune_config=tune.TuneConfig(
                    metric=SCORE, mode="max", num_samples=sweep.trials or 1, max_concurrent_trials=jobs or None,
                    scheduler=ASHAScheduler(STEPS, max_t=total, grace_period=max(1, total // FIRST_CUT)),
                ),
                run_config=tune.RunConfig(
                    name="tune", storage_path=storage, verbose=0, callbacks=[_watch(on_trials)],
                    failure_config=tune.FailureConfig(max_failures=RETRIES),
                    checkpoint_config=tune.CheckpointConfig(num_to_keep=1),
                ),
            )  # fmt: skip
        with contextlib.redirect_stdout(io.StringIO()):  # of Tune's own tables
            results = tuner.fit()
    finally:
        if began:
            import_ray().shutdown()
    rows, checkpoints = [], []
    for result in results:
        metrics = result.metrics or {}
        if SCORE in metrics:
            told = {name: metrics[name] for name in (SCORE, "crash_rate", "mean_speed_mps", STEPS)}
            rows.append({**(result.config or {}), **told, "stopped_early": metrics[STEPS] < total})
            checkpoints.append(result.checkpoint)
    if not rows:
        raise OutlapError(f"{storage}: no trial came to a result: {next(iter(results.errors), 'no episode ended')}")
    found = pd.DataFrame(rows).sort_values(["stopped_early", SCORE], ascending=[True, False], kind="stable")
    best = checkpoints[int(found.index[0])]
    if best is not None:
        best.to_directory(folder / "best")
    return found.reset_index(drop=True)


def _space(values: Any, grid: bool) -> Any:
    """What Tune draws from."""
    from ray import tune

    if isinstance(values, Range):
        match values.distribution:
            case "uniform":
                return tune.uniform(values.low, values.high)
            case "log_uniform":
                return tune.loguniform(values.low, values.high)
            case "integer":
                return tune.randint(int(values.low), int(values.high) + 1)
    return tune.grid_search(list(values)) if grid else tune.choice(list(values))


def _trial(sweep: SweepConfig, values: Mapping[str, Any], surroundings: Surroundings) -> None:
    """Train with some values, in a process of Tune's."""
    from ray import tune

    surroundings.settle_in()
    config = sweep.trial_config(values)
    with tempfile.TemporaryDirectory(prefix="outlap-") as scratch:
        folder = Path(scratch) / "run"
        kept = tune.get_checkpoint()
        begun: Run | None = None
        if kept is not None:
            kept.to_directory(folder)
            begun = load_run(folder)
        known = begun.checkpoints() if begun else []
        latest: dict[str, Any] = {}

        def report(progress: Progress) -> None:
            nonlocal known
            if progress.progress_m is None:  # no episode has ended yet
                return
            latest.update(
                {
                    STEPS: progress.steps,
                    SCORE: progress.progress_m,
                    "crash_rate": progress.crash_rate,
                    "mean_speed_mps": progress.mean_speed_mps,
                }
            )
            there = Run(folder, config).checkpoints()
            new = there != known
            known = there
            tune.report(dict(latest), checkpoint=tune.Checkpoint.from_directory(str(folder)) if new else None)

        train(config, folder, resume=begun, on_progress=report)
        if latest:
            tune.report(dict(latest), checkpoint=tune.Checkpoint.from_directory(str(folder)))


def _watch(on_trials: Callable[[int, int], None] | None) -> Any:
    from ray.tune import Callback

    class Watch(Callback):
        """Counts the trials that are done."""

        def on_step_end(self, iteration: int, trials: list, **_: Any) -> None:
            if on_trials is not None:
                on_trials(sum(t.is_finished() for t in trials), sum(t.status == "RUNNING" for t in trials))

    return Watch()
