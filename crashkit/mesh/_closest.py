"""Compiled geometry of probe maps: closest points on triangles, segments and lone nodes, found along the graph."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def _on_segment(p, a, b):
    """Weight of b at the point of the segment a-b closest to p."""
    along = 0.0
    length2 = 0.0
    for k in range(3):
        d = b[k] - a[k]
        along += d * (p[k] - a[k])
        length2 += d * d
    if length2 <= 0.0:
        return 0.0
    return min(1.0, max(0.0, along / length2))


@njit(cache=True)
def _distance2(p, at, cell, w):
    total = 0.0
    for k in range(3):
        d = -p[k]
        for corner in range(3):
            if cell[corner] >= 0:
                d += w[corner] * at[cell[corner], k]
        total += d * d
    return total


@njit(cache=True)
def weights_on(p, at, cell, w):
    """Barycentric weights `w` (3,) of the point of `cell` closest to p, clamped; returns the squared distance.

    A cell has three nodes (triangle), two (segment) or one; -1 fills the rest. A degenerate triangle is the union of
    its sides.
    """
    w[0], w[1], w[2] = 1.0, 0.0, 0.0
    if cell[1] < 0:
        return _distance2(p, at, cell, w)
    a, b = at[cell[0]], at[cell[1]]
    if cell[2] < 0:
        t = _on_segment(p, a, b)
        w[0], w[1] = 1.0 - t, t
        return _distance2(p, at, cell, w)
    c = at[cell[2]]
    # Inside: solve for the foot of the perpendicular.
    aa, ab, bb, ap, bp = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        e, f, g = b[k] - a[k], c[k] - a[k], p[k] - a[k]
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
            w[0], w[1], w[2] = max(0.0, 1.0 - v - u), v, u
            return _distance2(p, at, cell, w)
    # Outside or degenerate: the closest of the three sides.
    t0, t1, t2 = _on_segment(p, a, b), _on_segment(p, b, c), _on_segment(p, c, a)
    best = np.inf
    keep = 0
    for side in range(3):
        if side == 0:
            w[0], w[1], w[2] = 1.0 - t0, t0, 0.0
        elif side == 1:
            w[0], w[1], w[2] = 0.0, 1.0 - t1, t1
        else:
            w[0], w[1], w[2] = t2, 0.0, 1.0 - t2
        d = _distance2(p, at, cell, w)
        if d < best:
            best, keep = d, side
    if keep == 0:
        w[0], w[1], w[2] = 1.0 - t0, t0, 0.0
    elif keep == 1:
        w[0], w[1], w[2] = 0.0, 1.0 - t1, t1
    else:
        w[0], w[1], w[2] = t2, 0.0, 1.0 - t2
    return best


@njit(cache=True)
def settle(points, start, candidate, at, cells, cell_start, cell_list, near_start, near_list, hops):
    """Weights of each point on its cell, taking `candidate` where the graph agrees that it is near.

    points (n, 3); start (n,): the coarse node that stands for each point; candidate (n,): closest cell found without
    regard to the graph, -1 where none. `cell_start`, `cell_list`: cells of each coarse node, `near_start`,
    `near_list`: its graph neighbours. A candidate none of whose nodes can be reached from `start` within `hops` edges
    lies on another sheet; the closest cell among those reached stands in for it.

    Returns cell (n,), weights (n, 3), squared distance (n,) and whether the candidate was overruled (n,).
    """
    n = len(points)
    cell_of = np.empty(n, np.int64)
    weights = np.zeros((n, 3))
    distance2 = np.empty(n)
    overruled = np.zeros(n, np.bool_)
    seen = np.full(len(at), -1, np.int64)
    looked = np.full(len(cells), -1, np.int64)
    reached = np.empty(len(at), np.int64)
    w = np.empty(3)
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
                        d = weights_on(points[i], at, cells[other], w)
                        if d < best:
                            best, c = d, other
            overruled[i] = True
        distance2[i] = weights_on(points[i], at, cells[c], w)
        cell_of[i] = c
        weights[i] = w
    return cell_of, weights, distance2, overruled
