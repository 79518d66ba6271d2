"""Ctrl-C comes, wherever it was pressed."""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Iterator

import pytest

from outlap.cli.interrupts import ctrl_c_spares_imports


@pytest.fixture
def usual_handler() -> Iterator[None]:
    """A test run in the background hands down an ignored SIGINT."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("usual_handler")
def test_around_a_fork_where_python_would_pass_over_it_it_comes_a_moment_later() -> None:
    names = {"signal": signal, "reached": []}
    hook = "def _releaseLock():\n    signal.raise_signal(signal.SIGINT)\n    reached.append('its end')\n"
    exec(compile(hook, logging.__file__, "exec"), names)  # logging's own would have to fork at the right moment

    def interrupted() -> None:
        with ctrl_c_spares_imports():
            names["_releaseLock"]()  # type: ignore[operator]
            time.sleep(5.0)

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert names["reached"] == ["its end"]
