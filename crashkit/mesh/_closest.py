"""Compiled geometry of probe maps: closest points on triangles, segments and lone nodes, found along the graph."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_schema.compiled import compiled


@compiled
def _on_segment(points: NDArray[Any], i: int, at: NDArray[Any], a: int, b: int) -> float:
    """Weight of b at the point of the segment a-b closest to point i."""
    along = 0.0
    length2 = 0.0
    for k in range(3):
        d = at[b, k] - at[a, k]
        along += d * (points[i, k] - at[a, k])
        length2 += d * d
    if length2 <= 0.0:
        return 0.0
    return min(1.0, max(0.0, along / length2))


@compiled
def _to_segment2(points: NDArray[Any], i: int, at: NDArray[Any], a: int, b: int, t: float) -> float:
    """Squared distance of point i to the point (1 - t) a + t b."""
    total = 0.0
    for k in range(3):
        d = (1.0 - t) * at[a, k] + t * at[b, k] - points[i, k]
        total += d * d
    return total


@compiled
def closest_weights(
    points: NDArray[Any], i: int, at: NDArray[Any], cells: NDArray[Any], cell: int
) -> tuple[float, float, float, float]:
    """Barycentric weights of the point of a cell closest to point i, clamped to the cell, and its squared distance.

    A cell has three nodes (triangle), two (segment) or one; -1 fills the rest. A degenerate triangle is the union of
    its sides. Everything is passed as arrays and numbers of rows: numba is slow at rows as arrays of their own.
    """
    a, b, c = cells[cell, 0], cells[cell, 1], cells[cell, 2]
    if b < 0:
        return 1.0, 0.0, 0.0, _to_segment2(points, i, at, a, a, 0.0)
    t0 = _on_segment(points, i, at, a, b)
    if c < 0:
        return 1.0 - t0, t0, 0.0, _to_segment2(points, i, at, a, b, t0)
    # Inside: the foot of the perpendicular.
    aa, ab, bb, ap, bp = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        e, f, g = at[b, k] - at[a, k], at[c, k] - at[a, k], points[i, k] - at[a, k]
        aa += e * e
        ab += e * f
        bb += f * f
        ap += e * g
        bp += f * g
    det = aa * bb - ab * ab
    if det > 1e-14 * aa * bb:
        v = (bb * ap - ab * bp) / det
        u = (aa * bp - ab * ap) / det
        if v >= 0.0 and u >= 0.0 and v + u <= 1.0:
            d2 = 0.0
            for k in range(3):
                d = (1.0 - v - u) * at[a, k] + v * at[b, k] + u * at[c, k] - points[i, k]
                d2 += d * d
            return 1.0 - v - u, v, u, d2
    # Outside or degenerate: the closest of the three sides.
    t1, t2 = _on_segment(points, i, at, b, c), _on_segment(points, i, at, c, a)
    d0, d1, d2 = (
        _to_segment2(points, i, at, a, b, t0),
        _to_segment2(points, i, at, b, c, t1),
        _to_segment2(points, i, at, c, a, t2),
    )
    if d0 <= d1 and d0 <= d2:
        return 1.0 - t0, t0, 0.0, d0
    if d1 <= d2:
        return 0.0, 1.0 - t1, t1, d1
    return t2, 0.0, 1.0 - t2, d2


@compiled
def settle(
    points: NDArray[Any], start: NDArray[Any], candidate: NDArray[Any], at: NDArray[Any], cells: NDArray[Any], cell_start: NDArray[Any],
    cell_list: NDArray[Any], near_start: NDArray[Any], near_list: NDArray[Any], hops: int,
) -> tuple[NDArray[Any], NDArray[Any]]:  # fmt: skip
    """Weights of each point on its cell, taking `candidate` where the graph agrees that it is near.

    points (n, 3); start (n,): the coarse node that stands for each point; candidate (n,): closest cell found without
    regard to the graph, -1 where none. `cell_start`, `cell_list`: cells of each coarse node, `near_start`,
    `near_list`: its graph neighbours. A candidate none of whose nodes can be reached from `start` within `hops` edges
    lies on another sheet; the closest cell among those reached stands in for it.

    Returns cell (n,) and weights (n, 3).
    """
    n = len(points)
    cell_of = np.empty(n, np.int64)
    weights = np.zeros((n, 3))
    seen = np.full(len(at), -1, np.int64)
    looked = np.full(len(cells), -1, np.int64)
    reached = np.empty(len(at), np.int64)
    for i in range(n):
        reached[0] = start[i]
        seen[start[i]] = i
        count, ring = 1, 0
        for _ in range(hops):
            end = count
            for k in range(ring, end):
                for j in range(near_start[reached[k]], near_start[reached[k] + 1]):
                    r = near_list[j]
                    if seen[r] != i:
                        seen[r] = i
                        reached[count] = r
                        count += 1
            ring = end
        c = candidate[i]
        good = False
        if c >= 0:
            for corner in range(3):
                if cells[c, corner] >= 0 and seen[cells[c, corner]] == i:
                    good = True
        if not good:
            best = np.inf
            for k in range(count):
                for j in range(cell_start[reached[k]], cell_start[reached[k] + 1]):
                    other = cell_list[j]
                    if looked[other] != i:
                        looked[other] = i
                        d = closest_weights(points, i, at, cells, other)[3]
                        if d < best:
                            best, c = d, other
        weights[i, 0], weights[i, 1], weights[i, 2], _ = closest_weights(points, i, at, cells, c)
        cell_of[i] = c
    return cell_of, weights
