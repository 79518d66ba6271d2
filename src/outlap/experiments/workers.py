"""Worker processes that save their work when they are stopped.

Ctrl-C reaches only the parent, which asks its workers to stop. A worker learns this when its task reports progress.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from typing import Any

from outlap.experiments.unit import Report
from outlap.processes import sigint_blocked

SAVING_TIME = 60.0  # [s] that a worker has to save its work before it is killed
NOT_REPORTED = -1.0  # in place of the progress of a task


class Workers:
    """A pool of processes that do tasks, each in a slot.

    Args:
        slots: tasks at a time.
    """

    def __init__(self, slots: int) -> None:
        self._context = multiprocessing.get_context("spawn")
        # Without locks, which a killed process could hold forever.
        self.progress = self._context.RawArray("d", slots)  # of each slot, 0 … 1 or NOT_REPORTED
        self._stop = self._context.RawValue("b", 0)
        self._others = set(multiprocessing.active_children())
        self.pool = self._new_pool()

    def restart(self) -> None:
        """Replace all processes, after one of them has died."""
        self.pool.shutdown()
        self.pool = self._new_pool()

    def _new_pool(self) -> ProcessPoolExecutor:
        initial = (self.progress, self._stop)
        return ProcessPoolExecutor(len(self.progress), self._context, initializer=_start_worker, initargs=initial)

    def submit(self, slot: int, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Begin a task in a free slot."""
        self.progress[slot] = NOT_REPORTED
        with sigint_blocked():  # the pool may start a process
            return self.pool.submit(function, *arguments)

    def end(self, running: Collection[tuple[Future[Any], int]]) -> None:
        """End all processes. Tasks that run, each with its slot, save first.

        A task that has not reported progress yet has nothing to save, and is not waited for.
        """
        self._stop.value = 1
        try:
            wait([future for future, slot in running if self.progress[slot] != NOT_REPORTED], SAVING_TIME)
        finally:
            if running:
                for process in set(multiprocessing.active_children()) - self._others:
                    process.kill()
            self.pool.shutdown()


class _Worker:
    """This process of a pool. It ends after SIGTERM or the death of its parent, once its task has saved."""

    def __init__(self, progress: Any, stop: Any) -> None:
        self.progress, self._stop = progress, stop
        self.is_busy = self.is_ending = False
        signal.signal(signal.SIGTERM, self.end)
        threading.Thread(target=self._watch_parent, daemon=True).start()

    def report(self, slot: int, share: float) -> None:
        """Share the progress of a task. Raise KeyboardInterrupt if it is to stop."""
        self.progress[slot] = share
        if self.is_ending or self._stop.value:
            raise KeyboardInterrupt

    def end(self, *_: Any) -> None:
        """End now, or after the present task."""
        self.is_ending = True
        if not self.is_busy:
            os._exit(1)

    def _watch_parent(self) -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        parent.join()
        self.end()


_worker: _Worker | None = None


def _start_worker(progress: Any, stop: Any) -> None:
    global _worker
    _worker = _Worker(progress, stop)


@contextmanager
def reporting(slot: int) -> Iterator[Report]:
    """Yield the function by which a task reports its progress; outside of a worker, it does nothing."""
    worker = _worker
    if worker is None:
        yield lambda share: None
        return
    worker.is_busy = True
    try:
        yield lambda share: worker.report(slot, share)
    finally:
        worker.is_busy = False
        if worker.is_ending:
            os._exit(1)
