"""From a solver's mesh to the structure that a dataset holds: which parts, faces, cells and nodes stay.

Rigid walls and nodes that nothing of the structure uses are left out; solids contribute their outer skin to the
faces, as it is in the undeformed state (faces that erosion lays bare later are not added). All node numbers here are
0-based.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import DataError
from crashkit.readers.base import Part, RunMesh

# VTK cell types that have a volume, hence a skin.
_SOLIDS = {10: 4, 12: 8, 13: 6, 14: 5, 24: 10, 25: 20}


@dataclass(frozen=True)
class Structure:
    """What stays of one run's mesh.

    Attributes
    ----------
    node
        (n,) int64: the nodes that stay, as numbers of the source.
    node_id
        (n,) int64, position (n, 3) float64 in the source's length unit.
    face_nodes
        (m, 3 or 4) int32, -1 in the last corner of a triangle among quadrilaterals.
    face_part
        (m,) int32 into `parts`; face_id (m,) int64.
    face_source
        (m,) int64: the shell of the source behind a face, or -1 - cell for the skin of a solid.
    cell_source
        (c,) int64: the cell of the source behind each cell that stays.
    notes
        What was left out, in words.
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
    without: tuple[NDArray[np.bool_], NDArray[np.bool_]] | None = None,
) -> Structure:
    """The structure of `mesh`. `parts` and `exclude_parts` name parts by number, title or glob pattern.

    Raises
    ------
    DataError
        If a pattern matches no part, or if nothing is left.
    """
    chosen, notes = _choose(mesh.parts, parts, exclude_parts, keep_rigid_walls)
    stay = (~without[0], ~without[1]) if without is not None else (slice(None), slice(None))
    there = [mesh.face_part[stay[0]], mesh.cell_part[stay[1]]]
    chosen = chosen[np.isin(chosen, there[0]) | np.isin(chosen, there[1])]  # empty parts say nothing
    new_part = np.full(len(mesh.parts) + 1, -1, np.int32)  # one more, so that part -1 (none) stays -1
    new_part[chosen] = np.arange(len(chosen))

    keep_faces, keep_cells = new_part[mesh.face_part] >= 0, new_part[mesh.cell_part] >= 0
    if without is not None:
        keep_faces &= ~without[0]
        keep_cells &= ~without[1]
    shells, cells = np.flatnonzero(keep_faces), np.flatnonzero(keep_cells)
    skin_nodes, skin_cell = _skin(mesh, cells)
    corners = _stack(mesh.face_nodes[shells], skin_nodes)
    if len(corners) == 0 and len(cells) == 0:
        raise DataError(
            f"nothing is left of the mesh: {len(chosen)} of {len(mesh.parts)} parts were chosen, and they have no "
            "element; choose others with --parts"
        )

    used = np.zeros(len(mesh.position), bool)
    used[corners[corners >= 0]] = True
    used[mesh.cell_nodes[cells][mesh.cell_nodes[cells] >= 0]] = True
    node = np.flatnonzero(used)
    number = np.full(len(used) + 1, -1, np.int32)  # the last entry keeps -1 where a corner is -1
    number[node] = np.arange(len(node))

    left_out = len(used) - len(node)
    if left_out:
        notes.append(f"{left_out} of {len(used)} nodes left out: no element that stays uses them")
    ids = mesh.node_id[node]
    if not (np.diff(ids) > 0).all() and (repeated := _repeated(ids)) is not None:
        raise DataError(f"node number {repeated} stands for several nodes of the structure; expected each number once")
    return Structure(
        node=node,
        node_id=ids,
        position=mesh.position[node],
        face_nodes=number[corners],
        face_part=new_part[np.concatenate([mesh.face_part[shells], mesh.cell_part[skin_cell]])],
        face_id=np.concatenate([mesh.face_id[shells], mesh.cell_id[skin_cell]]).astype(np.int64),
        face_source=np.concatenate([shells, -1 - skin_cell]).astype(np.int64),
        # Without cells there are no corners either, as in a dataset that is read back.
        cell_nodes=number[mesh.cell_nodes[cells]] if len(mesh.cell_part[cells]) else np.empty((0, 0), np.int32),
        cell_type=mesh.cell_type[cells],
        cell_part=new_part[mesh.cell_part[cells]],
        cell_id=mesh.cell_id[cells],
        cell_source=cells,
        parts=tuple(mesh.parts[k] for k in chosen),
        notes=tuple(notes),
    )


def matched(reference: Structure, other: Structure) -> Structure:
    """`other` with its nodes, faces and cells in the order of `reference`, matched by their numbers.

    Raises
    ------
    DataError
        If the two are not the same mesh: other node numbers, other elements, elements in other parts.
    """
    if np.array_equal(reference.node_id, other.node_id):
        order = np.arange(reference.n_nodes)
    else:
        missing = np.setdiff1d(reference.node_id, other.node_id)
        extra = np.setdiff1d(other.node_id, reference.node_id)
        if len(missing) or len(extra):
            named = f"number {missing[0]} is missing" if len(missing) else f"number {extra[0]} is new"
            raise DataError(
                f"its mesh has {other.n_nodes} nodes, that of the first run {reference.n_nodes} ({named}); the runs of "
                "a dataset share one mesh: ingest this run apart, or choose parts that all runs have"
            )
        by_id = np.argsort(other.node_id)
        order = by_id[np.searchsorted(other.node_id[by_id], reference.node_id)]
    if _same_numbering(reference, other):  # nearly always the case, and much quicker than sorting all elements
        return replace(
            reference,
            node=other.node,
            position=other.position,
            face_source=other.face_source,
            cell_source=other.cell_source,
            notes=other.notes,
        )
    place = np.full(other.n_nodes + 1, -1, np.int32)  # the last entry keeps -1 where a corner is -1
    place[order] = np.arange(len(order))
    faces = _match_elements("faces", _rows(reference, "face"), _rows(other, "face", place))
    cells = _match_elements("cells", _rows(reference, "cell"), _rows(other, "cell", place))
    return replace(
        reference,
        node=other.node[order],
        position=other.position[order],
        face_source=other.face_source[faces],
        cell_source=other.cell_source[cells],
        notes=other.notes,
    )


def _same_numbering(one: Structure, other: Structure) -> bool:
    """Whether nodes, elements and parts stand in the same order with the same numbers."""
    names = ("node_id", "face_nodes", "face_part", "face_id", "cell_nodes", "cell_type", "cell_part", "cell_id")
    same_parts = [p.id for p in one.parts] == [p.id for p in other.parts]
    return same_parts and all(np.array_equal(getattr(one, n), getattr(other, n)) for n in names)


def _rows(s: Structure, kind: str, place: NDArray[np.int32] | None = None) -> NDArray[np.int64]:
    """One row an element: number, part number, its nodes in the order of their numbers (renumbered by `place`)."""
    nodes, part, number = (getattr(s, f"{kind}_{what}") for what in ("nodes", "part", "id"))
    part_id = np.array([p.id for p in s.parts], np.int64)
    corners = np.sort(nodes if place is None else place[nodes], axis=1)
    return np.column_stack([number, part_id[part], corners]).astype(np.int64)


def _match_elements(what: str, mine: NDArray[np.int64], theirs: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each row of `mine` the place of the equal row in `theirs`."""
    if np.array_equal(mine, theirs):
        return np.arange(len(mine))
    if mine.shape != theirs.shape:
        raise DataError(
            f"its mesh has {len(theirs)} {what}, that of the first run {len(mine)}; the runs of a dataset share one mesh"
        )
    a, b = np.lexsort(mine.T[::-1]), np.lexsort(theirs.T[::-1])
    differing = (mine[a] != theirs[b]).any(axis=1)
    if differing.any():
        number, part = mine[a][np.argmax(differing)][:2]
        raise DataError(
            f"its mesh differs from that of the first run in {int(differing.sum())} of {len(mine)} {what} (around "
            f"element {number}, part {part}); the runs of a dataset share one mesh"
        )
    out = np.empty(len(mine), np.int64)
    out[a] = b
    return out


def _choose(
    known: Sequence[Part], include: Sequence[str], exclude: Sequence[str], walls: bool
) -> tuple[NDArray[np.int64], list[str]]:
    """Places of the parts that stay, and notes. A rigid wall stays if it is asked for by its number or full title."""

    def matching(pattern: str) -> tuple[set[int], set[int]]:
        exact = {k for k, p in enumerate(known) if pattern in (str(p.id), p.name)}
        found = exact or {k for k, p in enumerate(known) if fnmatch.fnmatchcase(p.name, pattern)}
        if not found:
            listing = ", ".join(f"{p.id} ({p.name})" if p.name else str(p.id) for p in known[:12])
            raise DataError(
                f"no part is called {pattern!r}; the runs have {listing}{' ...' if len(known) > 12 else ''}; "
                "name parts by number, title or pattern such as 'rail*'"
            )
        return found, exact

    kept, asked_for = set(range(len(known))), set()
    if include:
        matches = [matching(pattern) for pattern in include]
        kept = set().union(*(found for found, _ in matches))
        asked_for = set().union(*(exact for _, exact in matches))
    for pattern in exclude:
        kept -= matching(pattern)[0]
    dropped = set() if walls else {k for k in kept if known[k].rigid_wall and k not in asked_for}
    kept -= dropped
    notes = []
    if dropped:
        notes.append(f"rigid walls left out: {', '.join(known[k].name or str(known[k].id) for k in sorted(dropped))}")
    if include or exclude:
        notes.append(f"{len(kept)} of {len(known)} parts chosen")
    return np.array(sorted(kept), np.int64), notes


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


def _repeated(ids: NDArray[np.int64]) -> int | None:
    """A number that appears more than once."""
    inorder = np.sort(ids)
    again = inorder[1:][np.diff(inorder) == 0]
    return int(again[0]) if len(again) else None
