"""A planar LiDAR: ray casting on walls and on other cars, then sensor noise.

Walls: from a cell whose clearance is c, a ray may go to the cell's edge and c further before it can meet a
wall. So every step passes at least one cell and never a wall, and the range is exact to a few thousandths of a
cell (sphere tracing, Hart 1996, joined with the grid walk of Amanatides and Woo 1987).

Speed: `LANES` neighbouring beams march in lock-step, a loop that compiles to vector instructions. `SLOTS` such
groups take turns, so that the processor can work on one while it waits for the memory of another; a group that
has arrived makes room for the next.
"""

# pyright: basic
# Numba infers the types of kernels; annotations would repeat them and compile nothing.

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
from llvmlite import ir
from numba import carray, njit, types  # pyright: ignore[reportPrivateImportUsage]
from numba.extending import intrinsic

from outlap.simulator.atlas import (
    COS,
    FIRST_WORD,
    GRID_HEIGHT,
    GRID_WIDTH,
    RESOLUTION,
    SIN,
    WALL,
    cell_clearance,
    to_grid,
)
from outlap.simulator.seeding import hash64

LANES = 8
SLOTS = 4
OVERSTEP = np.float32(2e-3)  # [cells] past a cell's edge, so that rounding leaves no ray on it
STEEPEST = np.float32(1e-5)  # least slope [rad] of a ray to the grid, so that crossings stay within float32
FASTMATH = {"nnan", "ninf", "nsz", "contract"}
_f4, _u4, _u8 = np.float32, np.uint32, np.uint64

QUANTILES = 4096
_probability = (np.arange(QUANTILES) + 0.5) / QUANTILES
_normal = np.array([NormalDist().inv_cdf(p) for p in _probability])
NORMAL = (_normal / _normal.std()).astype(np.float32)  # equally likely values of a standard normal


def beam_angles(beams: int, field_of_view: float) -> np.ndarray:
    """Of a scan's beams to the car's x axis, right to left: (beams,) [rad].

    The outermost ones lie at ± `field_of_view` / 2; one beam looks ahead.
    """
    half = 0.5 * field_of_view
    return np.linspace(-half, half, beams) if beams != 1 else np.zeros(1)


def beam_directions(beams: int, field_of_view: float) -> tuple[np.ndarray, np.ndarray]:
    """Cosine and sine of the `beam_angles`: float32 (beams,) each.

    Both arrays are longer than `beams`: the last direction is repeated to fill whole groups of `LANES`.
    """
    angles = beam_angles(beams, field_of_view)
    angles = np.pad(angles, (0, -beams % LANES), mode="edge") if beams else angles
    return np.cos(angles).astype(np.float32), np.sin(angles).astype(np.float32)


@intrinsic  # type: ignore[reportArgumentType]
def _lanes(typingctx=None):
    """Memory for one float32 a lane on the stack, which the compiler turns into vector registers."""

    def codegen(context, builder, signature, arguments):
        with builder.goto_entry_block():
            lanes = builder.alloca(ir.ArrayType(ir.FloatType(), LANES * SLOTS))
            lanes.align = 64
        return builder.bitcast(lanes, ir.FloatType().as_pointer())

    return types.CPointer(types.float32)(), codegen


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
def _aim(lane, first, clear, x0, y0, cos, sin, beam_cos, beam_sin, t, dx, dy, inverse_dx, inverse_dy, edge_x, edge_y):
    """Point the lanes of a slot, from `lane` on, along the beams from `first` on, if there are any left."""
    if first + LANES > beam_cos.shape[0]:
        return
    for k in range(LANES):
        t[lane + k] = clear
        n = _u8(first + k)  # unsigned: one with a sign is tested for wrapping, and then read by gathering
        a = cos * beam_cos[n] - sin * beam_sin[n]
        b = sin * beam_cos[n] + cos * beam_sin[n]
        a = STEEPEST if abs(a) < STEEPEST else a
        b = STEEPEST if abs(b) < STEEPEST else b
        dx[lane + k] = a
        dy[lane + k] = b
        inverse_dx[lane + k] = _f4(1) / a
        inverse_dy[lane + k] = _f4(1) / b
        edge_x[lane + k] = ((_f4(1) if a > _f4(0) else _f4(0)) - x0) * inverse_dx[lane + k]
        edge_y[lane + k] = ((_f4(1) if b > _f4(0) else _f4(0)) - y0) * inverse_dy[lane + k]


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
def cast_walls(atlas, track, x, y, yaw, beam_cos, beam_sin, max_range, ranges_out):
    """Range of every beam to the nearest wall, at most `max_range`.

    Args:
        atlas, track: the tracks and the number of this one.
        x, y, yaw: pose of the scanner in the map frame [m, m, rad].
        beam_cos, beam_sin: from `beam_directions`.
        max_range: [m].
        ranges_out: (beams,) [m].
    """
    beam = carray(_lanes(), LANES * SLOTS)  # of each slot: its first beam; one that does not exist if idle
    t = carray(_lanes(), LANES * SLOTS)  # [cells] how far each ray has come
    dx = carray(_lanes(), LANES * SLOTS)  # direction
    dy = carray(_lanes(), LANES * SLOTS)
    inverse_dx = carray(_lanes(), LANES * SLOTS)
    inverse_dy = carray(_lanes(), LANES * SLOTS)
    edge_x = carray(_lanes(), LANES * SLOTS)  # column c is left at t = c / dx + edge_x
    edge_y = carray(_lanes(), LANES * SLOTS)  # row r at t = r / dy + edge_y

    width = atlas.index[track, GRID_WIDTH]
    height = atlas.index[track, GRID_HEIGHT]
    first_word = atlas.index[track, FIRST_WORD]
    words = atlas.words[first_word : first_word + width * ((height + 7) >> 3)]
    pitch = _u4(width)
    col, row = to_grid(atlas.frame, track, x, y)
    x0 = _f4(min(max(col, 0.5), width - 0.5))
    y0 = _f4(min(max(row, 0.5), height - 0.5))
    here = cell_clearance(atlas.words, first_word, width, int(x0), int(y0))
    clear = _f4(0 if here == WALL else here)  # every beam may begin with this
    resolution = _f4(atlas.frame[track, RESOLUTION])
    yaw_in_grid = yaw - math.atan2(atlas.frame[track, SIN], atlas.frame[track, COS])
    cos = _f4(math.cos(yaw_in_grid))
    sin = _f4(math.sin(yaw_in_grid))

    beams = ranges_out.shape[0]
    waiting = 0  # the first beam that no slot has had
    for slot in range(SLOTS):
        beam[slot] = waiting
        _aim(
            slot * LANES, waiting, clear, x0, y0, cos, sin, beam_cos, beam_sin,
            t, dx, dy, inverse_dx, inverse_dy, edge_x, edge_y,
        )  # fmt: skip
        waiting += LANES
    idle = 0
    while idle < SLOTS:
        idle = 0
        for slot in range(SLOTS):
            lane = slot * LANES
            first = int(beam[slot])
            if first >= beams:
                idle += 1
                continue
            marching = _u4(0)
            for k in range(LANES):
                # All integers are cast to 32 bits at every step: wider ones halve the lanes of a register.
                now = t[lane + k]
                i = np.int32(x0 + now * dx[lane + k])
                j = np.int32(y0 + now * dy[lane + k])
                v = _u4(j)
                word = words[_u4(_u4(_u4(_u4(v >> _u4(3)) * pitch) + _u4(i)) & _u4(0x7FFFFFFF))]
                clearance = _u4(_u4(word >> _u4(_u4(v & _u4(7)) << _u4(2))) & _u4(15))
                out_x = _f4(i) * inverse_dx[lane + k] + edge_x[lane + k]
                out_y = _f4(j) * inverse_dy[lane + k] + edge_y[lane + k]
                out = out_x if out_x < out_y else out_y
                out = out if out > now else now
                free = clearance != _u4(15)
                t[lane + k] = out + (_f4(np.int32(clearance)) + OVERSTEP) if free else now
                marching = _u4(marching + _u4(free))
            if marching == _u4(0):
                if first + LANES <= beams:
                    for k in range(LANES):
                        ranges_out[_u8(first + k)] = min(t[lane + k] * resolution, max_range)
                else:
                    for k in range(beams - first):
                        ranges_out[_u8(first + k)] = min(t[lane + k] * resolution, max_range)
                beam[slot] = waiting
                _aim(
                    lane, waiting, clear, x0, y0, cos, sin, beam_cos, beam_sin,
                    t, dx, dy, inverse_dx, inverse_dy, edge_x, edge_y,
                )  # fmt: skip
                waiting += LANES


@njit(cache=True, error_model="numpy", fastmath=FASTMATH)
def cast_car(x, y, yaw, beam_cos, beam_sin, other_x, other_y, other_yaw, half_length, half_width, ranges_io):
    """Shorten the ranges of beams that meet another car's rectangle first.

    Args:
        x, y, yaw: pose of the scanner [m, m, rad].
        beam_cos, beam_sin: from `beam_directions`.
        other_x, other_y, other_yaw: pose of the other car [m, m, rad].
        half_length, half_width: of its body [m].
        ranges_io: (beams,) [m].
    """
    # In the other car's frame its body is a box about the origin: the slab test (Kay and Kajiya, 1986).
    cos_other = math.cos(other_yaw)
    sin_other = math.sin(other_yaw)
    ox = _f4(cos_other * (x - other_x) + sin_other * (y - other_y))
    oy = _f4(cos_other * (y - other_y) - sin_other * (x - other_x))
    cos = _f4(math.cos(yaw - other_yaw))
    sin = _f4(math.sin(yaw - other_yaw))
    hl = _f4(half_length)
    hw = _f4(half_width)
    for k in range(ranges_io.shape[0]):
        a = cos * beam_cos[k] - sin * beam_sin[k]
        b = sin * beam_cos[k] + cos * beam_sin[k]
        a = _f4(1) / (_f4(1e-9) if abs(a) < _f4(1e-9) else a)
        b = _f4(1) / (_f4(1e-9) if abs(b) < _f4(1e-9) else b)
        near_x = (-hl - ox) * a
        far_x = (hl - ox) * a
        near_y = (-hw - oy) * b
        far_y = (hw - oy) * b
        near = max(min(near_x, far_x), min(near_y, far_y))
        far = min(max(near_x, far_x), max(near_y, far_y))
        near = max(near, _f4(0))
        if (near <= far) & (near < ranges_io[k]):
            ranges_io[k] = near


@njit(cache=True, error_model="numpy")
def apply_sensor_noise(p, key, ranges_io):
    """Add a car's sensor errors to its ranges: bias, Gaussian noise, dropout; then keep them in range.

    A beam that met nothing within the maximum range, or that drops out, reads the maximum range.

    Args:
        p: the car's parameters.
        key: uint64, new for every scan.
        ranges_io: (beams,) [m].
    """
    farthest = p.max_range
    if p.noise_std == 0.0 and p.bias == 0.0 and p.dropout == 0.0:
        return
    dropped = np.uint64(np.float64(p.dropout) * 2.0**32)
    for k in range(ranges_io.shape[0]):
        bits = hash64(key, np.uint64(k))
        value = ranges_io[k]
        if value < farthest:
            noise = NORMAL[bits & np.uint64(QUANTILES - 1)]
            value = min(max(value + p.bias + p.noise_std * noise, _f4(0)), farthest)
        if (bits >> np.uint64(32)) < dropped:
            value = farthest
        ranges_io[k] = value
