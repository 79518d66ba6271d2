"""Sine, cosine and arctangent as polynomials, for kernels that need many of them.

They are evaluated by Estrin's scheme, whose short chains of operations let a processor work on several at once.
Coefficients are those of the Chebyshev interpolants; errors are below 1e-12 over the stated domains.
"""

# pyright: basic
# Numba infers the types of kernels; annotations would repeat them and compile nothing.

from __future__ import annotations

import math

from numba import njit

HALF_PI = 0.5 * math.pi
_TAN_EIGHTH = math.tan(math.pi / 8.0)


CONTRACT = {"contract"}  # fused multiply-add


@njit(cache=True, error_model="numpy", fastmath=CONTRACT, inline="always")
def sine(x):
    """sin(x) for x in [-pi / 2, pi / 2]."""
    y = x * x
    z = y * y
    low = (0.9999999999999498 - 0.16666666666467442 * y) + z * (0.00833333332039429 - 0.00019841266689118282 * y)
    high = (2.7556953367051238e-06 - 2.5030284209558804e-08 * y) + z * 1.5411433131527978e-10
    return x * (low + (z * z) * high)


@njit(cache=True, error_model="numpy", fastmath=CONTRACT, inline="always")
def sine_wide(x):
    """sin(x) for x in [-pi, pi]."""
    folded = math.copysign(math.pi, x) - x
    return sine(folded if abs(x) > HALF_PI else x)


@njit(cache=True, error_model="numpy", fastmath=CONTRACT, inline="always")
def cosine_wide(x):
    """cos(x) for x in [-pi, pi]."""
    return sine(HALF_PI - abs(x))


@njit(cache=True, error_model="numpy", fastmath=CONTRACT, inline="always")
def arctangent_of_ratio(above, below):
    """arctan(above / below) for above >= 0 and below >= 0, not both 0."""
    # Reduced to [-tan(pi / 8), tan(pi / 8)] with one division.
    far = _TAN_EIGHTH * above > below
    middle = above > _TAN_EIGHTH * below
    numerator = -below if far else (above - below if middle else above)
    denominator = above if far else (above + below if middle else below)
    offset = HALF_PI if far else (0.5 * HALF_PI if middle else 0.0)
    t = numerator / denominator
    y = t * t
    z = y * y
    low = (0.9999999999992443 - 0.33333333276901306 * y) + z * (0.19999993051887 - 0.14285386503067307 * y)
    high = (0.11103456171077 - 0.08992547368716243 * y) + z * (0.0697417699693059 - 0.03765480113107237 * y)
    return offset + t * (low + (z * z) * high)


@njit(cache=True, error_model="numpy", fastmath=CONTRACT, inline="always")
def arctangent(x):
    """arctan(x) for x >= 0."""
    return arctangent_of_ratio(x, 1.0)
