"""The other selection: which nodes vtkQuadricDecimation would keep.

VTK moves vertices to their best place and stops where it likes. Here its vertices choose distinct nearest nodes, and
the rest is as in `selection`: the mesh between the nodes comes from contracting everything else into them, which keeps
lone edges and parts, and the few nodes too many are contracted as well, so that the count is exact.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from crashkit.mesh.selection import Selection, contract_onto, contract_to, everything
from crashkit.mesh.surface import Surface

if TYPE_CHECKING:
    from vtkmodules.vtkCommonDataModel import vtkPolyData

# vtkQuadricDecimation counts triangles; runs of it until its vertices are at most this share above the count.
_SURPLUS = 0.02
_RUNS = 10


def select_vtk(mesh: Surface, counts: list[int], pair_distance: float = 0.0) -> list[Selection]:
    """One selection for each of `counts` (decreasing), every one a subset of the one before.

    Raises
    ------
    MeshError
        If a count cannot be reached because every part must keep a node.
    """
    selections = []
    finer = everything(mesh)
    for count in counts:
        keep = nearest_nodes(decimated_points(mesh, count), mesh, finer.kept)
        keep = _with_every_part(mesh, finer, keep)
        finer = contract_onto(mesh, finer, keep)
        if len(finer.kept) > count:
            finer = contract_to(mesh, finer, count, pair_distance)
        selections.append(finer)
    return selections


def decimated_points(mesh: Surface, count: int) -> NDArray[np.float64]:
    """Vertices (k, 3), m, of the mesh decimated by VTK to few more than `count` of them (k >= count)."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersCore import vtkQuadricDecimation

    data = _polydata(mesh)
    # Reductions between which the count is met; a closed surface has twice as many triangles as vertices.
    low, high = 0.0, 1.0
    reduction = max(0.0, 1.0 - count / mesh.used.sum())
    best = mesh.position[mesh.used]
    for _ in range(_RUNS):
        decimate = vtkQuadricDecimation()
        decimate.SetInputData(data)
        decimate.SetTargetReduction(reduction)
        decimate.Update()
        out = decimate.GetOutput()
        points = vtk_to_numpy(out.GetPoints().GetData()).astype(np.float64) if out.GetNumberOfPoints() else best[:0]
        if len(points) >= count:
            low = reduction
            if len(points) < len(best):
                best = points
            if len(points) <= count * (1 + _SURPLUS):
                break
        else:
            high = reduction
        reduction = (low + high) / 2
    return best


def nearest_nodes(points: NDArray[np.float64], mesh: Surface, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """A different one of `nodes` for each of `points` (k, 3), the closest pairs first; all nodes if there are fewer."""
    if len(points) >= len(nodes):
        return nodes
    at = mesh.position[nodes]
    tree = cKDTree(at)
    taken = np.zeros(len(nodes), bool)
    waiting = np.arange(len(points))
    reach = 4
    while len(waiting):
        reach = min(reach, len(nodes))
        distance, node = tree.query(points[waiting], k=reach)
        point = np.repeat(waiting, reach)
        order = np.lexsort((node.ravel(), point, distance.ravel()))
        served = np.zeros(len(points), bool)
        for p, n in zip(point[order].tolist(), node.ravel()[order].tolist(), strict=True):
            if not served[p] and not taken[n]:
                served[p] = taken[n] = True
        waiting = waiting[~served[waiting]]
        reach *= 2
    return nodes[taken]


def _with_every_part(mesh: Surface, finer: Selection, keep: NDArray[np.int64]) -> NDArray[np.int64]:
    """`keep` and, for each part without a node in it, the node of that part nearest to its middle."""
    kept = np.isin(finer.kept, keep)
    for part in np.unique(mesh.part):
        member = (finer.parts[:, part // 64] >> np.uint64(part % 64) & np.uint64(1)).astype(bool)
        if not (member & kept).any():
            candidates = np.flatnonzero(member)
            at = mesh.position[finer.kept[candidates]]
            kept[candidates[np.argmin(np.linalg.norm(at - at.mean(axis=0), axis=1))]] = True
    return finer.kept[kept]


def _polydata(mesh: Surface) -> vtkPolyData:
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    points = vtkPoints()
    points.SetDataTypeToDouble()
    points.SetData(numpy_to_vtk(mesh.position, deep=True))
    cells = vtkCellArray()
    offsets = np.arange(0, 3 * len(mesh.triangles) + 1, 3, dtype=np.int64)
    cells.SetData(
        numpy_to_vtkIdTypeArray(offsets, deep=True),
        numpy_to_vtkIdTypeArray(mesh.triangles.ravel().astype(np.int64), deep=True),
    )
    data = vtkPolyData()
    data.SetPoints(points)
    data.SetPolys(cells)
    return data
