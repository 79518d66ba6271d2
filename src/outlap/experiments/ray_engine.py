"""Units of work on the machines of a Ray cluster, or on this one: each a Ray task that declares what it needs.

The machines share the folder of work, or hand units to each other through an object store. Where a machine is lost,
Ray does its units again elsewhere, from what they had saved; those that were done stay done.
"""

from __future__ import annotations

import asyncio
import logging
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from outlap.errors import OutlapError
from outlap.experiments.engine import Outcome, do_unit
from outlap.experiments.ray_cluster import MARK, import_ray, ray_cluster
from outlap.experiments.store import Store
from outlap.experiments.unit import Unit
from outlap.processes import Interruptible, import_learning

log = logging.getLogger(__name__)

RETRIES = 5  # of a unit whose process or machine is lost
REPORT_EVERY = 1.0  # [s] between two reports of how far a unit is
STORE_EVERY = 120.0  # [s] between two copies of an unfinished unit in the store
PATIENCE = 60.0  # [s] for units to save what they have, after Ctrl-C
QUEUE = 10_000  # units that Ray may have at a time, most of them waiting: that is what clusters grow by


@dataclass(frozen=True)
class Surroundings:
    """What a process of Ray's takes over from the one that the work began in."""

    folder: Path  # where relative names of tracks begin
    variables: Mapping[str, str]  # of the environment

    @classmethod
    def here(cls) -> Surroundings:
        """Those of this process."""
        ours = {name: value for name, value in os.environ.items() if name.startswith("OUTLAP_") and name != MARK}
        return cls(Path.cwd(), ours)

    def settle_in(self) -> None:
        """Take them over, and keep one core busy, no more."""
        import numba

        numba.set_num_threads(1)  # PyTorch's are one already: Ray says so by OMP_NUM_THREADS
        os.environ.update(self.variables)
        if self.folder.is_dir():
            os.chdir(self.folder)


class RayEngine:
    """A Ray cluster.

    Args:
        address: of its head, as `ray.init` takes it; None: RAY_ADDRESS, or else a cluster of this machine alone.
        store: URL of an object store; None: all machines see the folder of work under the same path.
        jobs: units at a time; 0: as many as the cluster has cores.
        gpu_share: of a GPU, for each unit that uses one.
        tracks: fingerprints that tracks must have on every machine, by their names.

    Raises OutlapError where Ray is not installed.
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
        cores = max(1, int(self._ray.cluster_resources().get("CPU", 1)))
        return min(self._jobs or cores, cores)

    def open(self, units: Sequence[Unit], work: Path) -> None:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        self._work = work.absolute()
        if self._store is not None:
            self._store.check()
            self._exchange(units, self._store)
        self._resources.enter_context(ray_cluster(self._address))
        here = NodeAffinitySchedulingStrategy(self._ray.get_runtime_context().get_node_id(), soft=True)
        board = self._ray.remote(_Board).options(
            num_cpus=0, max_restarts=-1, max_concurrency=QUEUE, scheduling_strategy=here
        )
        self._board = board.remote()
        url = self._store.url if self._store else None
        self._orders = _Orders(self._work, url, self._tracks, Surroundings.here())
        self._task = self._ray.remote(num_cpus=1, max_retries=RETRIES)(_do_there)
        self.shares()  # once it has answered, it hears at once that units are to stop

    def _exchange(self, units: Sequence[Unit], store: Store) -> None:
        """Fetch units that are done; put there what was done without the store, of the others and what they need."""
        done, begun = store.done(), store.begun()
        needed: dict[str, Unit] = {}
        for unit in units:
            if unit.key in done:
                store.get(unit, self._work)
                continue
            needed |= {each.key: each for each in _all_needs(unit)}
            if unit.key not in begun and unit.folder(self._work).is_dir():
                log.info("%s: was begun without %s, and is copied there", unit.name, store.url)
                store.put_part(unit, self._work)
        for each in needed.values():
            if each.key not in done and each.is_done(self._work):
                log.info("%s: was done without %s, and is copied there", each.name, store.url)
                store.put(each, self._work)

    def submit(self, unit: Unit) -> None:
        task = self._task.options(name=unit.name, num_gpus=self._gpu_share if unit.uses_gpu else 0)
        self._running[task.remote(unit, self._orders, self._board)] = unit

    def wait(self, timeout: float) -> list[Outcome]:
        finished, _ = self._ray.wait(list(self._running), num_returns=1, timeout=timeout)
        return [self._outcome(reference) for reference in finished]

    def _outcome(self, reference: Any) -> Outcome:
        unit = self._running.pop(reference)
        try:
            seconds = self._ray.get(reference)
        except self._ray.exceptions.RayTaskError as error:
            cause = error.cause
            return Outcome(unit, error=cause if isinstance(cause, Exception) else error)
        except self._ray.exceptions.RayError as error:  # lost more often than it may be tried again
            return Outcome(unit, error=error)
        if self._store is not None:
            try:
                self._store.get(unit, self._work)
            except Exception as error:  # whatever its file system raises: the unit is kept there
                return Outcome(unit, error=error)
        return Outcome(unit, seconds)

    def shares(self) -> Mapping[str, float]:
        try:
            return self._ray.get(self._board.shares.remote(), timeout=5.0)
        except self._ray.exceptions.RayError:  # on its way to another machine
            return {}

    def close(self) -> None:
        with self._resources:
            if self._running:
                self._end_units()

    def _end_units(self) -> None:
        begun = self._stop()
        for reference, unit in self._running.items():
            if unit.key not in begun:
                self._ray.cancel(reference, force=True)  # it may be importing, which is not to be interrupted
        working = [reference for reference, unit in self._running.items() if unit.key in begun]
        if working:
            ended, late = self._ray.wait(working, num_returns=len(working), timeout=PATIENCE)
            self._warn_of_lost_work(ended, late)

    def _stop(self) -> Mapping[str, float]:
        """Have units stop; those that have begun, by their keys."""
        try:
            return self._ray.get(self._board.stop.remote(), timeout=PATIENCE)
        except self._ray.exceptions.RayError as error:  # as where the cluster is gone
            log.warning("units cannot be told to stop, and are ended: %s", error)
            return {}

    def _warn_of_lost_work(self, ended: Sequence[Any], late: Sequence[Any]) -> None:
        for reference in late:
            log.warning("%s has not been saved within %.0f s", self._running[reference].name, PATIENCE)
        for reference in ended:
            try:
                self._ray.get(reference)
            except self._ray.exceptions.RayError as error:
                cause = getattr(error, "cause", None) or error
                log.warning("%s could not be saved: %s", self._running[reference].name, cause)


class _Board:
    """An actor that units tell how far they are, and that tells them when to stop."""

    def __init__(self) -> None:
        self._shares: dict[str, float] = {}
        self._stopped = asyncio.Event()

    async def report(self, key: str, share: float, patience: float) -> bool:
        """Note how far a unit is; whether it is to stop: no is the answer after `patience` seconds, yes at once."""
        self._shares[key] = share
        with suppress(TimeoutError):
            await asyncio.wait_for(self._stopped.wait(), patience)
        return self._stopped.is_set()

    def leave(self, key: str) -> None:
        """A unit does not run any more."""
        self._shares.pop(key, None)

    def shares(self) -> dict[str, float]:
        return self._shares

    def stop(self) -> dict[str, float]:
        """Have all units stop; how far those are that have begun."""
        self._stopped.set()
        return self._shares


@dataclass(frozen=True)
class _Orders:
    """What every machine must know."""

    work: Path
    store: str | None  # URL
    tracks: Mapping[str, str]  # fingerprints by name
    surroundings: Surroundings


class _Progress:
    """Of a unit that is done here: the board hears of it, and says when to interrupt the work."""

    def __init__(self, unit: Unit, board: Any) -> None:
        self.share = 0.0
        self.work = Interruptible()
        self._key, self._board, self._over = unit.key, board, threading.Event()

    @contextmanager
    def on_board(self) -> Iterator[None]:
        """All that Ctrl-C waits for, work or not. Raises KeyboardInterrupt where units are to stop already."""
        if self._tell(patience=0.0):
            raise KeyboardInterrupt
        threading.Thread(target=self._watch, daemon=True).start()
        try:
            yield
        finally:
            self._over.set()

    def note(self, share: float) -> None:
        """So much is done."""
        self.share = share

    def _watch(self) -> None:
        while not self._over.is_set():
            if self._tell(REPORT_EVERY):
                self.work.interrupt()
                self._over.wait()  # until what it has done is saved
        self._board.leave.remote(self._key)

    def _tell(self, patience: float) -> bool:
        """How far it is; whether it is to stop, see `_Board.report`."""
        import ray
        from ray.exceptions import RayError

        try:
            return ray.get(self._board.report.remote(self._key, self.share, patience), timeout=10.0)
        except RayError:  # on its way to another machine: nobody says to stop
            self._over.wait(patience)
            return False


def _do_there(unit: Unit, orders: _Orders, board: Any) -> float | None:
    """Do a unit on whatever machine this is; None where it was stopped."""
    orders.surroundings.settle_in()
    if unit.learns:
        import_learning()  # before it is on the board: nobody waits for what has not begun
    progress = _Progress(unit, board)
    try:
        with progress.on_board():
            if orders.store is None:
                return _do_in_common_folder(unit, orders, progress)
            with tempfile.TemporaryDirectory(prefix="outlap-") as scratch:
                return _do_with_store(unit, orders, Path(scratch), Store(orders.store), progress)
    except KeyboardInterrupt:
        return None


def _do_in_common_folder(unit: Unit, orders: _Orders, progress: _Progress) -> float:
    work, machine = orders.work, os.uname().nodename
    if not (work / ".lock").is_file():  # of the process that hands out the units
        raise OutlapError(f"{work}: is not seen by machine {machine}; give an --out that is, or a --store")
    with progress.work.at_work():
        _check_tracks(unit, orders.tracks)
        return do_unit(unit, work, progress.note)


def _do_with_store(unit: Unit, orders: _Orders, scratch: Path, store: Store, progress: _Progress) -> float:
    keep = _now_and_then(STORE_EVERY, lambda: _keep_part(unit, scratch, store))

    def report(share: float) -> None:
        progress.note(share)
        keep()

    try:
        with progress.work.at_work():
            _check_tracks(unit, orders.tracks)
            for needed in {each.key: each for each in _all_needs(unit)}.values():
                store.get(needed, scratch)
            store.get_part(unit, scratch)
            seconds = do_unit(unit, scratch, report)
    except KeyboardInterrupt:
        if unit.folder(scratch).is_dir():  # else what the store has of it is not here yet
            store.put_part(unit, scratch)
        raise
    store.put(unit, scratch)
    return seconds


def _keep_part(unit: Unit, scratch: Path, store: Store) -> None:
    try:
        store.put_part(unit, scratch)
    except Exception as error:  # whatever its file system raises; the next copy may succeed
        log.warning("%s: goes on, and is not copied to %s: %s", unit.name, store.url, error)


def _all_needs(unit: Unit) -> Iterable[Unit]:
    for needed in unit.needs:
        yield from _all_needs(needed)
        yield needed


def _now_and_then(seconds: float, act: Callable[[], None]) -> Callable[[], None]:
    """What acts when it is called, but so often at most."""
    last = time.monotonic()

    def sometimes() -> None:
        nonlocal last
        if time.monotonic() - last >= seconds:
            act()
            last = time.monotonic()

    return sometimes


def _check_tracks(unit: Unit, fingerprints: Mapping[str, str]) -> None:
    """Raises OutlapError for a track that is another one here than where the work was planned."""
    from outlap.track.catalog import load_track

    for name in unit.tracks:
        if name in fingerprints and load_track(name).fingerprint != fingerprints[name]:
            raise OutlapError(
                f"track {name}: is another one on machine {os.uname().nodename} than where the work began; "
                "give all machines the same tracks"
            )
