"""Probe maps U: what a field on the coarse nodes says at every fine node.

A fine node takes the barycentric weights of the closest point on the coarse surface of its own part, so a row of U
holds at most three non-negative weights that sum to 1. Then U reproduces the closest point itself, U x_coarse = c,
and therefore every affine field a + B x up to B (c - x): its error is at most ||B|| times the distance |c - x|.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from data_schema.edges import adjacency, without_sides

if TYPE_CHECKING:
    from vtkmodules.vtkCommonDataModel import vtkUnstructuredGrid

# The closest cell is trusted if it can be reached in this many coarse edges from the node that a fine node was
# contracted into; otherwise it lies on another sheet of the same part.
HOPS = 1


@dataclass(frozen=True)
class Cells:
    """What is left of a coarse mesh for probing, part by part.

    nodes (c, 3) int64: triangles, segments (lone edges) and single nodes, padded with -1; part (c,)
    """

    nodes: NDArray[np.int64]
    part: NDArray[np.int64]


def coarse_cells(
    faces: NDArray[Any], part: NDArray[Any], edges: NDArray[Any], parts: NDArray[np.uint64], n_parts: int
) -> Cells:
    """Triangles of each part, then its edges on no triangle of it, then its nodes on neither.

    faces (m, 3), part (m,), edges (e, 2) and the rows of `parts` (n, words) in the coarse numbering.
    """
    nodes, numbers = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
    for p in range(n_parts):
        word, bit = p // 64, np.uint64(p % 64)
        member = (parts[:, word] >> bit & np.uint64(1)) != 0
        triangles = faces[part == p].astype(np.int64)
        within = edges[member[edges].all(axis=1)]
        segments = without_sides(within, triangles)
        alone = member.copy()
        alone[triangles] = False
        alone[segments] = False
        points = np.flatnonzero(alone)
        fill = np.full((len(segments) + len(points), 3), -1, np.int64)
        fill[: len(segments), :2] = segments
        fill[len(segments) :, 0] = points
        nodes += [triangles, fill]
        numbers.append(np.full(len(triangles) + len(fill), p, np.int64))
    return Cells(np.concatenate(nodes), np.concatenate(numbers))


def probe_map(
    points: NDArray[np.float64],
    parts: NDArray[np.uint64],
    into: NDArray[np.integer],
    coarse: NDArray[np.float64],
    cells: Cells,
    edges: NDArray[np.integer],
    same: NDArray[np.integer],
    hops: int = HOPS,
) -> tuple[sparse.csr_matrix, NDArray[np.float64]]:
    """U (n, k) from k coarse nodes to n fine ones, and each fine node's distance to its closest point, m.

    points (n, 3), m; parts (n, words) bit sets; into (n,): coarse node that each fine node was contracted into, -1
    where the node is outside the graph and takes the nearest coarse node; coarse (k, 3); edges (e, 2) of the coarse
    graph; same (k,): fine index of each coarse node; its row of U is a unit row.
    """
    from crashkit.mesh import _closest

    n, k = len(points), len(coarse)
    columns = np.zeros((n, 3), np.int64)
    weights = np.zeros((n, 3))
    weights[:, 0] = 1.0
    outside = into < 0
    if outside.any():
        columns[outside, 0] = cKDTree(coarse).query(points[outside])[1]
    dropped = ~outside
    dropped[same] = False
    rows = np.flatnonzero(dropped)
    if len(rows):
        candidate = closest_cells(points[rows], parts[rows], coarse, cells)
        graph = adjacency(k, edges)
        cell_start, cell_list = cells_of_nodes(cells.nodes, k)
        found, weight = _closest.settle(
            points[rows], into[rows].astype(np.int64), candidate, coarse, cells.nodes,
            cell_start, cell_list, graph.indptr, graph.indices, hops,
        )  # fmt: skip
        columns[rows] = cells.nodes[found]
        weights[rows] = weight
    columns[same, 0] = np.arange(k)
    weights[weights < 1e-12] = 0.0
    weights /= weights.sum(axis=1, keepdims=True)
    here = weights > 0
    row = np.broadcast_to(np.arange(n)[:, None], (n, 3))[here]
    u = sparse.csr_matrix((weights[here], (row, columns[here])), shape=(n, k))
    u.sort_indices()
    return u, np.linalg.norm(points - u @ coarse, axis=1)


def closest_cells(
    points: NDArray[np.float64], parts: NDArray[np.uint64], coarse: NDArray[np.float64], cells: Cells
) -> NDArray[np.int64]:
    """The closest cell of a part each point lies on, by VTK's static cell locator; -1 where its parts have none."""
    best = np.full(len(points), np.inf)
    closest = np.full(len(points), -1, np.int64)
    for p in np.unique(cells.part):
        mine = np.flatnonzero(parts[:, p // 64] >> np.uint64(p % 64) & np.uint64(1))
        numbers = np.flatnonzero(cells.part == p)
        if len(mine) == 0:
            continue
        cell, distance2 = _locate(points[mine], coarse, cells.nodes[numbers])
        nearer = distance2 < best[mine]
        best[mine[nearer]] = distance2[nearer]
        closest[mine[nearer]] = numbers[cell[nearer]]
    return closest


def _locate(
    points: NDArray[np.float64], coarse: NDArray[np.float64], nodes: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    from vtkmodules.vtkCommonCore import reference
    from vtkmodules.vtkCommonDataModel import vtkStaticCellLocator

    locator = vtkStaticCellLocator()
    # Keeps the cell order of `nodes`, unlike polygonal data, which puts points before lines before triangles.
    grid = _grid(coarse, nodes)
    locator.SetDataSet(grid)
    locator.BuildLocator()
    number, sub, distance2, foot = reference(0), reference(0), reference(0.0), [0.0, 0.0, 0.0]
    out, squared = np.empty(len(points), np.int64), np.empty(len(points))
    # VTK's type hints know no references, which its functions with results in arguments need.
    find: Any = locator.FindClosestPoint
    out_number: Any = number
    out_distance2: Any = distance2
    for k, point in enumerate(points.tolist()):
        find(point, foot, number, sub, distance2)
        out[k], squared[k] = out_number.get(), out_distance2.get()
    return out, squared


def _grid(coarse: NDArray[np.float64], nodes: NDArray[np.int64]) -> vtkUnstructuredGrid:
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkUnstructuredGrid

    places = vtkPoints()
    places.SetDataTypeToDouble()
    places.SetData(numpy_to_vtk(np.ascontiguousarray(coarse), deep=True))
    count = (nodes >= 0).sum(axis=1)
    offsets = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    array = vtkCellArray()
    array.SetData(
        numpy_to_vtkIdTypeArray(offsets, deep=True),
        numpy_to_vtkIdTypeArray(nodes[nodes >= 0].astype(np.int64), deep=True),
    )
    kinds = np.array([0, 1, 3, 5], np.uint8)[count]  # VTK's vertex, line, triangle
    grid = vtkUnstructuredGrid()
    grid.SetPoints(places)
    grid.SetCells(numpy_to_vtk(kinds, deep=True), array)
    return grid


def cells_of_nodes(nodes: NDArray[np.int64], k: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The cells (c, 3) that touch each of k nodes, as (start (k + 1,), list): those of v are list[start[v]:start[v + 1]]."""
    valid = nodes >= 0
    cell = np.broadcast_to(np.arange(len(nodes))[:, None], nodes.shape)[valid]
    node = nodes[valid]
    order = np.argsort(node, kind="stable")
    return np.concatenate([[0], np.cumsum(np.bincount(node, minlength=k))]), cell[order]
