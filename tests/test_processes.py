"""A process for one function: what it returns, what it raises, and what is left of it."""

from __future__ import annotations

import multiprocessing
import os
import time

import pytest

from outlap.errors import OutlapError
from outlap.processes import in_new_process


def double(number: int) -> tuple[int, int]:
    return os.getpid(), 2 * number


def complain() -> None:
    raise OutlapError("--device: is 'nope'")


def end() -> None:
    os._exit(3)


def test_it_returns_what_the_function_does_and_leaves_no_process() -> None:
    waits: list[float] = []
    process, number = in_new_process(double, 21, on_wait=lambda: waits.append(time.monotonic()))
    assert number == 42
    assert process != os.getpid()
    assert waits, "a new interpreter takes longer than a look"
    assert not multiprocessing.active_children()


def test_it_raises_what_the_function_does() -> None:
    with pytest.raises(OutlapError, match="nope"):
        in_new_process(complain)


def test_a_process_that_ends_without_an_answer_is_told_of() -> None:
    with pytest.raises(RuntimeError, match="end ended with 3"):
        in_new_process(end)


def test_whoever_stops_waiting_leaves_no_process() -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        in_new_process(time.sleep, 60.0, on_wait=stop)
    assert not multiprocessing.active_children()
