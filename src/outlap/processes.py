"""Starting other processes, and ending them early with nothing lost."""

from __future__ import annotations

import _thread
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Executor, Future, wait
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from types import FrameType
from typing import Any, TypeVar

T = TypeVar("T")
LOOK = 0.1  # [s] between two looks of a worker whether it is to end, and of who waits for one
SAVING = 60.0  # [s] that a worker has for saving its work before it is ended all the same


@contextmanager
def process_environment(**variables: str) -> Iterator[None]:
    """Environment variables for the processes that are started meanwhile."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def ctrl_c_kept_away() -> Iterator[None]:
    """Ctrl-C, which a terminal sends to all, does not reach the processes that are started meanwhile.

    They hear of it from this one, see `Workers`: else those that are still importing end in a traceback each. Here it
    comes when the block is done.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # which starting a process would do, and let Ctrl-C through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # handed down, from their first moment on
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def in_new_process(function: Callable[..., T], *arguments: Any, on_wait: Callable[[], None] = lambda: None) -> T:
    """What a function returns in a process of its own, which has its own peak of memory, threads and caches.

    Args:
        function: of a module, and
        arguments: of it, to be pickled, as what it returns.
        on_wait: called now and then until it returns.

    Raises what the function raises, and RuntimeError where the process ends without an answer.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(sender, function, arguments), daemon=True)
    with ctrl_c_kept_away():
        process.start()
    sender.close()
    try:
        while not receiver.poll(LOOK):
            on_wait()
        value, error = receiver.recv()
    except EOFError:
        process.join()
        raise RuntimeError(f"the process of {function.__name__} ended with {process.exitcode}") from None
    finally:
        process.kill()
        process.join()
    if error is not None:
        raise error
    return value


def _answer(sender: Connection, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    try:
        answer = function(*arguments), None
    except Exception as error:
        answer = None, error
    sender.send(answer)


class Workers:
    """What the processes of a pool and the one that started them tell each other."""

    def __init__(self, context: SpawnContext, tasks: int) -> None:
        self.share = context.RawArray("d", tasks)  # of each task that is done
        self.begun = context.RawArray("b", tasks)
        self.stop = context.RawValue("b", 0)  # no lock in any of them that a killed process could hold for ever
        self._before = set(multiprocessing.active_children())

    @property
    def initializer_arguments(self) -> tuple[Any, ...]:
        """Of `start_worker`, with which each process of the pool begins."""
        return self.share, self.begun, self.stop

    def submit(self, pool: Executor, task: int, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Have a pool do a task."""
        self.begun[task] = 0
        with ctrl_c_kept_away():  # the pool may start a process for it
            return pool.submit(function, *arguments)

    def end(self, running: Collection[tuple[Future[Any], int]]) -> None:
        """Have those that are at work save what they have, and end all processes of the pool."""
        self.stop.value = 1
        # One that has not begun its task has nothing to save, and may be importing for seconds.
        wait([future for future, task in running if self.begun[task]], SAVING)
        for process in multiprocessing.active_children():
            if process not in self._before:
                process.kill()


class Interruptible:
    """Work of the main thread that another thread can interrupt, wherever it is."""

    def __init__(self) -> None:
        self._at_work = self._is_to_end = False
        self._changing = threading.Lock()
        # What Python sets by itself, unless the process was started with SIGINT ignored.
        signal.signal(signal.SIGINT, signal.default_int_handler)

    @contextmanager
    def at_work(self) -> Iterator[None]:
        """The work. KeyboardInterrupt comes at once where `interrupt` was called before."""
        with self._changing:
            if self._is_to_end:
                raise KeyboardInterrupt
            self._at_work = True
        try:
            yield
        finally:
            with self._changing:
                self._at_work = False

    def interrupt(self) -> bool:
        """Interrupt it, once it is not importing any more; whether it was at work."""
        main = threading.main_thread().ident
        while is_importing(sys._current_frames().get(main or 0)):
            time.sleep(LOOK)
        with self._changing:
            self._is_to_end = True
            if self._at_work:
                _thread.interrupt_main()  # and no real signal: those may be kept away from this process
            return self._at_work


class _Worker:
    """This process, if it is one of a pool."""

    def __init__(self, share: Any, begun: Any, stop: Any) -> None:
        self.share, self.begun, self._stop = share, begun, stop
        self.work = Interruptible()

    def watch(self) -> None:
        """Interrupt the work once nobody wants it any more for now."""
        while not (self._stop.value or is_orphan()):
            time.sleep(LOOK)
        if not self.work.interrupt() and is_orphan():
            os._exit(1)


_worker: _Worker | None = None


def start_worker(share: Any, begun: Any, stop: Any) -> None:
    """The initializer of a pool's processes: light, so that they can be ended while they import what they work with."""
    global _worker
    _worker = _Worker(share, begun, stop)
    threading.Thread(target=_worker.watch, daemon=True).start()


@contextmanager
def at_work(task: int) -> Iterator[None]:
    """A worker does a task: KeyboardInterrupt comes wherever it is once all are to end, or nobody waits any more."""
    worker = _worker
    if worker is None:  # not in a pool
        yield
        return
    worker.begun[task] = 1
    try:
        with worker.work.at_work():
            yield
    except KeyboardInterrupt:
        if is_orphan():
            os._exit(1)
        raise


def report_share(task: int, share: float) -> None:
    """A worker tells how much of its task is done."""
    if _worker is not None:
        _worker.share[task] = share


def import_learning() -> None:
    """Import what takes longest, before a task begins: a worker can be ended meanwhile."""
    import sklearn.linear_model  # noqa: F401
    import stable_baselines3  # noqa: F401 - and PyTorch with it
    import torch._dynamo  # noqa: F401 - else the first optimizer does so


def is_importing(frame: FrameType | None) -> bool:
    """Whether a module is being imported at this frame or further up the stack.

    That is no place for a KeyboardInterrupt: extension modules in C++ abort the process when they meet one there, and
    others make an ImportError of it.
    """
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def is_orphan() -> bool:
    """Whether the process that started this worker is gone."""
    parent = multiprocessing.parent_process()
    return parent is not None and not parent.is_alive()
