"""Faces from a mesh file given beside data that has none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import ReadError
from crashkit.extras import need
from crashkit.readers._cells import stack_cells

# Rounding in files of few digits changes edge lengths by less than this.
_EDGE_TOLERANCE = 0.02


def faces_of(path: Path, position: NDArray[np.floating]) -> NDArray[np.int32]:
    """Triangles and quadrilaterals (face, 3 or 4) of the mesh in `path`, whose nodes must be those of `position`.

    `position` is (node, 3), in any unit and any rigid motion: nodes must agree in number and order, which is
    checked by the ratio of edge lengths. The file is read by meshio or, for VTK's own formats, by VTK.

    Raises
    ------
    ReadError
        Naming the file and what differs.
    """
    points, faces = _read(path)
    if len(points) != len(position):
        raise ReadError(
            f"{path}: the mesh has {len(points)} nodes, the data {len(position)}; give the mesh of the data"
        )
    if not len(faces):
        raise ReadError(f"{path}: the mesh has no triangles or quadrilaterals")
    i, j = faces[:, 0], faces[:, 1]
    mine = np.linalg.norm(np.asarray(position, np.float64)[i] - np.asarray(position, np.float64)[j], axis=1)
    theirs = np.linalg.norm(points[i] - points[j], axis=1)
    long = theirs > 0.1 * np.median(theirs)
    ratio = mine[long] / theirs[long]
    spread = np.abs(ratio / np.median(ratio) - 1) if len(ratio) and np.median(ratio) > 0 else np.array([np.inf])
    wrong = np.mean(spread > _EDGE_TOLERANCE)
    if wrong > 0.01:
        raise ReadError(
            f"{path}: {wrong:.0%} of the mesh's edges have another length than in the data; "
            "its nodes stand in another order, or it is another mesh"
        )
    return faces


def _read(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Points (node, 3) and faces (face, 3 or 4), -1 in the last corner of a triangle among quadrilaterals."""
    if not path.is_file():
        raise ReadError(f"{path}: no such mesh file")
    if path.suffix.lower() in (".vtp", ".vtu", ".vtk"):
        return _read_vtk(path)
    need(f"reading {path}", "formats")
    import meshio

    try:
        mesh = meshio.read(path)
    except Exception as error:  # meshio's formats raise whatever their parsers meet
        raise ReadError(f"{path}: not readable as a mesh ({error})") from error
    points = np.zeros((len(mesh.points), 3))
    points[:, : mesh.points.shape[1]] = mesh.points
    return points, stack_cells([np.asarray(b.data, np.int32) for b in mesh.cells if b.type in ("triangle", "quad")])


def _read_vtk(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    import pyvista

    try:
        mesh = pyvista.read(path)
    except Exception as error:  # VTK's readers raise several kinds
        raise ReadError(f"{path}: not readable as a mesh ({error})") from error
    if not isinstance(mesh, (pyvista.PolyData, pyvista.UnstructuredGrid)):
        raise ReadError(f"{path}: holds {type(mesh).__name__}, expected a mesh of triangles or quadrilaterals")
    cells = mesh.cast_to_unstructured_grid().cells_dict
    groups = [np.asarray(nodes, np.int32) for kind, nodes in cells.items() if kind in (5, 9)]
    return np.asarray(mesh.points, np.float64), stack_cells(groups)
