"""Progress of long work on standard error: a bar in a terminal, a line now and then elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

SECONDS_BETWEEN_LINES = 15.0
Update = Callable[[int, str], None]  # (done, note), to be called as often as is convenient


@contextmanager
def progress_bar(what: str, total: int, unit: str, quiet: bool = False) -> Iterator[Update]:
    """Show how far work has come.

    Args:
        what: the work, in a word or two.
        total: how much there is.
        unit: of what, plural.
        quiet: show nothing.
    """
    if quiet:
        yield lambda done, note: None
    elif sys.stderr.isatty():
        yield from _bar(what, total, unit)
    else:
        yield _lines(what, total, unit)


def _bar(what: str, total: int, unit: str) -> Iterator[Update]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (
        TextColumn(what), BarColumn(), TextColumn("{task.percentage:3.0f} %"), TimeElapsedColumn(),
        TextColumn("left"), TimeRemainingColumn(), TextColumn("{task.fields[rate]}"),
        TextColumn("{task.fields[note]}"),
    )  # fmt: skip
    started = time.monotonic()
    first: list[int] = []
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(what, total=total, rate="", note="")

        def update(done: int, note: str) -> None:
            first[:] = first or [done]
            rate = (done - first[0]) / max(time.monotonic() - started, 1e-9)
            bar.update(task, completed=min(done, total), rate=f"{rate:,.0f} {unit}/s", note=note)

        yield update


def _lines(what: str, total: int, unit: str) -> Update:
    latest, over = time.monotonic(), False

    def update(done: int, note: str) -> None:
        nonlocal latest, over
        now = time.monotonic()
        if (done >= total and not over) or now - latest >= SECONDS_BETWEEN_LINES:
            latest, over = now, done >= total
            print(f"{what}: {min(done, total):,} of {total:,} {unit} {note}", file=sys.stderr, flush=True)

    return update
