"""Ctrl-C at any moment of a command: it ends soon, in one line, with 130."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from outlap.processes import is_importing

INTERRUPTED = 130
IMPORT_PATIENCE = 0.5  # [s] that an import has to come to its end after Ctrl-C
RETRY = 0.05  # [s] between two looks whether it has
NOTHING_KEPT = "nothing is kept; begin again with the same command"
SHOW_CURSOR = "\x1b[?25h"


@contextmanager
def ctrl_c_spares_imports() -> Iterator[None]:
    """Meanwhile, Ctrl-C raises KeyboardInterrupt, but never inside an import (see `is_importing`) or around a fork.

    An import that goes on for more than `IMPORT_PATIENCE` ends the process: what still imports has nothing to save.
    """
    # Whoever started this with another handler, or none, wants it so.
    usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not usual or not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
        yield
        return
    first: float | None = None  # when Ctrl-C came during the import

    def heed(number: int, frame: FrameType | None) -> None:
        nonlocal first
        if not is_importing(frame) and not _is_at_fork(frame):
            first = None
            signal.default_int_handler(number, frame)
        if first is None:
            first = time.monotonic()
        elif number == signal.SIGINT or time.monotonic() - first > IMPORT_PATIENCE:  # again, or for too long
            with suppress(OSError):
                os.write(2, b"\noutlap: interrupted\n")  # sys.stderr may be somebody's buffer, or in use
            end_now(INTERRUPTED)
        signal.setitimer(signal.ITIMER_REAL, RETRY)

    alarm = signal.signal(signal.SIGALRM, heed)
    signal.signal(signal.SIGINT, heed)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGALRM, alarm)


def _is_at_fork(frame: FrameType | None) -> bool:
    """Whether this is one of logging's functions around a fork, in which Python passes over every exception."""
    if frame is None or frame.f_code.co_filename != logging.__file__:
        return False
    return frame.f_code.co_name in ("_acquireLock", "_releaseLock")


def end_now(code: int) -> None:
    """End the process without the interpreter's teardown, which takes a second or more once PyTorch is loaded."""
    with suppress(OSError, ValueError):
        if sys.stderr.isatty():
            sys.stderr.write(SHOW_CURSOR)  # a progress bar may have hidden it
        sys.stderr.flush()
    with suppress(OSError, ValueError):
        sys.stdout.flush()
    os._exit(code)
