"""Cells as solvers write them, turned into VTK cells.

Solvers write a tetrahedron, pyramid or wedge as a hexahedron with nodes repeated, and a triangle as a
quadrilateral with its last node repeated.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

VERTEX, LINE, TETRA, HEXAHEDRON, WEDGE, PYRAMID = 1, 3, 10, 12, 13, 14
# Faces of VTK's hexahedron, each seen counterclockwise from outside.
_HEXAHEDRON_FACES = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))


def shell_faces(nodes: NDArray[np.integer]) -> NDArray[np.int32]:
    """Faces (face, 3 or 4), some with a repeated corner, with -1 last in triangles; (face, 3) if all are triangles.

    A facet with fewer than three different corners is left as it is.
    """
    faces = np.array(nodes, np.int32)
    if faces.shape[1] == 3:
        return faces
    following = np.roll(faces, -1, axis=1)
    repeated = faces == following
    triangle = repeated.sum(axis=1) == 1
    for corner in range(3):  # take the repeated corner out, keep the order of the others
        rows = triangle & repeated[:, corner]
        faces[rows, corner:3] = faces[rows, corner + 1 :]
    faces[triangle, 3] = -1
    return np.ascontiguousarray(faces[:, :3]) if len(faces) and triangle.all() else faces


def solid_cells(nodes: NDArray[np.integer]) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """Hexahedra (cell, 8), some with repeated nodes, as VTK cells (cell, 8) padded with -1 and their types (cell,).

    Tetrahedra, pyramids and wedges are found by which corners coincide, and keep their orientation. Anything else
    (two coinciding corners, say) stays a hexahedron with repeated nodes.
    """
    hexahedra: NDArray[np.int32] = np.asarray(nodes, np.int32)
    cells, types = hexahedra.copy(), np.full(len(hexahedra), HEXAHEDRON, np.uint8)
    # Every corner's first corner with the same node: few different patterns, each worked out once.
    pattern = (hexahedra[:, :, None] == hexahedra[:, None, :]).argmax(axis=2)
    for same in np.unique(pattern, axis=0) if len(hexahedra) else ():
        kind, corners = _collapsed(tuple(int(c) for c in same))
        if kind != HEXAHEDRON:
            rows = (pattern == same).all(axis=1)
            cells[rows] = -1
            cells[rows, : len(corners)] = hexahedra[rows][:, list(corners)]
            types[rows] = kind
    return cells, types


def _collapsed(same: tuple[int, ...]) -> tuple[int, tuple[int, ...]]:
    """VTK type and corners of a hexahedron whose corner k coincides with corner `same[k]`.

    VTK's tetrahedra, pyramids and wedges begin with a base that is seen counterclockwise from inside.
    """
    whole = (HEXAHEDRON, tuple(range(8)))
    faces = []
    for face in _HEXAHEDRON_FACES:
        corners = [same[c] for c in face]
        faces.append(tuple(c for k, c in enumerate(corners) if c != corners[k - 1]))
    left = sorted(set(same))
    triangles = [f for f in faces if len(f) == 3 and len(set(f)) == 3]
    quads = [f for f in faces if len(f) == 4 and len(set(f)) == 4]
    if len(left) == 4 and triangles:
        a, b, c = triangles[0]
        return TETRA, (a, c, b, next(n for n in left if n not in (a, b, c)))
    if len(left) == 5 and len(quads) == 1:
        a, b, c, d = quads[0]
        return PYRAMID, (a, d, c, b, next(n for n in left if n not in quads[0]))
    if len(left) == 6 and len(triangles) == 2 and not set(triangles[0]) & set(triangles[1]):
        edges = {frozenset((f[k - 1], f[k])) for f in quads for k in range(4)}
        base = triangles[0][::-1]
        top = [n for c in base for n in triangles[1] if frozenset((c, n)) in edges]
        if len(top) == 3:
            return WEDGE, (*base, *top)
    return whole


def stack_cells(groups: list[NDArray[np.int32]]) -> NDArray[np.int32]:
    """Groups of cells (cell, corner) under each other, padded with -1 to the widest."""
    corners = max((g.shape[1] for g in groups if len(g)), default=0)
    padded = [np.pad(g, ((0, 0), (0, corners - g.shape[1])), constant_values=-1) for g in groups if len(g)]
    return np.concatenate(padded) if padded else np.empty((0, 0), np.int32)
