"""The batched simulator."""

from pathlib import Path

from numba import njit

from outlap.kernel_cache import discard_stale_kernels


@njit(cache=True)
def _probe():
    return 0


# Before any kernel can be called. The kernels of this package use functions and constants of this package alone.
discard_stale_kernels(_probe, sorted(Path(__file__).parent.glob("*.py")))
