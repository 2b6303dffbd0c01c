"""A probe map between two meshes of one structure, part by part.

Each node of the one mesh takes the barycentric weights of the closest place on the faces that its own part has in the
other, so that sheets that touch are not mixed up. Where parts share a node, the part that comes closest decides.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from crashkit.mesh.locate import node_weights


def part_map(
    points: NDArray[np.float64],
    faces: NDArray[np.integer[Any]],
    part: NDArray[np.integer[Any]],
    mesh: NDArray[np.float64],
    mesh_faces: NDArray[np.integer[Any]],
    mesh_part: NDArray[np.integer[Any]],
) -> tuple[sparse.csr_matrix, NDArray[np.float64]]:
    """What a field on `mesh` says at `points`, and how far each point lies from the place that it is read at.

    Parameters
    ----------
    points, faces, part
        Nodes (n, 3), m, that want the field, faces (m, 3 or 4) with -1 in the last corner of a triangle, and the part (m,)
        of each.
    mesh, mesh_faces, mesh_part
        The same of the mesh (k, 3) that has the field; parts with the same numbers. Each part in `part` has faces there.

    Returns
    -------
    (n, k) weights whose rows sum to one; (n,) distances, m. A node that no face touches takes the nearest node of `mesh`.
    """
    nearest = np.full(len(points), np.inf)
    columns, weights = np.zeros((len(points), 3), np.int64), np.zeros((len(points), 3))
    for number in np.unique(part):
        corners = faces[part == number]
        nodes = np.unique(corners[corners >= 0])
        found, apart = node_weights(points[nodes], mesh, mesh_faces[mesh_part == number])
        better = np.flatnonzero(apart < nearest[nodes])
        for row in better:
            one = slice(found.indptr[row], found.indptr[row + 1])
            count = one.stop - one.start
            columns[nodes[row]], weights[nodes[row]] = 0, 0.0
            columns[nodes[row], :count], weights[nodes[row], :count] = found.indices[one], found.data[one]
        nearest[nodes[better]] = apart[better]
    alone = np.flatnonzero(~np.isfinite(nearest))
    if len(alone):
        nearest[alone], columns[alone, 0] = cKDTree(mesh).query(points[alone])
        weights[alone, 0] = 1.0
    rows = np.repeat(np.arange(len(points)), 3)
    out = sparse.csr_matrix((weights.ravel(), (rows, columns.ravel())), shape=(len(points), len(mesh)))
    out.eliminate_zeros()
    return out, nearest
