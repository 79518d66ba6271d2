"""How the threads of OpenMP wait for work, in Numba's parallel loops and in PyTorch.

A thread that finds no work spins before it sleeps. By default GNU OpenMP spins for milliseconds and LLVM's for 200 ms,
which takes the core from every other process: of two simulators side by side on two cores, each ran at 3 % of its speed
alone. Spinning for about 0.2 ms leaves each of them a third, and one process alone 98 % (`outlap benchmark simulator
--cars 1 --beams 108 --seconds 2`, alone and twice at once, two cores of a Xeon; see `benchmarks/side_by_side.py`).
"""

from __future__ import annotations

import os

WAITING = {
    "GOMP_SPINCOUNT": "10000",  # GNU: rounds of a spinning loop
    "KMP_BLOCKTIME": "1",  # LLVM: [ms]
}


def wait_without_spinning() -> None:
    """Let idle threads sleep soon, unless the user's environment says how they wait.

    OpenMP reads the environment when it is loaded, so call this before the first import of Numba and PyTorch.
    """
    if not {"OMP_WAIT_POLICY", *WAITING} & os.environ.keys():
        os.environ.update(WAITING)
