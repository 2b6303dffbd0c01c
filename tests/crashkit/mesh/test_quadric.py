"""Quadrics against the squared distances they stand for."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from crashkit.mesh.quadric import planes, points, vertex_quadrics
from data_schema.edges import face_edges


def value(quadric: NDArray[np.float64], at: NDArray[np.float64]) -> float:
    """v^T Q v for v = (x, y, z, 1) and Q of ten numbers, row by row of its upper triangle."""
    q = np.zeros((4, 4))
    q[np.triu_indices(4)] = quadric
    q = q + np.triu(q, 1).T
    v = np.append(at, 1.0)
    return float(v @ q @ v)


@given(st.integers(0, 200))
def test_a_plane_gives_weight_times_squared_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(2, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    through, weight, at = rng.normal(size=(2, 3)), rng.uniform(0.1, 3, 2), rng.normal(size=3)
    found = planes(normal, through, weight)
    assert found.shape == (2, 10)
    for k in range(2):
        assert value(found[k], at) == pytest.approx(weight[k] * (normal[k] @ (at - through[k])) ** 2)


@given(st.integers(0, 200))
def test_a_point_gives_weight_times_squared_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    places, weight, at = rng.normal(size=(2, 3)), rng.uniform(0.1, 3, 2), rng.normal(size=3)
    found = points(places, weight)
    assert found.shape == (2, 10)
    for k in range(2):
        assert value(found[k], at) == pytest.approx(weight[k] * ((at - places[k]) ** 2).sum())


# A T of three triangles on the edge 0-1, one more that is open on two sides, a face without area, and a beam 5-6.
POSITION = np.array(
    [[0, 0, 0], [2, 0, 0], [0.5, 1.5, 0.2], [0.3, -1, 0.4], [1, 0.1, 1.2], [3, 1, 0.5], [4, 1, 1], [6, 6, 6]], float
)
FACES = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4], [1, 5, 2], [2, 2, 5]])


def topology() -> tuple[NDArray, NDArray, NDArray]:
    """Edges, the number of faces of each, and one of its faces."""
    edges = np.concatenate([face_edges(FACES), [[5, 6]]])
    of = [[f for f, face in enumerate(FACES) if {i, j} <= set(face.tolist())] for i, j in edges.tolist()]
    return edges, np.array([len(f) for f in of]), np.array([f[-1] if f else -1 for f in of])


def by_definition(vertex: int, at: NDArray[np.float64], boundary: float, spread: float) -> float:
    """What vertex_quadrics promises, said with areas, distances and cross products."""
    edges, count, face_of = topology()
    total, weight = 0.0, 0.0
    normals = []
    for a, b, c in FACES:
        cross = np.cross(POSITION[b] - POSITION[a], POSITION[c] - POSITION[a])
        length = np.linalg.norm(cross)
        normals.append(cross / length if length > 0 else cross)
        for _ in range([a, b, c].count(vertex)):
            third = length / 2 / 3
            weight += third
            total += third * (normals[-1] @ (at - POSITION[a])) ** 2
    for (i, j), faces, face in zip(edges.tolist(), count, face_of, strict=True):
        if vertex not in (i, j):
            continue
        along = POSITION[j] - POSITION[i]
        length2 = along @ along
        if faces == 0:
            weight += length2
        elif faces != 2:
            across = np.cross(along, normals[face])
            size = np.linalg.norm(across)
            across = across / size if size > 0 else across
            total += boundary * length2 * (across @ (at - POSITION[i])) ** 2
    return total + spread * weight * ((at - POSITION[vertex]) ** 2).sum()


@pytest.mark.parametrize("vertex", range(8))
@pytest.mark.parametrize(("boundary", "spread"), [(0.0, 0.0), (3.0, 0.0), (0.0, 0.25), (2.0, 0.5)])
def test_a_vertex_sums_its_faces_its_place_and_its_open_edges(vertex: int, boundary: float, spread: float) -> None:
    edges, count, face_of = topology()
    assert sorted(set(count.tolist())) == [0, 1, 2, 3], "lone, open, inner and branching edges are all there"
    found = vertex_quadrics(POSITION, FACES, edges, count, face_of, boundary, spread)
    assert found.shape == (8, 10)
    for at in np.random.default_rng(vertex).normal(size=(3, 3)):
        assert value(found[vertex], at) == pytest.approx(
            by_definition(vertex, at, boundary, spread), rel=1e-9, abs=1e-12
        )


def test_inner_edges_of_a_flat_mesh_let_vertices_slide_in_the_plane() -> None:
    position = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0]], float)
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    edges = face_edges(faces)
    inner = (edges == 4).any(axis=1)
    face_of = np.array(
        [next(f for f, face in enumerate(faces) if {i, j} <= set(face.tolist())) for i, j in edges.tolist()]
    )
    found = vertex_quadrics(position, faces, edges, np.where(inner, 2, 1), face_of, 5.0, 0.0)
    assert value(found[4], np.array([0.9, 0.2, 0.0])) == pytest.approx(0.0, abs=1e-12)
    assert value(found[4], np.array([0.9, 0.2, 0.5])) == pytest.approx(0.25 / 3)
    # Corner 0 has two open sides of length 1: leaving either costs.
    assert value(found[0], np.array([0.0, 0.2, 0.0])) == pytest.approx(5.0 * 0.04)
