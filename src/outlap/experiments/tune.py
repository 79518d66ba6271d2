"""A sweep by Ray Tune: trials that fall behind are stopped early (ASHA), those that are promising go to their end."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import pandas as pd

from outlap.errors import OutlapError
from outlap.experiments.ray_cluster import import_ray, ray_cluster
from outlap.experiments.ray_engine import Surroundings
from outlap.experiments.store import Store
from outlap.experiments.sweep import SweepConfig
from outlap.files import to_json
from outlap.training.run import Run, load_run
from outlap.training.session import Progress, train

SCORE = "progress_m"  # of a training's recent episodes
RETRIES = 5  # of a trial whose process or machine is lost
FIRST_CUT = 8  # trials are compared for the first time after this part of their steps
STEPS = "steps"
TRIAL = "trial"

OnTrials = Callable[[int, int], None]
LISTENER: ContextVar[OnTrials | None] = ContextVar("LISTENER", default=None)  # of the search in this process


def tune_trials(
    sweep: SweepConfig,
    folder: Path,
    address: str | None = None,
    store: str | None = None,
    jobs: int = 0,
    gpu_share: float = 1.0,
    on_trials: OnTrials | None = None,
) -> pd.DataFrame:
    """Search with Ray Tune; what was begun in the folder, or the store, goes on.

    Args:
        sweep: what is varied; each trial is trained once.
        folder: for Tune's own files, and the best run.
        address: of a Ray cluster, see `ray_cluster`.
        store: URL of an object store for the trials; None: all machines see `folder` under the same path.
        jobs: trials at a time; 0: as many as there are cores.
        gpu_share: of a GPU, for each trial on one.
        on_trials: called with the trials that are done and that run, now and then.

    Returns:
        A row a trial, the best first, and those that were stopped early behind the others: its number in `draw`, the
        values that are varied, progress_m, crash_rate and mean_speed_mps of its last episodes, the steps that it came
        to, and whether it was stopped early.

    Raises OutlapError where Ray is not installed, another sweep was begun there, or all trials failed. A
    KeyboardInterrupt passes through.
    """
    import_ray()
    from ray import tune
    from ray.tune.schedulers import ASHAScheduler

    if sweep.seeds != 1:
        raise OutlapError(f"seeds is {sweep.seeds}; must be 1 here: each trial is trained once")
    drawn = sweep.draw()
    configs = [sweep.trial_config(values) for values in drawn]  # what is wrong is said now, and not in an hour
    total = max(config.total_steps for config in configs)
    storage = store or str(folder.absolute())
    kept = Store(storage)
    _claim(sweep, kept, "--store" if store else "--out")
    os.environ.setdefault("TUNE_WARN_EXCESSIVE_EXPERIMENT_CHECKPOINT_SYNC_THRESHOLD_S", "0")
    os.environ["TUNE_DISABLE_SIGINT_HANDLER"] = "1"  # or Ctrl-C makes `fit` return as if all was done
    with ray_cluster(address), contextlib.ExitStack() as last:
        last.callback(LISTENER.reset, LISTENER.set(on_trials))
        surroundings = Surroundings.here()
        gpu = {"gpu": gpu_share} if configs[0].device.startswith("cuda") else {}
        trainable = tune.with_resources(lambda given: _trial(sweep, given[TRIAL], surroundings), {"cpu": 1, **gpu})
        space = {TRIAL: tune.grid_search(list(range(len(drawn))))}  # those of `outlap sweep`: they follow from the seed
        if kept.files.glob(f"{kept.root}/tune/experiment_state-*.json"):  # Tune asks for less than it needs
            tuner = tune.Tuner.restore(f"{storage}/tune", trainable, restart_errored=True, param_space=space)
        else:
            tuner = tune.Tuner(
                trainable,
                param_space=space,
                tune_config=tune.TuneConfig(
                    metric=SCORE, mode="max", max_concurrent_trials=jobs or None,
                    scheduler=ASHAScheduler(
                        STEPS, max_t=total, grace_period=max(1, total // FIRST_CUT), stop_last_trials=False,
                    ),
                ),
                run_config=tune.RunConfig(
                    name="tune", storage_path=storage, verbose=0, callbacks=[_watch()],
                    failure_config=tune.FailureConfig(max_failures=RETRIES),
                    checkpoint_config=tune.CheckpointConfig(num_to_keep=1),
                ),
            )  # fmt: skip
        with contextlib.redirect_stdout(io.StringIO()):  # of Tune's own tables
            results = tuner.fit()
    rows, checkpoints = [], []
    for result in results:
        metrics = result.metrics or {}
        if SCORE in metrics:
            told = {name: metrics[name] for name in (SCORE, "crash_rate", "mean_speed_mps", STEPS)}
            number = (result.config or {})[TRIAL]
            early = metrics[STEPS] < configs[number].total_steps
            rows.append({TRIAL: number, **drawn[number], **told, "stopped_early": early})
            checkpoints.append(result.checkpoint)
    if not rows:
        raise OutlapError(f"{storage}: no trial came to a result: {next(iter(results.errors), 'no episode ended')}")
    found = pd.DataFrame(rows).sort_values(["stopped_early", SCORE], ascending=[True, False], kind="stable")
    best = checkpoints[int(found.index[0])]
    if best is not None:
        shutil.rmtree(folder / "best", ignore_errors=True)  # of a trial that was the best so far
        best.to_directory(folder / "best")
    return found.reset_index(drop=True)


def _claim(sweep: SweepConfig, store: Store, flag: str) -> None:
    """Keep the sweep beside Tune's files. Raises OutlapError, with the flag to change, where they are another's."""
    path, new = f"{store.root}/sweep.json", to_json(sweep) + "\n"
    if store.files.exists(path):
        begun = json.loads(store.files.cat_file(path))
    elif store.files.exists(f"{store.root}/tune"):
        begun = {}
    else:
        store.files.makedirs(store.root, exist_ok=True)
        store.files.pipe_file(f"{path}.partial", new.encode())
        store.files.mv(f"{path}.partial", path)
        return
    other = [name for name, value in json.loads(new).items() if name not in begun or begun[name] != value]
    if other:
        raise OutlapError(f"{store.url}: a search with other {', '.join(other)} was begun there; give another {flag}")


def _trial(sweep: SweepConfig, number: int, surroundings: Surroundings) -> None:
    """Train with the values of a trial, in a process of Tune's."""
    from ray import tune

    surroundings.settle_in()
    config = sweep.trial_config(sweep.draw()[number])
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
            if progress.steps >= config.total_steps:  # the last report comes with the finished policy
                return
            there = Run(folder, config).checkpoints()
            new = there != known
            known = there
            tune.report(dict(latest), checkpoint=tune.Checkpoint.from_directory(str(folder)) if new else None)

        run = train(config, folder, resume=begun, on_progress=report)
        if latest:
            latest[STEPS] = run.record()[STEPS]
            tune.report(dict(latest), checkpoint=tune.Checkpoint.from_directory(str(folder)))


def _watch() -> Any:
    """A callback that tells whoever listens. Tune keeps it in a file, of which a search that goes on takes it."""
    from ray.tune import Callback

    class Watch(Callback):
        """Counts the trials that are done."""

        def on_step_end(self, iteration: int, trials: list, **_: Any) -> None:
            tell = LISTENER.get()
            if tell is not None:
                tell(sum(t.is_finished() for t in trials), sum(t.status == "RUNNING" for t in trials))

        def __reduce__(self) -> tuple[Any, tuple]:
            return _watch, ()

    return Watch()
