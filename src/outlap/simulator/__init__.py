"""The batched simulator."""

from pathlib import Path

from numba import njit

from outlap.kernel_cache import discard_stale_kernels

_FOLDER = Path(__file__).parent
_ELSEWHERE = ("seeding.py", "track/centerline.py")  # in the package


@njit(cache=True)
def _probe():
    return 0


# Before any kernel of this package can be called.
discard_stale_kernels(_probe, [*sorted(_FOLDER.glob("*.py")), *(_FOLDER.parent / name for name in _ELSEWHERE)])
