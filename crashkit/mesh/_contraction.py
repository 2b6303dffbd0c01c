"""Compiled half-edge contraction: the loop that selects nodes.

Plain arrays and numbers only, so that numba can compile it. Vertices carry symmetric 4x4 quadrics (ten numbers),
faces and graph edges hang in linked lists, and every vertex waits in one binary heap with its cheapest contraction.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_schema.compiled import compiled

_NONE = -1


@compiled
def _evaluate(q: NDArray[Any], x: float, y: float, z: float) -> float:
    """v^T Q v of a quadric stored as xx xy xz xw yy yz yw zz zw ww."""
    value: float = (
        q[0] * x * x + 2 * q[1] * x * y + 2 * q[2] * x * z + 2 * q[3] * x
        + q[4] * y * y + 2 * q[5] * y * z + 2 * q[6] * y
        + q[7] * z * z + 2 * q[8] * z + q[9]
    )  # fmt: skip
    return value


@compiled
def _less(cost: NDArray[Any], tie: NDArray[Any], a: int, b: int) -> bool:
    if cost[a] != cost[b]:
        return bool(cost[a] < cost[b])
    return bool(tie[a] < tie[b])


@compiled
def _sift_down(
    heap: NDArray[Any], where: NDArray[Any], cost: NDArray[Any], tie: NDArray[Any], k: int, size: int
) -> None:
    v = heap[k]
    while True:
        child = 2 * k + 1
        if child >= size:
            break
        if child + 1 < size and _less(cost, tie, heap[child + 1], heap[child]):
            child += 1
        if not _less(cost, tie, heap[child], v):
            break
        heap[k] = heap[child]
        where[heap[k]] = k
        k = child
    heap[k] = v
    where[v] = k


@compiled
def _sift(heap: NDArray[Any], where: NDArray[Any], cost: NDArray[Any], tie: NDArray[Any], k: int, size: int) -> None:
    """Put the entry at place k of the first `size`, whose cost changed, where it belongs."""
    v = heap[k]
    while k > 0:
        up = (k - 1) // 2
        if not _less(cost, tie, v, heap[up]):
            break
        heap[k] = heap[up]
        where[heap[k]] = k
        k = up
    heap[k] = v
    where[v] = k
    _sift_down(heap, where, cost, tie, k, size)


@compiled
def _flips(
    p: int, q: int, position: NDArray[Any], faces: NDArray[Any], face_head: NDArray[Any], face_next: NDArray[Any]
) -> int:  # fmt: skip
    """How many of p's surviving faces would turn over if p moved to q."""
    count = 0
    c = face_head[p]
    while c != _NONE:
        f = c // 3
        k = c - 3 * f
        a, b = faces[f, (k + 1) % 3], faces[f, (k + 2) % 3]
        if a != q and b != q:
            e0, e1, e2 = (
                position[b, 0] - position[a, 0],
                position[b, 1] - position[a, 1],
                position[b, 2] - position[a, 2],
            )
            u0, u1, u2 = (
                position[p, 0] - position[a, 0],
                position[p, 1] - position[a, 1],
                position[p, 2] - position[a, 2],
            )
            w0, w1, w2 = (
                position[q, 0] - position[a, 0],
                position[q, 1] - position[a, 1],
                position[q, 2] - position[a, 2],
            )
            dot = (
                (e1 * u2 - e2 * u1) * (e1 * w2 - e2 * w1)
                + (e2 * u0 - e0 * u2) * (e2 * w0 - e0 * w2)
                + (e0 * u1 - e1 * u0) * (e0 * w1 - e1 * w0)
            )
            if dot < 0:
                count += 1
        c = face_next[c]
    return count


@compiled
def _holds_all(parts: NDArray[Any], p: int, q: int) -> bool:
    """Whether q lies on every part that p lies on."""
    for w in range(parts.shape[1]):  # noqa: SIM110 - numba compiles no generator here
        if parts[p, w] & ~parts[q, w]:
            return False
    return True


@compiled
def _best(
    p: int, position: NDArray[Any], quadric: NDArray[Any], faces: NDArray[Any], face_head: NDArray[Any], face_next: NDArray[Any],
    half_to: NDArray[Any], half_head: NDArray[Any], half_next: NDArray[Any], parts: NDArray[Any], join_parts: bool, flip: float,
) -> tuple[float, int]:  # fmt: skip
    """Cheapest contraction p -> q, as (cost, q); q is -1 where none is allowed."""
    best, target = np.inf, _NONE
    h = half_head[p]
    while h != _NONE:
        q = half_to[h]
        if join_parts or _holds_all(parts, p, q):
            x, y, z = position[q, 0], position[q, 1], position[q, 2]
            cost = max(_evaluate(quadric[p], x, y, z) + _evaluate(quadric[q], x, y, z), 0.0)
            if cost < best or (cost == best and q < target):
                cost *= 1 + flip * _flips(p, q, position, faces, face_head, face_next)
                if cost < best or (cost == best and q < target):
                    best, target = cost, q
        h = half_next[h]
    return best, target


@compiled
def _unlink_corner(c: int, faces: NDArray[Any], face_head: NDArray[Any], face_next: NDArray[Any]) -> None:
    v = faces[c // 3, c % 3]
    at = face_head[v]
    if at == c:
        face_head[v] = face_next[c]
        return
    while face_next[at] != c:
        at = face_next[at]
    face_next[at] = face_next[c]


@compiled
def _drop_half(v: int, h: int, half_head: NDArray[Any], half_next: NDArray[Any]) -> None:
    at = half_head[v]
    if at == h:
        half_head[v] = half_next[h]
        return
    while half_next[at] != h:
        at = half_next[at]
    half_next[at] = half_next[h]


@compiled
def _has_twin(
    q: int, a: int, b: int, part: int, faces: NDArray[Any], face_part: NDArray[Any], face_head: NDArray[Any], face_next: NDArray[Any]
) -> bool:  # fmt: skip
    """Whether q already carries a face of this part with the corners q, a, b."""
    c = face_head[q]
    while c != _NONE:
        f = c // 3
        if face_part[f] == part:
            k = c - 3 * f
            i, j = faces[f, (k + 1) % 3], faces[f, (k + 2) % 3]
            if (i == a and j == b) or (i == b and j == a):
                return True
        c = face_next[c]
    return False


@compiled
def contract(
    position: NDArray[Any], quadric: NDArray[Any], faces: NDArray[Any], face_part: NDArray[Any], edges: NDArray[Any], is_pair: NDArray[Any],
    parts: NDArray[Any], tie: NDArray[Any], locked: NDArray[Any], count: int, join_parts: bool, flip: float,
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:  # fmt: skip
    """Contract p -> q, cheapest first, until `count` vertices are left or no contraction is allowed.

    position (n, 3), quadric (n, 10), faces (m, 3) int32, face_part (m,) int32, edges (e, 2) int32 without doubles,
    is_pair (e,) bool: edge of a close pair, no edge of the graph; parts (n, words) uint64 bit sets, tie (n,)
    decides between equal costs, locked (n,) bool: vertices that stay. `quadric`, `faces`, `edges`, `is_pair` and
    `parts` are changed in place. Returns

    into        (n,) int32: where each vertex went (itself where it was kept)
    face_lives  (m,) bool and edge_lives (e,) bool: what is left of `faces` and `edges`, now between kept vertices
    """
    n = len(position)
    face_lives = np.ones(len(faces), np.bool_)
    edge_lives = np.ones(len(edges), np.bool_)
    face_head = np.full(n, _NONE, np.int32)
    face_next = np.full(3 * len(faces), _NONE, np.int32)
    for c in range(3 * len(faces) - 1, -1, -1):
        v = faces[c // 3, c % 3]
        face_next[c] = face_head[v]
        face_head[v] = c
    half_head = np.full(n, _NONE, np.int32)
    half_next = np.full(2 * len(edges), _NONE, np.int32)
    half_to = np.empty(2 * len(edges), np.int64)
    for h in range(2 * len(edges) - 1, -1, -1):
        v = edges[h // 2, h % 2]
        half_to[h] = edges[h // 2, 1 - h % 2]
        half_next[h] = half_head[v]
        half_head[v] = h

    into = np.arange(n).astype(np.int32)
    known = np.zeros(n, np.int32)
    shared = np.full(n, _NONE, np.int32)
    cost = np.full(n, np.inf)
    target = np.full(n, _NONE, np.int64)
    heap = np.arange(n)
    where = np.arange(n)
    for v in range(n):
        if not locked[v]:
            cost[v], target[v] = _best(
                v, position, quadric, faces, face_head, face_next, half_to, half_head, half_next, parts, join_parts, flip
            )  # fmt: skip
    for k in range(n // 2, -1, -1):
        _sift_down(heap, where, cost, tie, k, n)

    left = n
    stamp = 0
    while left > count:
        p = heap[0]
        q = target[p]
        if q == _NONE:
            break
        left -= 1
        heap[0] = heap[left]
        where[heap[0]] = 0
        _sift(heap, where, cost, tie, 0, left)

        into[p] = q
        for k in range(10):
            quadric[q, k] += quadric[p, k]
        for w in range(parts.shape[1]):
            parts[q, w] |= parts[p, w]

        # Faces with both ends vanish; the others go over to q unless it has the same one already.
        c = face_head[p]
        while c != _NONE:
            following = face_next[c]
            f = c // 3
            k = c - 3 * f
            c1, c2 = 3 * f + (k + 1) % 3, 3 * f + (k + 2) % 3
            a, b = faces[f, (k + 1) % 3], faces[f, (k + 2) % 3]
            if a == q or b == q or _has_twin(q, a, b, face_part[f], faces, face_part, face_head, face_next):
                _unlink_corner(c1, faces, face_head, face_next)
                _unlink_corner(c2, faces, face_head, face_next)
                face_lives[f] = False
            else:
                faces[f, k] = q
                face_next[c] = face_head[q]
                face_head[q] = c
            c = following
        face_head[p] = _NONE

        # Neighbours of p become neighbours of q, each once; a graph edge outranks a close pair.
        stamp += 1
        h = half_head[q]
        while h != _NONE:
            r = half_to[h]
            if r == p:
                edge_lives[h // 2] = False
                _drop_half(q, h, half_head, half_next)
            else:
                known[r] = stamp
                shared[r] = h // 2
            h = half_next[h]
        h = half_head[p]
        while h != _NONE:
            following = half_next[h]
            r = half_to[h]
            if r != q:
                if known[r] == stamp:
                    if not is_pair[h // 2]:
                        is_pair[shared[r]] = False
                    edge_lives[h // 2] = False
                    _drop_half(r, h ^ 1, half_head, half_next)
                else:
                    half_to[h ^ 1] = q
                    edges[h // 2, h % 2] = q
                    half_next[h] = half_head[q]
                    half_head[q] = h
            h = following
        half_head[p] = _NONE

        # The costs of q and its neighbours changed.
        if not locked[q]:
            cost[q], target[q] = _best(
                q, position, quadric, faces, face_head, face_next, half_to, half_head, half_next, parts, join_parts, flip
            )  # fmt: skip
            _sift(heap, where, cost, tie, where[q], left)
        h = half_head[q]
        while h != _NONE:
            r = half_to[h]
            if not locked[r]:
                cost[r], target[r] = _best(
                r, position, quadric, faces, face_head, face_next, half_to, half_head, half_next, parts, join_parts, flip
            )  # fmt: skip
                _sift(heap, where, cost, tie, where[r], left)
            h = half_next[h]

    for v in range(n):
        end = v
        while into[end] != end:
            end = into[end]
        at = v
        while into[at] != end and at != end:
            following = into[at]
            into[at] = end
            at = following
    return into, face_lives, edge_lives


@compiled
def graph_distances(
    pairs: NDArray[Any], limit: NDArray[Any], position: NDArray[Any], near_start: NDArray[Any], near_list: NDArray[Any]
) -> NDArray[Any]:
    """Length of the shortest way along the graph between the two vertices of each pair; inf where above `limit`.

    pairs (m, 2), limit (m,), position (n, 3); neighbours of v: near_list[near_start[v]:near_start[v + 1]].
    """
    n = len(position)
    out = np.full(len(pairs), np.inf)
    length = np.empty(n)
    stamp = np.full(n, _NONE)
    queued = np.full(n, _NONE)
    queue = np.empty(n, np.int64)
    for m in range(len(pairs)):
        a, b = pairs[m]
        length[a], stamp[a] = 0.0, m
        queue[0], queued[a] = a, m
        first, waiting = 0, 1
        while waiting > 0:
            v = queue[first]
            first = (first + 1) % n
            waiting -= 1
            queued[v] = _NONE
            for k in range(near_start[v], near_start[v + 1]):
                r = near_list[k]
                step = 0.0
                for xyz in range(3):
                    step += (position[r, xyz] - position[v, xyz]) ** 2
                way = length[v] + np.sqrt(step)
                if way <= limit[m] and (stamp[r] != m or way < length[r]):
                    length[r], stamp[r] = way, m
                    if queued[r] != m:
                        queue[(first + waiting) % n] = r
                        waiting += 1
                        queued[r] = m
        if stamp[b] == m:
            out[m] = length[b]
    return out
