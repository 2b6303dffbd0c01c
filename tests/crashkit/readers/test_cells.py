"""Cells as solvers write them become VTK cells of the same nodes and the same orientation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkUnstructuredGrid
from vtkmodules.vtkFiltersVerdict import vtkCellSizeFilter

from crashkit.readers._cells import HEXAHEDRON, PYRAMID, TETRA, WEDGE, shell_faces, solid_cells, stack_cells

# A hexahedron and the ways in which LS-DYNA and Radioss let its corners coincide.
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], float)
COLLAPSED = {
    "hexahedron": ((0, 1, 2, 3, 4, 5, 6, 7), HEXAHEDRON, 1.0),
    "tetrahedron, four nodes on top": ((0, 1, 2, 3, 3, 3, 3, 3), TETRA, None),
    "tetrahedron, base doubled": ((0, 1, 2, 2, 4, 4, 4, 4), TETRA, 1 / 6),
    "pyramid": ((0, 1, 2, 3, 4, 4, 4, 4), PYRAMID, 1 / 3),
    "wedge, ridge on top": ((0, 1, 2, 3, 4, 4, 7, 7), WEDGE, 1 / 2),
    "wedge, ends are triangles": ((0, 1, 2, 2, 4, 5, 6, 6), WEDGE, 1 / 2),
}


def volume(nodes: np.ndarray, kind: int) -> float:
    grid, points = vtkUnstructuredGrid(), vtkPoints()
    for corner in CORNERS:
        points.InsertNextPoint(corner)
    grid.SetPoints(points)
    ids = [int(n) for n in nodes if n >= 0]
    grid.InsertNextCell(int(kind), len(ids), ids)
    sizes = vtkCellSizeFilter()
    sizes.SetInputData(grid)
    sizes.Update()
    return sizes.GetOutput().GetCellData().GetArray("Volume").GetValue(0)


@pytest.mark.parametrize("name", COLLAPSED)
def test_collapsed_hexahedra_are_named_and_keep_their_orientation(name):
    corners, kind, expected = COLLAPSED[name]
    nodes, types = solid_cells(np.array([corners]))
    assert types.tolist() == [kind]
    assert set(nodes[0][nodes[0] >= 0]) == set(corners)
    if expected is not None:
        assert volume(nodes[0], kind) == pytest.approx(expected)


@given(st.lists(st.sampled_from(sorted(COLLAPSED)), min_size=1, max_size=20), st.integers(0, 1000))
def test_cells_of_all_kinds_are_sorted_out_together(names, first_node):
    corners = np.array([COLLAPSED[n][0] for n in names]) + first_node
    nodes, types = solid_cells(corners)
    assert types.tolist() == [COLLAPSED[n][1] for n in names]
    for row, cell in zip(corners, nodes, strict=True):
        assert sorted(cell[cell >= 0]) == sorted(set(row))


def test_a_hexahedron_with_two_corners_in_one_place_stays_one():
    nodes, types = solid_cells(np.array([[0, 1, 2, 3, 4, 5, 6, 6]]))
    assert types.tolist() == [HEXAHEDRON]
    assert nodes.tolist() == [[0, 1, 2, 3, 4, 5, 6, 6]]


@pytest.mark.parametrize(
    ("written", "read"),
    [
        ([0, 1, 2, 2], [0, 1, 2, -1]),
        ([0, 0, 1, 2], [0, 1, 2, -1]),
        ([0, 1, 1, 2], [0, 1, 2, -1]),
        ([0, 1, 2, 0], [0, 1, 2, -1]),
        ([0, 1, 2, 3], [0, 1, 2, 3]),
        ([5, 5, 5, 5], [5, 5, 5, 5]),
    ],
)
def test_a_repeated_corner_makes_a_triangle(written, read):
    faces = shell_faces(np.array([written, [6, 7, 8, 9]]))
    assert faces.tolist() == [read, [6, 7, 8, 9]]


def test_triangles_alone_have_three_corners():
    assert shell_faces(np.array([[0, 1, 2, 2], [2, 3, 4, 4]])).tolist() == [[0, 1, 2], [2, 3, 4]]


def test_cells_of_different_widths_are_padded():
    stacked = stack_cells(
        [np.array([[0, 1, 2, 3]], np.int32), np.array([[4, 5]], np.int32), np.empty((0, 9), np.int32)]
    )
    assert stacked.tolist() == [[0, 1, 2, 3], [4, 5, -1, -1]]
