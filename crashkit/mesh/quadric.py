"""Quadric error metrics: symmetric 4x4 forms v^T Q v, area times squared distance (Garland and Heckbert 1997).

A quadric is kept as its ten different numbers xx xy xz xw yy yz yw zz zw ww, for v = (x, y, z, 1).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def planes(
    normal: NDArray[np.float64], through: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Quadrics (k, 10) of weight times squared distance to planes with unit `normal` (k, 3) `through` points (k, 3)."""
    x, y, z = normal.T
    w = -(normal * through).sum(axis=1)
    return np.asarray(
        weight[:, None] * np.stack([x * x, x * y, x * z, x * w, y * y, y * z, y * w, z * z, z * w, w * w], axis=1)
    )


def points(at: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quadrics (k, 10) of weight times squared distance to points (k, 3)."""
    x, y, z = at.T
    one, none = np.ones(len(at)), np.zeros(len(at))
    return np.asarray(
        weight[:, None] * np.stack([one, none, none, -x, one, none, -y, one, -z, (at * at).sum(axis=1)], axis=1)
    )


def vertex_quadrics(
    position: NDArray[np.float64],
    faces: NDArray[np.integer],
    edges: NDArray[np.integer],
    edge_faces: NDArray[np.integer],
    edge_face: NDArray[np.integer],
    boundary: float,
    spread: float,
) -> NDArray[np.float64]:
    """Quadrics (n, 10) of the vertices of a surface.

    Each vertex gets a third of the area of its faces, times the squared distances to their planes and, `spread` times,
    to its own place; and for each of its edges that is open or has more than two faces the length squared, `boundary`
    times, times the squared distance to the plane through the edge across its face. Lone edges hold their ends by
    `spread` alone. `edge_faces` (e,) counts the faces of an edge, `edge_face` (e,) names one of them.
    """
    n = len(position)
    a, b, c = (position[faces[:, k]] for k in range(3))
    normal, double_area = _unit(np.cross(b - a, c - a))
    plane = planes(normal, a, double_area / 6)
    out = sum((_gather(faces[:, k], plane, n) for k in range(3)), np.zeros((n, 10)))
    third = np.bincount(faces.ravel(), np.repeat(double_area / 6, 3), minlength=n).astype(np.float64)

    i, j = edges.T
    along = position[j] - position[i]
    length2 = (along * along).sum(axis=1)
    lone = edge_faces == 0
    for end in (i, j):
        third += np.bincount(end[lone], length2[lone], minlength=n)
    out = out + points(position, spread * third)

    feature = (edge_faces != 2) & ~lone
    across, _ = _unit(np.cross(along[feature], normal[edge_face[feature]]))
    fence = planes(across, position[i[feature]], boundary * length2[feature])
    return out + _gather(i[feature], fence, n) + _gather(j[feature], fence, n)


def _unit(vectors: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Vectors (k, 3) of length 1, zero where there is no direction, and the lengths (k,)."""
    length = np.linalg.norm(vectors, axis=1)
    return vectors / np.where(length > 0, length, 1.0)[:, None], length


def _gather(index: NDArray[np.integer], values: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    """Sums (n, 10) of the rows of `values` (k, 10) by `index` (k,)."""
    return np.stack([np.bincount(index, column, minlength=n) for column in values.T], axis=1)
