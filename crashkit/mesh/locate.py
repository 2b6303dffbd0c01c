"""Where on a mesh a point lies: the weights of the nodes around it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse


def node_weights(
    points: NDArray[np.float64], mesh: NDArray[np.float64], faces: NDArray[np.integer[Any]]
) -> tuple[sparse.csr_matrix, NDArray[np.float64]]:
    """Barycentric weights of the closest place on the faces, and how far away it is.

    Parameters
    ----------
    points
        (point, 3), m.
    mesh
        (node, 3), m.
    faces
        (face, 3 or 4) node numbers; a triangle among quadrilaterals ends with -1 or repeats its last node.

    Returns
    -------
    (point, node) weights, rows sum to one; (point,) distances, m.
    """
    import pyvista as pv

    triangles = faces[:, :3].astype(np.int64)
    if faces.shape[1] == 4:
        four = (faces[:, 3] >= 0) & (faces[:, 3] != faces[:, 2])
        triangles = np.concatenate([triangles, faces[four][:, [0, 2, 3]].astype(np.int64)])
    corners: Any = triangles
    surface = pv.PolyData.from_regular_faces(np.ascontiguousarray(mesh, np.float64), corners)
    cell, closest = surface.find_closest_cell(np.atleast_2d(points), return_closest_point=True)
    corners = triangles[np.atleast_1d(cell)]
    a, b, c = (mesh[corners[:, k]] for k in range(3))
    sides = np.stack([b - a, c - a], axis=2)
    inner = np.einsum("nik,nij->nkj", sides, sides)
    inner += 1e-12 * np.trace(inner, axis1=1, axis2=2)[:, None, None] * np.eye(2) + 1e-300 * np.eye(2)
    towards = np.einsum("nik,ni->nk", sides, closest - a)
    share = np.clip(np.linalg.solve(inner, towards[..., None])[..., 0], 0.0, 1.0)
    weights = np.concatenate([1 - share.sum(axis=1, keepdims=True), share], axis=1)
    weights = np.where(weights < 1e-6, 0.0, weights)
    weights /= weights.sum(axis=1, keepdims=True)
    rows = np.repeat(np.arange(len(corners)), 3)
    out = sparse.csr_matrix((weights.ravel(), (rows, corners.ravel())), shape=(len(corners), len(mesh)))
    out.eliminate_zeros()
    return out, np.linalg.norm(np.atleast_2d(points) - closest, axis=1)
