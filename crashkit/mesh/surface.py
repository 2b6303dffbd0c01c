"""A clean triangle surface out of whatever faces a crash model brings.

Real skins have quadrilaterals, T-joints where three shells meet, doubled and degenerate faces, nodes at the same
place and nodes that no face touches. Nodes are never merged or moved: they carry results.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crashkit.errors import MeshError
from data_schema.edges import face_edges, unique_pairs

# Diagonals from the origin beyond which a mesh is moved there.
_FAR = 10


@dataclass(frozen=True)
class Surface:
    """Triangles and graph edges over the nodes of level 0.

    Attributes
    ----------
    position
        (n, 3) float64, m.
    triangles
        (m, 3) int32: quadrilaterals cut in two, degenerate and doubled ones left out.
    part
        (m,) int32: part of each triangle.
    edges
        (e, 2) int32, i < j: sides of the faces as they were given (no diagonals) and extra edges.
    used
        (n,) bool: nodes that a face touches; the others are kept out of the graph.
    """

    position: NDArray[np.float64]
    triangles: NDArray[np.int32]
    part: NDArray[np.int32]
    edges: NDArray[np.int32]
    used: NDArray[np.bool_]

    @property
    def n_nodes(self) -> int:
        return len(self.position)

    @property
    def n_parts(self) -> int:
        return int(self.part.max(initial=-1)) + 1

    @cached_property
    def node_parts(self) -> NDArray[np.uint64]:
        """(n, words) bit sets: the parts whose faces touch each node."""
        return part_sets(self.n_nodes, self.triangles, self.part, self.n_parts)

    @cached_property
    def diagonal(self) -> float:
        """Diagonal of the bounding box of the used nodes, m."""
        at = self.position[self.used]
        return float(np.linalg.norm(at.max(axis=0) - at.min(axis=0)))


def surface(
    position: ArrayLike,
    face_nodes: ArrayLike,
    face_part: ArrayLike | None = None,
    extra_edges: ArrayLike | None = None,
) -> Surface:
    """The surface of (n, 3) positions and (m, 3 or 4) faces, -1 in the last corner of a triangle among quads.

    `face_part` (m,) numbers the parts from 0; without it everything is one part. `extra_edges` (e, 2) join nodes
    that faces touch (spot welds, say): they enter the graph and nothing else.

    Raises
    ------
    MeshError
        If there is no face, or if numbers point nowhere.
    """
    at = np.ascontiguousarray(position, dtype=np.float64)
    corners = np.asarray(face_nodes)
    if at.ndim != 2 or at.shape[1] != 3:
        raise MeshError(f"positions have shape {at.shape}; expected (node, 3)")
    if corners.ndim != 2 or corners.shape[1] not in (3, 4):
        raise MeshError(f"faces have shape {corners.shape}; expected (face, 3) or (face, 4)")
    if len(corners) == 0:
        raise MeshError(
            "the mesh has no face (only beams or loose nodes); a hierarchy needs shells or the skin of solids"
        )
    if corners.max() >= len(at) or corners[:, :3].min() < 0 or corners.min() < -1:
        raise MeshError(
            f"faces name nodes {corners.min()} to {corners.max()}; "
            f"expected 0 to {len(at) - 1} (-1 only in a fourth corner)"
        )
    if not np.isfinite(at).all():
        node = int(np.argmin(np.isfinite(at).all(axis=1)))
        raise MeshError(f"node {node} has a position that is not finite; expected metres")
    at = _near_origin(at)
    part = np.zeros(len(corners), np.int32) if face_part is None else np.asarray(face_part, dtype=np.int32)
    if part.shape != (len(corners),) or part.min() < 0:
        raise MeshError(
            f"face parts have shape {part.shape} and start at {part.min()}; expected ({len(corners)},) from 0"
        )

    triangles, triangle_part = _triangulate(at, corners, part)
    triangles, triangle_part = _without_useless(triangles, triangle_part)
    if len(triangles) == 0:
        raise MeshError("every face is degenerate (fewer than three different nodes); a hierarchy needs real faces")
    used = np.zeros(len(at), bool)
    used[triangles] = True
    edges = face_edges(corners)
    edges = edges[used[edges].all(axis=1)]
    if extra_edges is not None:
        edges = _with_extra(edges, np.asarray(extra_edges), used)
    return Surface(at, triangles, triangle_part, edges, used)


def _near_origin(at: NDArray[np.float64]) -> NDArray[np.float64]:
    """`at`, moved to the origin where it lies far away: quadrics square coordinates, and lose what is small beside them."""
    low, high = at.min(axis=0), at.max(axis=0)
    middle = (low + high) / 2
    return at - middle if np.abs(middle).max() > _FAR * np.linalg.norm(high - low) else at


def part_sets(n: int, triangles: NDArray[np.int32], part: NDArray[np.int32], n_parts: int) -> NDArray[np.uint64]:
    """(n, words) uint64: bit p of a row is set where a triangle of part p touches the node."""
    sets = np.zeros((n, max(1, -(-n_parts // 64))), np.uint64)
    rows = triangles.ravel()
    parts = np.repeat(part, 3)
    np.bitwise_or.at(sets, (rows, parts // 64), np.uint64(1) << (parts % 64).astype(np.uint64))
    return sets


def _triangulate(
    at: NDArray[Any], corners: NDArray[Any], part: NDArray[Any]
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Quadrilaterals cut along the shorter diagonal, so that a bent one keeps its fold."""
    if corners.shape[1] == 3:
        return corners.astype(np.int32), part
    a, b, c, d = corners.T
    three = (d < 0) | (d == c) | (d == a) | (a == b) | (b == c)
    # A quadrilateral with a doubled corner is a triangle; its three different nodes come first.
    a3, b3, c3 = np.where(a == b, d, a)[three], b[three], np.where(b == c, d, c)[three]
    has_fourth = d[three] >= 0
    a3, c3 = np.where(has_fourth, a3, a[three]), np.where(has_fourth, c3, c[three])
    quad = ~three
    a4, b4, c4, d4 = a[quad], b[quad], c[quad], d[quad]
    ac = np.linalg.norm(at[a4] - at[c4], axis=1)
    bd = np.linalg.norm(at[b4] - at[d4], axis=1)
    along_ac = ac <= bd
    first = np.where(along_ac[:, None], np.stack([a4, b4, c4], 1), np.stack([a4, b4, d4], 1))
    second = np.where(along_ac[:, None], np.stack([a4, c4, d4], 1), np.stack([b4, c4, d4], 1))
    triangles = np.concatenate([np.stack([a3, b3, c3], 1), first, second]).astype(np.int32)
    return triangles, np.concatenate([part[three], part[quad], part[quad]]).astype(np.int32)


def _without_useless(triangles: NDArray[Any], part: NDArray[Any]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Leave out triangles with a doubled corner, and all but the first of those with the same corners and part."""
    a, b, c = triangles.T
    keep = (a != b) & (b != c) & (a != c)
    triangles, part = triangles[keep], part[keep]
    low, middle, high = np.sort(triangles, axis=1).T
    order = np.lexsort((np.arange(len(part)), part, high, middle, low))
    keys = np.stack([low, middle, high, part])[:, order]
    first = np.sort(order[np.r_[True, (np.diff(keys, axis=1) != 0).any(axis=0)]]) if len(order) else order
    return triangles[first], part[first]


def _with_extra(edges: NDArray[np.int32], extra: NDArray[Any], used: NDArray[np.bool_]) -> NDArray[np.int32]:
    if extra.ndim != 2 or extra.shape[1] != 2:
        raise MeshError(f"extra edges have shape {extra.shape}; expected (edge, 2)")
    if len(extra) and (extra.min() < 0 or extra.max() >= len(used)):
        raise MeshError(f"extra edges name nodes {extra.min()} to {extra.max()}; expected 0 to {len(used) - 1}")
    loose = ~used[extra].all(axis=1)
    if loose.any():
        i, j = extra[int(np.argmax(loose))]
        raise MeshError(f"extra edge {i}-{j} ends at a node that no face touches; join nodes of faces only")
    return unique_pairs(np.concatenate([edges, extra]))
