"""Edges of faces and of graphs: pairs of node numbers, undirected."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from scipy import sparse


def face_edges(face_nodes: ArrayLike) -> NDArray[np.int32]:
    """Sides of (m, 3 or 4) faces as (e, 2) int32 pairs i < j, sorted, each once; -1 corners and loops left out."""
    corners = np.asarray(face_nodes, dtype=np.int64)
    last = corners[:, -1]
    if corners.shape[1] == 4:
        last = np.where(last < 0, corners[:, 2], last)
    columns = [*corners.T[:-1], last]
    pairs = np.concatenate([np.stack(side, axis=1) for side in zip(columns, [*columns[1:], columns[0]])])
    return unique_pairs(pairs)


def unique_pairs(pairs: NDArray[np.integer]) -> NDArray[np.int32]:
    """Undirected pairs (e, 2) as int32 i < j, sorted, each once, without loops."""
    low, high = pairs.min(axis=1).astype(np.int64), pairs.max(axis=1).astype(np.int64)
    low, high = low[low != high], high[low != high]
    width = int(high.max(initial=0)) + 1
    keys = np.sort(low * width + high)
    keys = keys[np.diff(keys, prepend=-1) > 0]  # np.unique hashes, which is slower here
    return np.stack([keys // width, keys % width], axis=1).astype(np.int32)


def adjacency(n: int, edges: NDArray[np.integer]) -> sparse.csr_matrix:
    """Symmetric 0/1 matrix (n, n) of undirected edges (e, 2)."""
    i, j = edges.T
    ones = np.ones(2 * len(edges))
    from scipy import sparse

    return sparse.csr_matrix((ones, (np.concatenate([i, j]), np.concatenate([j, i]))), shape=(n, n))


def without_sides(edges: NDArray[np.integer], triangles: NDArray[np.integer]) -> NDArray[np.int64]:
    """The edges (e, 2) that are no side of any of the triangles (m, 3): lone edges."""
    pairs: NDArray[np.int64] = edges.astype(np.int64)
    if len(triangles) == 0 or len(pairs) == 0:
        return pairs
    sides = unique_pairs(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)).astype(np.int64)
    width = int(max(sides.max(), pairs.max())) + 1
    low, high = pairs.min(axis=1), pairs.max(axis=1)
    return pairs[~np.isin(low * width + high, sides[:, 0] * width + sides[:, 1])]
