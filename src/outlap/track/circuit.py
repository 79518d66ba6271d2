"""The centreline of a random closed circuit.

A circuit starts as a polygon: the shortest tour (2-opt) through random points, which never crosses
itself and folds back on itself as circuits do. Hairpins are pulled out of short edges, chicanes and
esses put into long ones. Every vertex then becomes a corner of clothoid, arc, clothoid that touches
both its edges, so the curvature is continuous, known exactly and bounded by construction; what is
left of an edge is a straight. The polygon is scaled until the length is right.

Points are complex numbers in this file: x + iy [m].
"""

# SciPy has no type stubs:
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from outlap.errors import OutlapError

WALL = 0.5  # [m] least thickness of the wall between two stretches of track
KNOT_SPACING = 0.1  # [m] between points; less where min_radius is below 1.5 m
RAMP = 0.5  # share of a corner's turn that its two clothoids take; the arc between them takes the rest
HAIRPIN = math.radians(130)  # [rad] a vertex that turns more than this stays tight
SHARPEST = math.radians(165)  # [rad] turn of one corner; its tangents grow without bound towards 180°
PLAIN_AFTER = 200  # attempts; then only near-rings are tried
ATTEMPTS = 300


def _gauss_legendre(nodes: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Nodes and weights on [0, 1]."""
    x, weights = np.polynomial.legendre.leggauss(nodes)
    return (x + 1) / 2, weights / 2


QUADRATURE = _gauss_legendre(16)  # over a whole clothoid or arc
FINE_QUADRATURE = _gauss_legendre(4)  # over one knot spacing


def circuit_points(
    seed: int, length: float, width: float, min_radius: float, clockwise: bool | None = None
) -> np.ndarray:
    """The centreline's knots (n, 2) [m], evenly spaced, the first at (0, 0) and not repeated at the end.

    Raises:
        OutlapError: no circuit was found within a bounded number of attempts.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    drawn_clockwise = bool(rng.integers(2))
    clockwise = drawn_clockwise if clockwise is None else clockwise
    clearance = width + WALL
    round_corners = 2 * math.pi * max(min_radius, clearance / 2)
    long_straight = min(30.0, max(0.0, length - 1.3 * round_corners) / 9)
    spacing = min(KNOT_SPACING, min_radius / 15)
    corners = length / rng.uniform(20, 45)
    for attempt in range(ATTEMPTS):
        # What does not fit gets simpler.
        simpler = 1 - attempt / PLAIN_AFTER
        if simpler > 0:
            sketch = _draw_sketch(rng, corners * simpler, length * simpler, min_radius)
        else:
            sketch = _draw_plain_sketch(rng)
        corner_radii = _scale_to_length(sketch, length, min_radius, clearance)
        if corner_radii is None:
            continue
        vertices, radii = corner_radii
        if (_signed_area(vertices) < 0) != clockwise:
            vertices, radii = vertices[::-1], radii[::-1]
        points, longest = _trace(vertices, radii, spacing)
        if longest >= long_straight and _keeps_clear(points, length, clearance):
            return np.column_stack((np.real(points), np.imag(points)))
    raise OutlapError(
        f"generate_track: length is {length} with width {width} and min_radius {min_radius}; none of"
        f" {ATTEMPTS} circuits fits: give a greater length, a smaller min_radius or a smaller width"
    )


@dataclass(frozen=True)
class _Zigzag:
    """A chicane (two vertices) or esses (more) put into an edge, in metres whatever the polygon's scale."""

    edge: int
    place: float  # of its middle, as a share of the edge
    vertices: int
    turn: float  # [rad] between the zigzag's diagonals and the edge
    diagonal: float  # [m]
    side: int  # ±1: goes left or right first


@dataclass(frozen=True)
class _Sketch:
    polygon: np.ndarray  # (n,) complex, of any scale
    zigzags: tuple[_Zigzag, ...]
    generosity: np.ndarray  # in [0, 1], at least one for each corner: how wide it is, of what fits
    curviness: np.ndarray  # in [0, 1], at least one for each edge: how much of it corners may take
    widest: float  # [m] radius


def _draw_sketch(rng: np.random.Generator, corners: float, length: float, min_radius: float) -> _Sketch:
    count = max(3, round(corners))
    squeeze = rng.uniform(0.4, 1.0)  # real circuits are long and narrow as often as not
    polygon = _shortest_tour(rng.uniform(size=count) + 1j * squeeze * rng.uniform(size=count))
    for _ in range(min(int(rng.integers(1, 4)), round(length / max(120, 40 * min_radius)))):
        polygon = _pull_hairpin(rng, polygon)
    polygon = polygon * np.exp(1j * rng.uniform(0, 2 * np.pi))
    edges = np.abs(np.roll(polygon, -1) - polygon)
    longest_first = np.argsort(-edges)
    zigzags: list[_Zigzag] = []
    # The longest edge stays whole: it is the main straight.
    for edge in longest_first[1:][: min(int(rng.integers(1, 4)), round(length / max(100, 40 * min_radius)))]:
        esses = rng.uniform() < 0.3
        low, high = (20, 45) if esses else (40, 75)
        turn = rng.uniform(math.radians(low), math.radians(high))
        diagonal = 2 * _least_radius(turn, min_radius) * _tangent(turn) * rng.uniform(1.2, 2.0)
        zigzags.append(
            _Zigzag(
                edge=int(edge),
                place=rng.uniform(0.3, 0.7),
                vertices=int(rng.integers(3, 6)) if esses else 2,
                turn=turn,
                diagonal=float(diagonal) + (5.0 if esses else 0.5),
                side=int(rng.choice((-1, 1))),
            )
        )
    return _finish_sketch(rng, polygon, tuple(zigzags))


def _draw_plain_sketch(rng: np.random.Generator) -> _Sketch:
    """Little more than a ring, for arguments that leave no room for anything else."""
    count = int(rng.integers(3, 6))
    ring = np.exp(2j * np.pi * np.arange(count) / count) * rng.uniform(0.9, 1.1, size=count)
    return _finish_sketch(rng, ring * np.exp(1j * rng.uniform(0, 2 * np.pi)), ())


def _finish_sketch(rng: np.random.Generator, polygon: np.ndarray, zigzags: tuple[_Zigzag, ...]) -> _Sketch:
    most = len(polygon) + sum(zigzag.vertices for zigzag in zigzags)
    return _Sketch(
        polygon=polygon,
        zigzags=zigzags,
        generosity=rng.uniform(size=most) ** rng.uniform(0.15, 1.5),
        curviness=rng.uniform(0.35, 1.0, size=most),
        widest=10 ** rng.uniform(1.2, 2.0),
    )


def _shortest_tour(points: np.ndarray) -> np.ndarray:
    """2-opt: exchange pairs of edges until none shortens the tour, which then cannot cross itself."""
    tour = list(points)
    count = len(tour)
    improved = True
    while improved:
        improved = False
        for i in range(count - 1):
            for j in range(i + 2, count if i else count - 1):
                a, b, c, d = tour[i], tour[i + 1], tour[j], tour[(j + 1) % count]
                if abs(a - c) + abs(b - d) < abs(a - b) + abs(c - d) - 1e-12:
                    tour[i + 1 : j + 1] = tour[i + 1 : j + 1][::-1]
                    improved = True
    return np.array(tour)


def _pull_hairpin(rng: np.random.Generator, polygon: np.ndarray) -> np.ndarray:
    """Put a far vertex into one of the shorter edges: the track goes there and back."""
    edges = np.roll(polygon, -1) - polygon
    shorter = np.argsort(np.abs(edges))[: max(1, len(edges) // 2)]
    for _ in range(8):
        i = int(rng.choice(shorter))
        opening = np.radians(rng.uniform(18, 30))
        height = 0.5 / np.tan(opening / 2)
        apex = polygon[i] + edges[i] * (0.5 + 1j * height * rng.choice((-1, 1)))
        spiked = np.insert(polygon, i + 1, apex)
        if abs(edges[i]) * height < 0.5 and not _crosses_itself(spiked):
            return spiked
    return polygon


def _crosses_itself(polygon: np.ndarray) -> bool:
    a, b = polygon[:, None], np.roll(polygon, -1)[:, None]
    c, d = a.T, b.T

    def side(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
        return np.sign(np.imag((q - p).conj() * (r - p)))

    return bool(np.any((side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a) * side(c, d, b) < 0)))


def _signed_area(polygon: np.ndarray) -> float:
    """[m²], positive if anticlockwise."""
    return float(np.sum(np.imag(polygon.conj() * np.roll(polygon, -1))) / 2)


def _at_scale(sketch: _Sketch, scale: float) -> np.ndarray:
    """The sketch's vertices in metres, zigzags included."""
    polygon = sketch.polygon * scale
    vertices: list[complex] = []
    for i, start in enumerate(polygon):
        vertices.append(start)
        edge = polygon[(i + 1) % len(polygon)] - start
        for zigzag in sketch.zigzags:
            if zigzag.edge == i:
                along = edge / abs(edge)
                step = zigzag.diagonal * np.exp(1j * zigzag.turn)
                order = np.arange(zigzag.vertices)
                offsets = step.real * (order - order.mean()) + 0.5j * step.imag * zigzag.side * (-1) ** order
                vertices.extend(start + edge * zigzag.place + along * offsets)
    return np.array(vertices)


def _corner_lengths(turn: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Lengths of each clothoid and of the arc, for a corner of radius 1 that turns by `turn` [rad]."""
    turn = np.abs(turn)
    return RAMP * turn, (1 - RAMP) * turn


def _tangent(turn: np.ndarray | float) -> np.ndarray:
    """From a corner's vertex to where its curve touches the edge, for radius 1; `turn` [rad] below π."""
    turn = np.abs(np.atleast_1d(turn)).astype(float)
    share, weights = QUADRATURE
    ramp, arc = (lengths[:, None] for lengths in _corner_lengths(turn))
    # The curve is symmetric about its middle, so half of it gives the chord: ∫ cos(heading − turn/2) ds.
    clothoid = np.sum(weights * np.cos(ramp * share**2 / 2 - turn[:, None] / 2), axis=1) * ramp[:, 0]
    half_arc = np.sum(weights * np.cos(arc / 2 * share), axis=1) * arc[:, 0] / 2
    return np.squeeze((clothoid + half_arc) / np.cos(turn / 2))


def _scale_to_length(
    sketch: _Sketch, length: float, min_radius: float, clearance: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices (n,) and corner radii (n,) [m] of a circuit as long as asked; None if they do not fit."""
    scale = length / np.sum(np.abs(np.roll(sketch.polygon, -1) - sketch.polygon))
    for _ in range(12):
        vertices = _at_scale(sketch, scale)
        radii = _fit_radii(vertices, sketch, min_radius, clearance)
        if radii is None:
            return None
        found = _length(vertices, radii)
        if abs(found / length - 1) < 1e-3:
            # The rest by similarity; _fit_radii leaves room for it.
            return vertices * (length / found), radii * (length / found)
        scale *= length / found
    return None


def _turns(vertices: np.ndarray) -> np.ndarray:
    """Signed change of heading at each vertex [rad]."""
    leaving = np.roll(vertices, -1) - vertices
    return np.angle(leaving / np.roll(leaving, 1))


def _fit_radii(vertices: np.ndarray, sketch: _Sketch, min_radius: float, clearance: float) -> np.ndarray | None:
    """A radius for each corner, such that no two corners of an edge overlap."""
    turns = np.abs(_turns(vertices))
    if np.any(turns > SHARPEST) or np.any(turns < 1e-6):
        return None
    tangents = _tangent(turns)
    least = 1.01 * _least_radius(turns, min_radius)
    # The two legs of a hairpin are two radii apart, and there is a wall between them.
    least = np.where(turns > np.pi / 2, np.maximum(least, 1.01 * clearance / 2), least)
    edges = np.abs(np.roll(vertices, -1) - vertices)
    room = edges - least * tangents - np.roll(least * tangents, -1)
    if np.any(room < 0):
        return None
    # What is left of each edge goes to its two corners and to the straight between them.
    wish = sketch.generosity[: len(turns)] * np.where(turns > HAIRPIN, 0.15, 1.0)
    share = sketch.curviness[: len(turns)].copy()
    share[np.argmax(edges)] = share.min()
    spare = share * room / np.maximum(wish + np.roll(wish, -1), 1.0)
    extra = wish * np.minimum(spare, np.roll(spare, 1))
    return np.minimum(least + extra / tangents, np.maximum(sketch.widest, least))


def _least_radius(turns: np.ndarray | float, min_radius: float) -> np.ndarray:
    """A slight corner gets a wider radius, so that its clothoids are never a mere kink."""
    return min_radius * np.maximum(1.0, 1.0 / np.abs(turns))


def _length(vertices: np.ndarray, radii: np.ndarray) -> float:
    turns = _turns(vertices)
    ramps, arcs = _corner_lengths(turns)
    edges = np.abs(np.roll(vertices, -1) - vertices)
    return float(np.sum(edges) + np.sum(radii * (2 * ramps + arcs - 2 * _tangent(turns))))


def _trace(vertices: np.ndarray, radii: np.ndarray, spacing: float) -> tuple[np.ndarray, float]:
    """The curve as evenly spaced points (m,), from the middle of its longest straight; that straight [m]."""
    turns = _turns(vertices)
    tangents = radii * _tangent(turns)
    straights = np.abs(np.roll(vertices, -1) - vertices) - tangents - np.roll(tangents, -1)
    main = int(np.argmax(straights))
    first = (main + 1) % len(vertices)
    turns, radii, straights = (np.roll(values, -first) for values in (turns, radii, straights))
    ramps, arcs = (radii * lengths for lengths in _corner_lengths(turns))
    curvatures = np.sign(turns) / radii
    # Curvature is linear between the ends of these pieces: clothoid, arc, clothoid, straight, ...
    pieces = np.column_stack((ramps, arcs, ramps, straights)).ravel()
    ends = np.column_stack((curvatures, curvatures, 0 * radii, 0 * radii)).ravel()
    half = straights[-1] / 2
    pieces[-1] = half
    s = np.concatenate(((0.0, half), half + np.cumsum(pieces)))
    curvature = np.concatenate(((0.0, 0.0), ends))
    headings = np.append(0.0, np.cumsum(np.diff(s) * (curvature[1:] + curvature[:-1]) / 2))
    lap = float(s[-1])
    count = math.ceil(lap / spacing)
    step = lap / count
    share, weights = FINE_QUADRATURE
    at = (np.arange(count)[:, None] + share) * step
    piece = np.clip(np.searchsorted(s, at, side="right") - 1, 0, len(s) - 2)
    into = at - s[piece]
    slope = np.diff(curvature) / np.maximum(np.diff(s), 1e-12)
    heading = headings[piece] + curvature[piece] * into + slope[piece] * into**2 / 2
    start = np.angle(vertices[first] - vertices[main])
    directions: NDArray[np.complex128] = np.exp(1j * (heading + start))
    chords = directions @ weights * step
    chords -= np.mean(chords)  # closes what quadrature left open, under a micrometre
    return np.append(0.0, np.cumsum(chords)[:-1]), float(2 * half)


def _keeps_clear(points: np.ndarray, length: float, clearance: float) -> bool:
    """Whether parts of the curve that are not neighbours stay `clearance` [m] apart.

    On a curve with radii of at least clearance / 2, points further apart along it than a half circle
    of that radius are as far apart as its diameter, unless another part of the track comes near.
    """
    coarse = points[:: max(1, int(0.1 * clearance * len(points) / length))]
    tree = KDTree(np.column_stack((np.real(coarse), np.imag(coarse))))
    pairs = cast("NDArray[np.intp]", tree.query_pairs(clearance, output_type="ndarray"))
    apart = np.abs(pairs[:, 0] - pairs[:, 1])
    apart = np.minimum(apart, len(coarse) - apart) * length / len(coarse)
    return bool(np.all(apart <= 1.05 * math.pi / 2 * clearance))
