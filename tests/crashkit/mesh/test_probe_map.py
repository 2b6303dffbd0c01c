"""Probe maps on meshes of a few nodes: which cell a point may use, and with what weights."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import nnls

from crashkit.mesh.probe import Cells, cells_of_nodes, closest_cells, coarse_cells, probe_map, without_sides


def members(n: int, *parts: tuple[int, list[int]], words: int = 1) -> NDArray[np.uint64]:
    """Bit sets (n, words): part p has the nodes given for it."""
    out = np.zeros((n, words), np.uint64)
    for p, nodes in parts:
        out[nodes, p // 64] |= np.uint64(1 << (p % 64))
    return out


def distance(point: NDArray, corners: NDArray) -> float:
    """Distance to the convex hull of 1 to 3 corners: non-negative weights that sum to one, by least squares."""
    heavy = 1e6
    matrix = np.vstack([corners.T, np.full(len(corners), heavy)])
    weights, _ = nnls(matrix, np.append(point, heavy))
    return float(np.linalg.norm(weights @ corners - point))


# What is left of a part.


@pytest.mark.parametrize("number", [0, 63, 64, 70])
def test_a_part_leaves_its_triangles_then_its_lone_edges_then_its_lone_nodes(number: int) -> None:
    faces, part = np.array([[0, 1, 2], [3, 4, 5]]), np.array([number, 1])
    edges = np.array([[0, 1], [1, 2], [0, 2], [2, 6], [6, 3], [3, 4]])
    parts = members(9, (number, [0, 1, 2, 6, 7]), (1, [3, 4, 5, 8]), words=2)
    cells = coarse_cells(faces, part, edges, parts, 71)
    mine = cells.nodes[cells.part == number].tolist()
    assert mine == [[0, 1, 2], [2, 6, -1], [7, -1, -1]]
    assert cells.nodes[cells.part == 1].tolist() == [[3, 4, 5], [8, -1, -1]]
    assert len(cells.nodes) == len(cells.part) == 5
    assert (cells.nodes.dtype, cells.part.dtype) == (np.int64, np.int64)
    assert (np.diff(cells.part) >= 0).all(), "part by part"


def test_an_edge_between_two_parts_belongs_to_neither() -> None:
    parts = members(2, (0, [0]), (1, [1]))
    cells = coarse_cells(np.empty((0, 3), int), np.empty(0, int), np.array([[0, 1]]), parts, 2)
    assert cells.nodes.tolist() == [[0, -1, -1], [1, -1, -1]]
    assert cells.part.tolist() == [0, 1]


def test_no_part_leaves_nothing() -> None:
    cells = coarse_cells(np.empty((0, 3), int), np.empty(0, int), np.empty((0, 2), int), members(1), 0)
    assert cells.nodes.shape == (0, 3)
    assert cells.part.shape == (0,)


@pytest.mark.parametrize(
    ("edges", "triangles", "left"),
    [
        ([[0, 1], [1, 2], [2, 3]], [[0, 1, 2]], [[2, 3]]),
        ([[1, 0], [2, 1], [0, 2], [3, 2]], [[0, 1, 2]], [[3, 2]]),
        ([[0, 1], [4, 9]], [[9, 4, 5]], [[0, 1]]),
        ([[0, 3], [1, 2]], [[0, 1, 2]], [[0, 3]]),
        ([[1, 3], [2, 3], [0, 5]], [[0, 1, 2], [2, 3, 5]], [[1, 3], [0, 5]]),
        ([[0, 1]], [], [[0, 1]]),
        ([], [[0, 1, 2]], []),
    ],
)
def test_edges_that_are_sides_of_triangles_are_taken_out_whatever_their_direction(
    edges: list, triangles: list, left: list
) -> None:
    found = without_sides(np.array(edges, np.int32).reshape(-1, 2), np.array(triangles, np.int32).reshape(-1, 3))
    assert found.tolist() == left
    assert found.dtype == np.int64


@given(st.integers(0, 300))
def test_lone_edges_are_those_that_share_no_pair_with_a_triangle(seed: int) -> None:
    rng = np.random.default_rng(seed)
    triangles = np.array([rng.choice(8, 3, replace=False) for _ in range(rng.integers(0, 5))]).reshape(-1, 3)
    edges = np.array([rng.choice(8, 2, replace=False) for _ in range(rng.integers(0, 9))]).reshape(-1, 2)
    sides = {frozenset((t[a], t[b])) for t in triangles.tolist() for a, b in ((0, 1), (1, 2), (2, 0))}
    expected = [e for e in edges.tolist() if frozenset(e) not in sides]
    assert without_sides(edges, triangles).tolist() == expected


def test_cells_of_a_node_are_all_that_touch_it() -> None:
    nodes = np.array([[0, 1, 2], [2, 4, -1], [1, 2, 4], [5, -1, -1]])
    start, cells = cells_of_nodes(nodes, 7)
    found = [sorted(cells[start[v] : start[v + 1]].tolist()) for v in range(7)]
    assert found == [[0], [0, 2], [0, 1, 2], [], [1, 2], [3], []]
    assert len(start) == 8


# The closest cell.


@given(st.integers(0, 60))
def test_the_closest_cell_is_the_nearest_of_the_points_own_parts(seed: int) -> None:
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(-1, 1, (8, 3))
    nodes = np.array([[0, 1, 2], [2, 3, 4], [4, 5, -1], [1, 6, -1], [7, -1, -1], [3, 6, 7]])
    part = np.array([0, 0, 0, 65, 65, 65])
    points = rng.uniform(-1.5, 1.5, (6, 3))
    parts = members(6, (0, [0, 1, 4]), (65, [2, 3, 4]), words=2)
    found = closest_cells(points, parts, coarse, Cells(nodes, part))
    assert found[5] == -1, "it is on no part"
    for k, own in enumerate([{0}, {0}, {65}, {65}, {0, 65}]):
        reach = {c: distance(points[k], coarse[nodes[c][nodes[c] >= 0]]) for c in range(6) if part[c] in own}
        assert reach[int(found[k])] == pytest.approx(min(reach.values()), abs=1e-5)


def test_without_a_cell_of_its_part_a_point_has_none() -> None:
    coarse = np.eye(3)
    found = closest_cells(
        np.zeros((2, 3)), members(2, (1, [0]), (0, [1])), coarse, Cells(np.array([[0, 1, 2]]), np.zeros(1, int))
    )
    assert found.tolist() == [-1, 0]


# The map.

# A square of two triangles in the plane z = 0 of part 0, nodes 0 to 3, and a lone edge 4-5 of part 1 above it.
COARSE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 0.1], [1, 0, 0.1]], float)
CELLS = Cells(np.array([[0, 1, 2], [0, 2, 3], [4, 5, -1]]), np.array([0, 0, 1]))
EDGES = np.array([[0, 1], [1, 2], [0, 2], [2, 3], [0, 3], [4, 5]])


def mapped(points: list[list[float]], part: list[int], into: list[int], **more: object) -> tuple[NDArray, NDArray]:
    """The rows of further fine nodes; the coarse ones are the first six fine nodes."""
    everything = np.concatenate([COARSE, np.array(points, float).reshape(-1, 3)])
    own = [0, 0, 0, 0, 1, 1, *part]
    parts = members(len(everything), *((p, [k for k, q in enumerate(own) if q == p]) for p in (0, 1)))
    u, apart = probe_map(
        everything, parts, np.array([*range(6), *into]), COARSE, CELLS, EDGES, np.arange(6), **more
    )  # fmt: skip
    assert u.shape == (len(everything), 6)
    assert u.has_sorted_indices
    np.testing.assert_array_equal(u[:6].toarray(), np.eye(6))
    np.testing.assert_array_equal(apart[:6], 0.0)
    return u[6:].toarray(), apart[6:]


@pytest.mark.parametrize(
    ("point", "weights", "apart"),
    [
        ([0.75, 0.25, 0.05], [0.25, 0.5, 0.25, 0, 0, 0], 0.05),  # over a triangle
        ([0.25, 0.75, -0.3], [0.25, 0, 0.25, 0.5, 0, 0], 0.3),  # under the other
        ([0.25, -0.4, 0.3], [0.75, 0.25, 0, 0, 0, 0], 0.5),  # beside an edge
        ([-3.0, -4.0, 0.0], [1, 0, 0, 0, 0, 0], 5.0),  # beyond a corner
        ([1.0, 1e-13, 0.0], [0, 1, 0, 0, 0, 0], 1e-13),  # a weight that is rounding is none
    ],
)
def test_a_point_takes_the_barycentric_weights_of_its_closest_point(point: list, weights: list, apart: float) -> None:
    rows, distances = mapped([point], [0], [0])
    np.testing.assert_allclose(rows[0], weights, atol=1e-9)
    assert (rows[0][np.array(weights) == 0] == 0).all()
    assert distances[0] == pytest.approx(apart, abs=1e-12)


def test_a_point_uses_its_own_part_though_another_is_nearer() -> None:
    rows, distances = mapped([[0.75, 0.25, 0.099], [0.75, 0, 0.01]], [0, 1], [0, 4])
    np.testing.assert_allclose(rows, [[0.25, 0.5, 0.25, 0, 0, 0], [0, 0, 0, 0, 0.25, 0.75]], atol=1e-9)
    np.testing.assert_allclose(distances, [0.099, 0.09])


def test_a_node_outside_the_graph_takes_the_nearest_coarse_node_whatever_its_part() -> None:
    rows, distances = mapped([[0.9, 0.0, 0.3], [0.2, 0.9, 0.0]], [0, 1], [-1, -1])
    np.testing.assert_array_equal(rows, np.eye(6)[[5, 3]])
    np.testing.assert_allclose(distances, [np.hypot(0.1, 0.2), np.hypot(0.2, 0.1)])


def test_a_cell_too_many_edges_away_lies_on_another_sheet() -> None:
    """A strip of triangles that folds back on itself: its end lies on its beginning."""
    along = np.array([0, 1, 2, 3, 3, 2, 1, 0], float)
    up = np.array([0, 0, 0, 0, 0.1, 0.1, 0.1, 0.1])
    coarse = np.concatenate([np.stack([along, np.full(8, y), up], axis=1) for y in (0.0, 1.0)])
    faces = np.array([f for k in range(7) for f in ([k, k + 1, k + 8], [k + 1, k + 9, k + 8])])
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    point = np.array([[0.2, 0.5, 0.06]])  # over the beginning, but nearer to the end
    cells = Cells(faces, np.zeros(14, int))
    everything = np.concatenate([coarse, point])
    parts = members(17, (0, list(range(17))))
    for hops, height in ((1, 0.0), (40, 0.1)):
        into = np.array([*range(16), 0])
        u, apart = probe_map(everything, parts, into, coarse, cells, edges, np.arange(16), hops)
        assert (u @ coarse)[16] == pytest.approx([0.2, 0.5, height])
        assert apart[16] == pytest.approx(abs(height - 0.06))
    default = probe_map(everything, parts, into, coarse, cells, edges, np.arange(16))[0]
    assert (default @ coarse)[16, 2] == pytest.approx(0.0)


def test_kept_nodes_are_known_by_their_fine_number() -> None:
    points = np.concatenate([[[0.5, 0.5, 0.0]], COARSE[::-1]])
    own = [0, 1, 1, 0, 0, 0, 0]
    parts = members(7, *((p, [k for k, q in enumerate(own) if q == p]) for p in (0, 1)))
    same = np.arange(6, 0, -1)
    u, apart = probe_map(points, parts, np.array([0, 5, 4, 3, 2, 1, 0]), COARSE, CELLS, EDGES, same)
    np.testing.assert_array_equal(u[1:].toarray(), np.eye(6)[::-1])
    np.testing.assert_allclose(u[0].toarray(), [[0.5, 0, 0.5, 0, 0, 0]], atol=1e-12)
    assert apart[0] == pytest.approx(0.0, abs=1e-12)
