"""Maps between two meshes of one structure, part by part."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from crashkit.mesh.part_map import part_map


def sheet(side: int, height: float, first: int = 0) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """A unit square of quadrilaterals at a height: nodes, and faces whose numbers begin with `first`."""
    axis = np.linspace(0, 1, side)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    number = first + np.arange(side * side).reshape(side, side)
    faces = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    return np.stack([x.ravel(), y.ravel(), np.full(side * side, height)], axis=1), faces


def pair(side: int, gap: float = 1e-4) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Two sheets that nearly touch, each a part: nodes, faces, part of each face."""
    below, faces = sheet(side, 0.0)
    above, more = sheet(side, gap, len(below))
    return np.concatenate([below, above]), np.concatenate([faces, more]), np.repeat([0, 1], len(faces))


def test_a_linear_field_is_the_same_on_both_meshes() -> None:
    points, faces, part = pair(7)
    mesh, mesh_faces, mesh_part = pair(4)
    to_points, apart = part_map(points, faces, part, mesh, mesh_faces, mesh_part)
    slope = np.random.default_rng(0).standard_normal((3, 3))
    np.testing.assert_allclose(to_points @ (mesh @ slope + 1), points @ slope + 1, atol=1e-12)
    assert apart.max() < 1e-12


def test_sheets_that_touch_are_not_mixed_up() -> None:
    points, faces, part = pair(7)
    points[49:, 2] -= 2e-4  # the upper sheet lies below the lower one of the other mesh
    mesh, mesh_faces, mesh_part = pair(4)
    to_points, _ = part_map(points, faces, part, mesh, mesh_faces, mesh_part)
    upper = np.repeat([0.0, 1.0], 16)
    np.testing.assert_array_equal(to_points @ upper, np.repeat([0.0, 1.0], 49))


def test_a_node_that_no_face_touches_takes_the_nearest_node() -> None:
    points, faces, part = pair(7)
    points = np.concatenate([points, [[1.2, 1.1, 0.0]]])
    mesh, mesh_faces, mesh_part = pair(4)
    to_points, apart = part_map(points, faces, part, mesh, mesh_faces, mesh_part)
    assert to_points[[-1]].nnz == 1
    np.testing.assert_allclose(mesh[to_points[[-1]].indices[0]], [1, 1, 0], atol=1e-3)
    np.testing.assert_allclose(apart[-1], np.hypot(0.2, 0.1), atol=1e-3)
