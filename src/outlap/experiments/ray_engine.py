"""Do units on the machines of a Ray cluster, or on this one; each unit is a Ray task that declares its resources.

The machines share the work folder, or exchange units through an object store. If a machine is lost, Ray repeats its
units elsewhere from what they had saved; finished units stay finished.
"""

from __future__ import annotations

import logging
import os
import signal
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from outlap.errors import OutlapError
from outlap.experiments.engine import Outcome, run_unit
from outlap.experiments.store import Store
from outlap.experiments.unit import Report, Unit

log = logging.getLogger(__name__)

RETRIES = 5  # of a unit whose process or machine is lost
REPORT_INTERVAL = 1.0  # [s] between two progress reports of a unit
STORE_INTERVAL = 120.0  # [s] between two copies of an unfinished unit to the store
SAVING_TIME = 60.0  # [s] for units to save their work after Ctrl-C
QUEUE = 10_000  # units that Ray may have at a time; clusters grow with those that wait


def import_ray() -> Any:
    """Return the package. Raise OutlapError if it is not installed."""
    try:
        import ray
    except ImportError:
        raise OutlapError("Ray is not installed; get it with pip install 'outlap[distributed]'") from None
    return ray


@contextmanager
def ray_cluster(address: str | None) -> Iterator[None]:
    """Join a Ray cluster, or start one on this machine, which ends with the block.

    If this process has joined one already, keep it. Raise OutlapError if no cluster answers.
    """
    ray = import_ray()
    if ray.is_initialized():
        yield
        return
    sigterm = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(address=address, logging_level=logging.WARNING, log_to_driver=False)
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, sigterm)  # Ray replaces it
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise OutlapError(f"--address {address}: no Ray cluster answers there: {error}") from None
    try:
        yield
    finally:
        ray.shutdown()


def cluster_cores(address: str | None) -> int:
    """Return the number of cores of a Ray cluster, see `ray_cluster`."""
    with ray_cluster(address):
        return max(1, int(import_ray().cluster_resources().get("CPU", 1)))


class RayEngine:
    """A Ray cluster.

    Args:
        address: of its head, as for `ray.init`; None: RAY_ADDRESS, or else a cluster of this machine alone.
        store: URL of an object store; None: all machines see the work folder under the same path.
        jobs: units at a time; 0: as many as the cluster has cores.
        gpu_share: of a GPU, for each unit that uses one.
        tracks: fingerprints that tracks must have on every machine, by name.

    Raises OutlapError if Ray is not installed, or the store's URL is not valid.
    """

    def __init__(
        self,
        address: str | None = None,
        store: str | None = None,
        jobs: int = 0,
        gpu_share: float = 1.0,
        tracks: Mapping[str, str] | None = None,
    ) -> None:
        self._ray = import_ray()
        self._address, self._jobs, self._gpu_share = address, jobs, gpu_share
        self._tracks = dict(tracks or {})
        self._store = Store(store) if store else None
        self._running: dict[Any, Unit] = {}
        self._resources = ExitStack()

    @property
    def limit(self) -> int:
        return self._jobs or QUEUE

    @property
    def slots(self) -> int:
        cores = cluster_cores(self._address)
        return min(self._jobs or cores, cores)

    def open(self, work: Path) -> None:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        self._work = work.absolute()
        if self._store is not None:
            self._store.check()
        self._resources.enter_context(ray_cluster(self._address))
        here = NodeAffinitySchedulingStrategy(self._ray.get_runtime_context().get_node_id(), soft=True)
        actor = self._ray.remote(ProgressActor).options(num_cpus=0, max_restarts=-1, scheduling_strategy=here)
        self._progress = actor.remote()
        self._context = UnitContext(
            self._work, self._store.url if self._store else None, self._tracks, WorkerEnvironment.current()
        )
        self._task = self._ray.remote(num_cpus=1, max_retries=RETRIES)(_run_on_node)

    def fetch(self, units: Sequence[Unit]) -> None:
        """See `Engine`; copy to the store what was begun or done without it, and is needed."""
        store = self._store
        if store is None:
            return
        done, begun = store.done(), store.begun()
        needed: dict[str, Unit] = {}
        for unit in units:
            if unit.key in done:
                store.get(unit, self._work)
                continue
            needed |= {each.key: each for each in unit.all_needs()}
            if unit.key not in begun and unit.folder(self._work).is_dir():
                log.info("%s: was begun without %s, and is copied there", unit.name, store.url)
                store.put_part(unit, self._work)
        for each in needed.values():
            if each.key not in done and each.is_done(self._work):
                log.info("%s: was done without %s, and is copied there", each.name, store.url)
                store.put(each, self._work)

    def submit(self, unit: Unit) -> None:
        task = self._task.options(name=unit.name, num_gpus=self._gpu_share if unit.uses_gpu else 0)
        self._running[task.remote(unit, self._context, self._progress)] = unit

    def wait(self, timeout: float) -> list[Outcome]:
        finished, _ = self._ray.wait(list(self._running), num_returns=1, timeout=timeout)
        return [self._outcome(reference) for reference in finished]

    def _outcome(self, reference: Any) -> Outcome:
        unit = self._running.pop(reference)
        try:
            seconds = self._ray.get(reference)
            if self._store is not None:
                self._store.get(unit, self._work)
        except self._ray.exceptions.RayTaskError as error:
            cause = error.cause
            return Outcome(unit, error=cause if isinstance(cause, Exception) else error)
        except Exception as error:  # lost too often, or an error of the store's file system
            return Outcome(unit, error=error)
        return Outcome(unit, seconds)

    def shares(self) -> Mapping[str, float]:
        try:
            return self._ray.get(self._progress.shares.remote(), timeout=5.0)
        except self._ray.exceptions.RayError:  # it restarts on another machine
            return {}

    def close(self) -> None:
        with self._resources:
            if self._running:
                self._stop_units()

    def _stop_units(self) -> None:
        """Let units save their work, and warn of those that cannot."""
        try:
            reported = self._ray.get(self._progress.stop.remote(), timeout=SAVING_TIME)
        except self._ray.exceptions.RayError as error:
            log.warning("units cannot be told to stop, and are ended: %s", error)
            reported = {}
        saving = {reference: unit for reference, unit in self._running.items() if unit.key in reported}
        for reference in self._running.keys() - saving.keys():  # it has nothing to save
            self._ray.cancel(reference, force=True)
        if not saving:
            return
        ended, late = self._ray.wait(list(saving), num_returns=len(saving), timeout=SAVING_TIME)
        for reference in late:
            log.warning("%s has not been saved within %.0f s", saving[reference].name, SAVING_TIME)
            self._ray.cancel(reference, force=True)
        for reference in ended:
            try:
                self._ray.get(reference)
            except self._ray.exceptions.RayError as error:
                log.warning("%s could not be saved: %s", saving[reference].name, getattr(error, "cause", error))


class ProgressActor:
    """Collects the progress of units, and tells them to stop."""

    def __init__(self) -> None:
        self._shares: dict[str, float] = {}
        self._stopped = False

    def report(self, key: str, share: float) -> bool:
        """Note the finished share of a unit; return whether it is to stop."""
        self._shares[key] = share
        return self._stopped

    def leave(self, key: str) -> None:
        """Forget a unit that has ended."""
        self._shares.pop(key, None)

    def shares(self) -> dict[str, float]:
        """Return the finished shares by key."""
        return self._shares

    def stop(self) -> dict[str, float]:
        """Tell all units to stop; return the shares of those that have reported any."""
        self._stopped = True
        return self._shares


@dataclass(frozen=True)
class WorkerEnvironment:
    """What a worker of Ray takes over from the process that gave the command."""

    folder: Path  # relative names of tracks start here
    variables: Mapping[str, str]  # of the environment

    @classmethod
    def current(cls) -> WorkerEnvironment:
        """Return that of this process."""
        return cls(Path.cwd(), {name: value for name, value in os.environ.items() if name.startswith("OUTLAP_")})

    def apply(self) -> None:
        """Take it over, and use one thread."""
        import numba

        numba.set_num_threads(1)  # Ray sets OMP_NUM_THREADS, for PyTorch
        os.environ.update(self.variables)
        if self.folder.is_dir():
            os.chdir(self.folder)


@dataclass(frozen=True)
class UnitContext:
    """What a machine must know to do units."""

    work: Path
    store: str | None  # URL
    tracks: Mapping[str, str]  # fingerprints by name
    environment: WorkerEnvironment


class _Reporter:
    """Reports the progress of a unit to the actor."""

    def __init__(self, unit: Unit, actor: Any) -> None:
        self._key, self._actor, self._next = unit.key, actor, 0.0

    def __call__(self, share: float) -> None:
        """Report, unless it was a moment ago. Raise KeyboardInterrupt if the unit is to stop."""
        import ray
        from ray.exceptions import RayError

        if time.monotonic() < self._next:
            return
        self._next = time.monotonic() + REPORT_INTERVAL
        try:
            stop = ray.get(self._actor.report.remote(self._key, share), timeout=10.0)
        except RayError:  # it restarts on another machine
            return
        if stop:
            raise KeyboardInterrupt

    def leave(self) -> None:
        """Have the actor forget the unit."""
        self._actor.leave.remote(self._key)


def _run_on_node(unit: Unit, context: UnitContext, actor: Any) -> float | None:
    """Do a unit on the machine of this process; return its seconds, or None if it was stopped."""
    context.environment.apply()
    report = _Reporter(unit, actor)
    try:
        _check_tracks(unit, context.tracks)
        if context.store is None:
            if not (context.work / ".lock").is_file():  # of the process that submits the units
                raise OutlapError(
                    f"{context.work}: is not seen by machine {os.uname().nodename}; give an --out that is, or a --store"
                )
            return run_unit(unit, context.work, report)
        with tempfile.TemporaryDirectory(prefix="outlap-") as scratch:
            return run_with_store(unit, Path(scratch), Store(context.store), report)
    except KeyboardInterrupt:
        return None
    finally:
        report.leave()


def run_with_store(unit: Unit, scratch: Path, store: Store, report: Report) -> float:
    """Do a unit in a scratch folder, and keep it in the store; an unfinished one is copied there regularly."""
    copied = time.monotonic()

    def report_and_copy(share: float) -> None:
        nonlocal copied
        report(share)
        if time.monotonic() - copied < STORE_INTERVAL:
            return
        try:
            store.put_part(unit, scratch)
        except Exception as error:  # each file system has errors of its own; the next copy may succeed
            log.warning("%s: continues, but is not copied to %s: %s", unit.name, store.url, error)
        copied = time.monotonic()

    for needed in {each.key: each for each in unit.all_needs()}.values():
        store.get(needed, scratch)
    store.get_part(unit, scratch)
    try:
        seconds = run_unit(unit, scratch, report_and_copy)
    except KeyboardInterrupt:
        store.put_part(unit, scratch)
        raise
    store.put(unit, scratch)
    return seconds


def _check_tracks(unit: Unit, fingerprints: Mapping[str, str]) -> None:
    """Raise OutlapError if a track differs from that of the machine that gave the command."""
    from outlap.track.catalog import load_track

    for name in unit.tracks:
        if name in fingerprints and load_track(name).fingerprint != fingerprints[name]:
            raise OutlapError(
                f"track {name}: is another one on machine {os.uname().nodename} than where the work began; "
                "give all machines the same tracks"
            )
