"""Child processes: their environment, their signals, and one function in a new process."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any, TypeVar

T = TypeVar("T")
POLL_INTERVAL = 0.1  # [s] between two checks for the answer of a process


@contextmanager
def process_environment(**variables: str) -> Iterator[None]:
    """Set environment variables for the processes that are started in the block."""
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
def sigint_blocked() -> Iterator[None]:
    """Block SIGINT; processes that are started in the block never receive it, this process receives it afterwards."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # starting a process would start it, and unblock the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def in_new_process(function: Callable[..., T], *arguments: Any, on_wait: Callable[[], None] = lambda: None) -> T:
    """Return the value of a function that runs in a process with its own peak of memory, threads and caches.

    Args:
        function: a function of a module.
        arguments: its arguments; like the returned value, they are pickled.
        on_wait: called repeatedly until the function returns.

    Raises what the function raises, and RuntimeError if the process ends without an answer.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(sender, function, arguments), daemon=True)
    with sigint_blocked():
        process.start()
    sender.close()
    try:
        while not receiver.poll(POLL_INTERVAL):
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
