"""Compiled local searches: other kept nodes, and other diagonals, where that makes a level lift better."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crashkit.mesh._closest import closest_weights
from data_schema.compiled import compiled


class Coarse(NamedTuple):
    """The coarse mesh: lists `x_list[x_start[v]:x_start[v + 1]]` of its vertices v.

    at (k, 3); cells (c, 3), padded with -1, and their part; cells at each vertex; its graph neighbours; the finer
    nodes that were contracted into it.
    """

    at: NDArray[Any]
    cells: NDArray[Any]
    cell_part: NDArray[Any]
    cell_start: NDArray[Any]
    cell_list: NDArray[Any]
    near_start: NDArray[Any]
    near_list: NDArray[Any]
    member_start: NDArray[Any]
    member_list: NDArray[Any]


class Finer(NamedTuple):
    """The nodes of the finer level.

    at (n, 3); weight (n,): nodes of level 0 each stands for; parts (n, words) bit sets and kind (n,), equal where they
    are; into (n,): coarse vertex each belongs to; graph neighbours.
    """

    at: NDArray[Any]
    weight: NDArray[Any]
    parts: NDArray[Any]
    kind: NDArray[Any]
    into: NDArray[Any]
    near_start: NDArray[Any]
    near_list: NDArray[Any]


@compiled
def _at_least(points: NDArray[Any], x: int, at: NDArray[Any], cells: NDArray[Any], c: int) -> float:
    """Squared distance of x to the box around cell c: cheap, and never more than that to the cell."""
    total = 0.0
    for k in range(3):
        low = high = at[cells[c, 0], k]
        for corner in range(1, 3):
            v = cells[c, corner]
            if v >= 0:
                low = min(low, at[v, k])
                high = max(high, at[v, k])
        gap = max(low - points[x, k], points[x, k] - high)
        if gap > 0.0:
            total += gap * gap
    return total


@compiled
def _closer(
    points: NDArray[Any], parts: NDArray[Any], x: int, at: NDArray[Any], cells: NDArray[Any], cell_part: NDArray[Any], c: int, best: float,
    radius: float,
) -> tuple[float, float]:  # fmt: skip
    """Squared distance of x to cell c and what lifting may cost there; inf unless closer than `best` and of its part.

    With p the closest point and s = sum_i w_i |x_i - p|^2, a field u is lifted to x with an error of at most
    max|grad u| |x - p| + max|hess u| s / 2. The cost is this for a field that turns over on the length `radius`;
    for s beyond radius^2 it grows with the root of s, since no field moves more than its own amplitude.
    """
    part = cell_part[c]
    if (parts[x, part // 64] >> np.uint64(part % 64)) & np.uint64(1) == np.uint64(0):
        return np.inf, np.inf
    if _at_least(points, x, at, cells, c) >= best:
        return np.inf, np.inf
    w0, w1, w2, d2 = closest_weights(points, x, at, cells, c)
    if d2 >= best:
        return np.inf, np.inf
    s = -d2
    for k in range(3):
        s += w0 * (at[cells[c, 0], k] - points[x, k]) ** 2
        if w1 > 0.0:
            s += w1 * (at[cells[c, 1], k] - points[x, k]) ** 2
        if w2 > 0.0:
            s += w2 * (at[cells[c, 2], k] - points[x, k]) ** 2
    s = max(s, 0.0)
    return d2, np.sqrt(d2) + s / (2.0 * radius + np.sqrt(s))


@compiled
def _touches(cells: NDArray[Any], c: int, v: int) -> bool:
    return bool(cells[c, 0] == v or cells[c, 1] == v or cells[c, 2] == v)


@compiled
def _closest_around(x: int, avoid: int, finer: Finer, coarse: Coarse, radius: float) -> tuple[int, float, float]:
    """Closest cell around the vertex of x, none of those at vertex `avoid`: cell, squared distance, cost."""
    best, best_d2, best_cost = -1, np.inf, np.inf
    own = finer.into[x]
    for k in range(coarse.near_start[own] - 1, coarse.near_start[own + 1]):
        v = own if k < coarse.near_start[own] else coarse.near_list[k]
        if v == avoid:
            continue
        for j in range(coarse.cell_start[v], coarse.cell_start[v + 1]):
            c = coarse.cell_list[j]
            if avoid >= 0 and _touches(coarse.cells, c, avoid):
                continue
            d2, cost = _closer(finer.at, finer.parts, x, coarse.at, coarse.cells, coarse.cell_part, c, best_d2, radius)
            if d2 < best_d2:
                best, best_d2, best_cost = c, d2, cost
    return best, best_d2, best_cost


@compiled
def _region(p: int, coarse: Coarse) -> NDArray[Any]:
    """The finer nodes that belong to p and its neighbours."""
    size = coarse.member_start[p + 1] - coarse.member_start[p]
    for j in range(coarse.near_start[p], coarse.near_start[p + 1]):
        v = coarse.near_list[j]
        size += coarse.member_start[v + 1] - coarse.member_start[v]
    out = np.empty(size, np.int64)
    size = 0
    for j in range(coarse.near_start[p] - 1, coarse.near_start[p + 1]):
        v = p if j < coarse.near_start[p] else coarse.near_list[j]
        for i in range(coarse.member_start[v], coarse.member_start[v + 1]):
            out[size] = coarse.member_list[i]
            size += 1
    return out


@compiled
def _any_around(p: int, marked: NDArray[Any], coarse: Coarse) -> bool:
    """Whether p or a neighbour is marked."""
    if marked[p]:
        return True
    for j in range(coarse.near_start[p], coarse.near_start[p + 1]):  # noqa: SIM110 - numba has no generators here
        if marked[coarse.near_list[j]]:
            return True
    return False


@compiled
def closest_cells_around(
    finer: Finer, coarse: Coarse, radius: float
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """For each finer node the closest cell around its vertex, the squared distance to it and the cost of lifting."""
    cell, d2, cost = np.empty(len(finer.at), np.int64), np.empty(len(finer.at)), np.empty(len(finer.at))
    for x in range(len(finer.at)):
        cell[x], d2[x], cost[x] = _closest_around(x, -1, finer, coarse, radius)
    return cell, d2, cost


@compiled
def relocate(
    finer: Finer, coarse: Coarse, chosen: NDArray[Any], stirred: NDArray[Any], radius: float,
    cell: NDArray[Any], d2: NDArray[Any], cost: NDArray[Any],
) -> NDArray[Any]:  # fmt: skip
    """Move each coarse vertex to the finer node beside it that most lowers the summed squared lifting cost around it.

    chosen (k,): finer node of each coarse vertex; it, `coarse.at` and the three arrays of `closest_cells_around` are
    changed in place. A vertex only goes to nodes of the same parts that no other vertex sits on. Where nothing was
    `stirred` (k,) at a vertex or its neighbours since the last time, nothing better can be found, and none is sought.
    Returns which vertices moved (k,).
    """
    points, parts, at, cells, cell_part = finer.at, finer.parts, coarse.at, coarse.cells, coarse.cell_part
    taken = np.zeros(len(finer.at), np.bool_)
    taken[chosen] = True
    moved = np.zeros(len(chosen), np.bool_)
    for p in range(len(chosen)):
        if not _any_around(p, stirred, coarse):
            continue
        region = _region(p, coarse)
        # Without p's own cells first: they are what moves.
        for x in region:
            if cell[x] >= 0 and _touches(cells, cell[x], p):
                cell[x], d2[x], cost[x] = _closest_around(x, p, finer, coarse, radius)
        here = chosen[p]
        best, best_total = here, np.inf
        for j in range(finer.near_start[here] - 1, finer.near_start[here + 1]):
            candidate = here if j < finer.near_start[here] else finer.near_list[j]
            if candidate != here and (taken[candidate] or finer.kind[candidate] != finer.kind[here]):
                continue
            for k in range(3):
                at[p, k] = points[candidate, k]
            total = 0.0
            for x in region:
                x_d2, x_cost = d2[x], cost[x]
                for n in range(coarse.cell_start[p], coarse.cell_start[p + 1]):
                    c_d2, c_cost = _closer(points, parts, x, at, cells, cell_part, coarse.cell_list[n], x_d2, radius)
                    if c_d2 < x_d2:
                        x_d2, x_cost = c_d2, c_cost
                total += finer.weight[x] * x_cost * x_cost
                if total >= best_total:
                    break
            # Less by a hair is rounding; moving for it would make the result depend on it.
            if total < best_total * (1.0 - 1e-9):
                best, best_total = candidate, total
        for k in range(3):
            at[p, k] = points[best, k]
        for x in region:
            for n in range(coarse.cell_start[p], coarse.cell_start[p + 1]):
                c_d2, c_cost = _closer(points, parts, x, at, cells, cell_part, coarse.cell_list[n], d2[x], radius)
                if c_d2 < d2[x]:
                    cell[x], d2[x], cost[x] = coarse.cell_list[n], c_d2, c_cost
        if best != here:
            taken[here], taken[best] = False, True
            chosen[p] = best
            moved[p] = True
    return moved


@compiled
def flip_gains(
    finer: Finer, coarse: Coarse, pairs: NDArray[Any], corners: NDArray[Any], stirred: NDArray[Any], radius: float,
    cell: NDArray[Any], d2: NDArray[Any], cost: NDArray[Any],
) -> NDArray[Any]:  # fmt: skip
    """How much the summed squared lifting cost falls if the common edge of two triangles is turned, (q,).

    pairs (q, 2): the two cells; corners (q, 4) = a, b, c, d with the cells a b c and b a d, which become a d c and
    d b c. The last two rows of `coarse.cells` are room for these. Every flip is judged as if it were the only one.
    Zero where nothing was `stirred` (k,) around; `cell`, `d2`, `cost` as from `closest_cells_around`.
    """
    points, parts, at, cells, cell_part = finer.at, finer.parts, coarse.at, coarse.cells, coarse.cell_part
    new = len(cells) - 2
    gains = np.zeros(len(pairs))
    for q in range(len(pairs)):
        a, b, c, d = corners[q]
        if not (
            _any_around(a, stirred, coarse)
            or _any_around(b, stirred, coarse)
            or _any_around(c, stirred, coarse)
            or _any_around(d, stirred, coarse)
        ):
            continue
        cells[new, 0], cells[new, 1], cells[new, 2] = a, d, c
        cells[new + 1, 0], cells[new + 1, 1], cells[new + 1, 2] = d, b, c
        cell_part[new] = cell_part[new + 1] = cell_part[pairs[q, 0]]
        for corner in corners[q]:
            for i in range(coarse.member_start[corner], coarse.member_start[corner + 1]):
                x = coarse.member_list[i]
                x_d2, x_cost = d2[x], cost[x]
                if cell[x] in (pairs[q, 0], pairs[q, 1]):
                    x_d2, x_cost = _closest_but(x, pairs[q, 0], pairs[q, 1], finer, coarse, radius)
                for n in (new, new + 1):
                    n_d2, n_cost = _closer(points, parts, x, at, cells, cell_part, n, x_d2, radius)
                    if n_d2 < x_d2:
                        x_d2, x_cost = n_d2, n_cost
                gains[q] += finer.weight[x] * (cost[x] * cost[x] - x_cost * x_cost)
    return gains


@compiled
def _closest_but(x: int, one: int, two: int, finer: Finer, coarse: Coarse, radius: float) -> tuple[float, float]:
    """Squared distance and cost of the closest cell around the vertex of x that is neither `one` nor `two`."""
    best_d2, best_cost = np.inf, np.inf
    own = finer.into[x]
    for k in range(coarse.near_start[own] - 1, coarse.near_start[own + 1]):
        v = own if k < coarse.near_start[own] else coarse.near_list[k]
        for j in range(coarse.cell_start[v], coarse.cell_start[v + 1]):
            c = coarse.cell_list[j]
            if c in (one, two):
                continue
            d2, cost = _closer(finer.at, finer.parts, x, coarse.at, coarse.cells, coarse.cell_part, c, best_d2, radius)
            if d2 < best_d2:
                best_d2, best_cost = d2, cost
    return best_d2, best_cost
