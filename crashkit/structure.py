"""From a solver's mesh to the structure that a dataset holds: which parts, faces, cells and nodes stay.

Rigid walls and nodes that nothing of the structure uses are left out; solids contribute their outer skin to the
faces. All node numbers here are 0-based.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import DataError
from crashkit.readers.base import Part, RunMesh

# VTK cell types that have a volume, hence a skin.
_SOLIDS = {10: 4, 12: 8, 13: 6, 14: 5, 24: 10, 25: 20}


@dataclass(frozen=True)
class Structure:
    """What stays of one run's mesh.

    node         (n,) int64: the nodes that stay, as numbers of the source
    node_id      (n,) int64, position (n, 3) float64 in the source's length unit
    face_nodes   (m, 3 or 4) int32, -1 in the last corner of a triangle among quadrilaterals
    face_part    (m,) int32 into `parts`; face_id (m,) int64
    face_source  (m,) int64: the shell of the source behind a face, or -1 - cell for the skin of a solid
    cell_source  (c,) int64: the cell of the source behind each cell that stays
    notes        what was left out, in words
    """

    node: NDArray[np.int64]
    node_id: NDArray[np.int64]
    position: NDArray[np.float64]
    face_nodes: NDArray[np.int32]
    face_part: NDArray[np.int32]
    face_id: NDArray[np.int64]
    face_source: NDArray[np.int64]
    cell_nodes: NDArray[np.int32]
    cell_type: NDArray[np.uint8]
    cell_part: NDArray[np.int32]
    cell_id: NDArray[np.int64]
    cell_source: NDArray[np.int64]
    parts: tuple[Part, ...]
    notes: tuple[str, ...]

    @property
    def n_nodes(self) -> int:
        return len(self.node)


def structure_of(
    mesh: RunMesh,
    *,
    parts: Sequence[str] = (),
    exclude_parts: Sequence[str] = (),
    keep_rigid_walls: bool = False,
) -> Structure:
    """The structure of `mesh`. `parts` and `exclude_parts` name parts by number, title or glob pattern.

    Raises DataError if a pattern matches no part, or if nothing is left.
    """
    chosen = _choose(mesh.parts, parts, exclude_parts, keep_rigid_walls)
    new_part = np.full(len(mesh.parts) + 1, -1, np.int32)  # one more, so that part -1 (none) stays -1
    new_part[chosen] = np.arange(len(chosen))

    shells = np.flatnonzero(new_part[mesh.face_part] >= 0)
    cells = np.flatnonzero(new_part[mesh.cell_part] >= 0)
    skin_nodes, skin_cell = _skin(mesh, cells)
    corners = _stack(mesh.face_nodes[shells], skin_nodes)
    if len(corners) == 0 and len(cells) == 0:
        raise DataError(
            f"nothing is left of the mesh: of {len(mesh.parts)} parts {len(chosen)} were chosen and they have no element"
        )

    used = np.zeros(len(mesh.position), bool)
    used[corners[corners >= 0]] = True
    used[mesh.cell_nodes[cells][mesh.cell_nodes[cells] >= 0]] = True
    node = np.flatnonzero(used)
    number = np.full(len(used) + 1, -1, np.int32)  # the last entry keeps -1 where a corner is -1
    number[node] = np.arange(len(node))

    notes = []
    walls = [p.name or str(p.id) for p in mesh.parts if p.rigid_wall]
    if walls and not keep_rigid_walls and not parts:
        notes.append(f"rigid walls left out: {', '.join(walls)}")
    left_out = len(used) - len(node)
    if left_out:
        notes.append(f"{left_out} of {len(used)} nodes left out: no element of the chosen parts uses them")
    ids = mesh.node_id[node]
    if len(np.unique(ids)) != len(ids):
        raise DataError(
            f"node number {_first_repeated(ids)} stands for several nodes of the structure; expected each number once"
        )
    return Structure(
        node=node,
        node_id=ids,
        position=mesh.position[node],
        face_nodes=number[corners],
        face_part=new_part[np.concatenate([mesh.face_part[shells], mesh.cell_part[skin_cell]])],
        face_id=np.concatenate([mesh.face_id[shells], mesh.cell_id[skin_cell]]).astype(np.int64),
        face_source=np.concatenate([shells, -1 - skin_cell]).astype(np.int64),
        cell_nodes=number[mesh.cell_nodes[cells]],
        cell_type=mesh.cell_type[cells],
        cell_part=new_part[mesh.cell_part[cells]],
        cell_id=mesh.cell_id[cells],
        cell_source=cells,
        parts=tuple(mesh.parts[k] for k in chosen),
        notes=tuple(notes),
    )


def match_nodes(reference: Structure, other: Structure) -> Structure:
    """`other` with its nodes and faces in the order of `reference`, told by their numbers.

    Raises DataError if the two are not the same mesh: other node numbers, other faces or cells.
    """
    if np.array_equal(reference.node_id, other.node_id) and np.array_equal(reference.face_nodes, other.face_nodes):
        order = np.arange(reference.n_nodes)
    else:
        missing = np.setdiff1d(reference.node_id, other.node_id)
        extra = np.setdiff1d(other.node_id, reference.node_id)
        if len(missing) or len(extra):
            raise DataError(
                f"its mesh differs: {reference.n_nodes} nodes in the first run, {other.n_nodes} here "
                f"({len(missing)} node numbers missing, {len(extra)} new); runs of one dataset share one mesh"
            )
        by_id = np.argsort(other.node_id)
        order = by_id[np.searchsorted(other.node_id[by_id], reference.node_id)]
    place = np.full(other.n_nodes + 1, -1, np.int32)
    place[order] = np.arange(len(order))
    faces = _match_rows(reference.face_nodes, place[other.face_nodes], reference.face_id, other.face_id, "faces")
    cells = _match_rows(reference.cell_nodes, place[other.cell_nodes], reference.cell_id, other.cell_id, "cells")
    return Structure(
        node=other.node[order],
        node_id=other.node_id[order],
        position=other.position[order],
        face_nodes=reference.face_nodes,
        face_part=reference.face_part,
        face_id=reference.face_id,
        face_source=other.face_source[faces],
        cell_nodes=reference.cell_nodes,
        cell_type=reference.cell_type,
        cell_part=reference.cell_part,
        cell_id=reference.cell_id,
        cell_source=other.cell_source[cells],
        parts=reference.parts,
        notes=other.notes,
    )


def _match_rows(
    reference: NDArray[np.int32],
    rows: NDArray[np.int32],
    ids: NDArray[np.int64],
    other_ids: NDArray[np.int64],
    what: str,
) -> NDArray[np.int64]:
    """For each reference row the place of the equal row (as a set of nodes, same element number) in `rows`."""
    if np.array_equal(reference, rows) and np.array_equal(ids, other_ids):
        return np.arange(len(reference))
    if reference.shape != rows.shape:
        raise DataError(f"its mesh differs: {len(reference)} {what} in the first run, {len(rows)} here")
    mine = np.column_stack([ids, np.sort(reference, axis=1)])
    theirs = np.column_stack([other_ids, np.sort(rows, axis=1)])
    a, b = np.lexsort(mine.T[::-1]), np.lexsort(theirs.T[::-1])
    if not np.array_equal(mine[a], theirs[b]):
        differing = int((mine[a] != theirs[b]).any(axis=1).sum())
        raise DataError(
            f"its mesh differs: about {differing} of {len(reference)} {what} join other nodes than in the first run"
        )
    out = np.empty(len(reference), np.int64)
    out[a] = b
    return out


def _choose(known: Sequence[Part], include: Sequence[str], exclude: Sequence[str], walls: bool) -> NDArray[np.int64]:
    def matching(pattern: str) -> set[int]:
        found = {
            k for k, p in enumerate(known)
            if str(p.id) == pattern or fnmatch.fnmatchcase(p.name, pattern) or p.name == pattern
        }  # fmt: skip
        if not found:
            listing = ", ".join(f"{p.id} ({p.name})" if p.name else str(p.id) for p in list(known)[:12])
            raise DataError(
                f"no part is called {pattern!r}; the runs have {listing}{' ...' if len(known) > 12 else ''}"
            )
        return found

    if include:
        kept = set().union(*(matching(pattern) for pattern in include))
    else:
        kept = {k for k, p in enumerate(known) if walls or not p.rigid_wall}
    for pattern in exclude:
        kept -= matching(pattern)
    return np.array(sorted(kept), np.int64)


def _skin(mesh: RunMesh, cells: NDArray[np.int64]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Outer faces (k, 4) of the solids among `cells`, and the cell behind each, through VTK."""
    solids = cells[np.isin(mesh.cell_type[cells], list(_SOLIDS))]
    if len(solids) == 0:
        return np.empty((0, 3), np.int32), np.empty(0, np.int64)
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkUnstructuredGrid
    from vtkmodules.vtkFiltersGeometry import vtkDataSetSurfaceFilter

    # Equal-sized rows of repeated corners (degenerate hexahedra) are what solvers write; VTK wants each cell's own.
    sizes = np.array([_SOLIDS[int(t)] for t in mesh.cell_type[solids]])
    offsets = np.concatenate([[0], np.cumsum(sizes)])
    nodes = mesh.cell_nodes[solids]
    flat = nodes[np.arange(nodes.shape[1])[None, :] < sizes[:, None]]
    array = vtkCellArray()
    array.SetData(
        numpy_to_vtkIdTypeArray(offsets.astype(np.int64), deep=True),
        numpy_to_vtkIdTypeArray(flat.astype(np.int64), deep=True),
    )
    points = vtkPoints()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(mesh.position), deep=True))
    grid = vtkUnstructuredGrid()
    grid.SetPoints(points)
    grid.SetCells(numpy_to_vtk(mesh.cell_type[solids].astype(np.uint8), deep=True), array)
    surface = vtkDataSetSurfaceFilter()
    surface.SetInputData(grid)
    surface.PassThroughCellIdsOn()
    surface.PassThroughPointIdsOn()
    surface.SetOriginalCellIdsName("cell")
    surface.SetOriginalPointIdsName("node")
    surface.SetNonlinearSubdivisionLevel(0)
    surface.Update()
    skin = surface.GetOutput()
    offset = vtk_to_numpy(skin.GetPolys().GetOffsetsArray()).astype(np.int64)
    connectivity = vtk_to_numpy(skin.GetPolys().GetConnectivityArray()).astype(np.int64)
    origin = vtk_to_numpy(skin.GetPointData().GetArray("node")).astype(np.int64)
    cell = vtk_to_numpy(skin.GetCellData().GetArray("cell")).astype(np.int64)
    count = np.diff(offset)
    out = np.full((len(count), 4), -1, np.int32)
    for size in (3, 4):
        rows = np.flatnonzero(count == size)
        out[rows, :size] = origin[connectivity[offset[rows, None] + np.arange(size)]]
    # A collapsed side of a degenerate hexahedron repeats a node: a triangle, or nothing.
    out, whole = _without_repeats(out)
    return out[whole], solids[cell[whole]]


def _without_repeats(faces: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    out = faces.copy()
    repeated = (np.diff(np.sort(np.where(faces < 0, np.arange(-4, 0), faces), axis=1), axis=1) == 0).any(axis=1)
    good = np.ones(len(faces), bool)
    for row in np.flatnonzero(repeated):
        distinct = list(dict.fromkeys(int(n) for n in faces[row] if n >= 0))
        good[row] = len(distinct) >= 3
        out[row] = [*distinct, -1, -1, -1][:4]
    return out, np.flatnonzero(good)


def _stack(shells: NDArray[np.int32], skin: NDArray[np.int32]) -> NDArray[np.int32]:
    faces = [f for f in (shells, skin) if len(f)]
    if not faces:
        return np.empty((0, 3), np.int32)
    width = max(f.shape[1] for f in faces)
    padded = [np.pad(f, ((0, 0), (0, width - f.shape[1])), constant_values=-1) for f in faces]
    stacked = np.concatenate(padded).astype(np.int32)
    return stacked[:, :3] if width == 4 and (stacked[:, 3] < 0).all() else stacked


def _first_repeated(ids: NDArray[np.int64]) -> int:
    values, counts = np.unique(ids, return_counts=True)
    return int(values[np.argmax(counts > 1)])
