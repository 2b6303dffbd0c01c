"""Clean triangles and edges out of mixed, doubled and broken faces."""

from __future__ import annotations

import numpy as np
import pytest
from mesh_shapes import plate

from crashkit.errors import MeshError
from crashkit.mesh.surface import surface


def test_quadrilaterals_are_cut_along_their_shorter_diagonal() -> None:
    position = np.array([[0, 0, 0], [3, 0, 0], [3, 1, 0], [1, 1, 0]], float)  # 1-3 is shorter than 0-2
    mesh = surface(position, [[0, 1, 2, 3]])
    assert {frozenset(t) for t in mesh.triangles.tolist()} == {frozenset({0, 1, 3}), frozenset({1, 2, 3})}


def test_edges_are_the_sides_of_the_faces_and_not_the_diagonals() -> None:
    position, faces = plate(2, 2, quads=True)
    assert surface(position, faces).edges.tolist() == [[0, 1], [0, 2], [1, 3], [2, 3]]


@pytest.mark.parametrize("corners", [[0, 1, 2, 2], [0, 0, 1, 2], [0, 1, 1, 2], [0, 1, 2, 0]])
def test_a_quadrilateral_with_a_doubled_corner_is_one_triangle(corners: list[int]) -> None:
    mesh = surface(np.eye(3), [corners])
    assert [sorted(t) for t in mesh.triangles.tolist()] == [[0, 1, 2]]


def test_degenerate_and_doubled_faces_are_left_out() -> None:
    mesh = surface(np.eye(3), [[0, 1, 2], [2, 0, 1], [0, 0, 1], [2, 1, 0]])
    assert len(mesh.triangles) == 1


def test_the_same_triangle_in_two_parts_is_kept_in_both() -> None:
    mesh = surface(np.eye(3), [[0, 1, 2], [0, 1, 2]], face_part=[0, 1])
    assert mesh.part.tolist() == [0, 1]
    assert mesh.node_parts.tolist() == [[3], [3], [3]]


def test_nodes_that_no_face_touches_are_not_used() -> None:
    position = np.concatenate([np.eye(3), [[9.0, 9, 9]]])
    assert surface(position, [[0, 1, 2]]).used.tolist() == [True, True, True, False]


def test_extra_edges_join_the_graph() -> None:
    position, faces = plate(3, 2)
    mesh = surface(position, faces, extra_edges=[[5, 0]])
    assert [0, 5] in mesh.edges.tolist()


def test_seventy_parts_fit_into_the_bit_sets() -> None:
    position, faces = plate(71, 2)
    part = np.concatenate([np.arange(70), np.arange(70)])
    mesh = surface(position, faces, part)
    assert mesh.node_parts.shape == (142, 2)
    assert np.bitwise_count(mesh.node_parts).sum() == 2 * 2 + 2 * 2 * 69  # the ends lie on one part, the rest on two


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([[0, 0]], [[0, 1, 2]]), r"positions have shape \(1, 2\); expected \(node, 3\)"),
        ((np.eye(3), [[0, 1]]), r"faces have shape \(1, 2\)"),
        ((np.eye(3), np.empty((0, 3), int)), "no face .only beams or loose nodes"),
        ((np.eye(3), [[0, 1, 3]]), "faces name nodes 0 to 3; expected 0 to 2"),
        ((np.eye(3), [[0, -1, 2]]), "faces name nodes -1 to 2"),
        ((np.array([[0, 0, 0], [1, 0, 0], [np.nan, 1, 0]]), [[0, 1, 2]]), "node 2 has a position that is not finite"),
        ((np.eye(3), [[0, 0, 1], [1, 2, 2]]), "every face is degenerate"),
        ((np.eye(3), [[0, 1, 2]], [0, 1]), r"face parts have shape \(2,\)"),
        ((np.eye(3), [[0, 1, 2]], [-1]), "start at -1"),
        ((np.eye(4, 3), [[0, 1, 2]], None, [[0, 3]]), "extra edge 0-3 ends at a node that no face touches"),
        ((np.eye(3), [[0, 1, 2]], None, [[0, 7]]), "extra edges name nodes 0 to 7; expected 0 to 2"),
        ((np.eye(3), [[0, 1, 2]], None, [[0, 1, 2]]), r"extra edges have shape \(1, 3\)"),
    ],
)
def test_what_cannot_be_a_surface_is_refused_with_what_was_found(arguments: tuple, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        surface(*arguments)
