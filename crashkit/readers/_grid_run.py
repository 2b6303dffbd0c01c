"""A run made of a mesh with arrays in every state.

Files of such meshes leave open what moves: the points, or an array called displacement beside points that stay, and
some call positions a displacement. `GridRun` finds out and reads displacements from the undeformed positions.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import ReadError
from crashkit.readers._cells import shell_faces
from crashkit.readers._grid import Grid, GridSource, Place
from crashkit.readers._names import (
    DISPLACEMENT_NAMES,
    ELEMENT_IDS,
    NODE_IDS,
    WALL_NAME,
    field_name,
    quantity,
    vectors_among,
)
from crashkit.readers.base import FieldInfo, Parameter, Part, Run, RunMesh
from crashkit.readers.checks import closed_if_refused, holds_positions, reading, require_finite, time_problems

# VTK cell type -> (corners that are kept, in the order of the linear cell, its type). Middle nodes are left out.
_FACES = {5: (0, 1, 2), 8: (0, 1, 3, 2), 9: (0, 1, 2, 3), 22: (0, 1, 2), 23: (0, 1, 2, 3), 28: (0, 1, 2, 3)}
_CELLS = {
    1: ((0,), 1),
    3: ((0, 1), 3),
    10: ((0, 1, 2, 3), 10),
    11: ((0, 1, 3, 2, 4, 5, 7, 6), 12),
    12: (tuple(range(8)), 12),
    13: (tuple(range(6)), 13),
    14: (tuple(range(5)), 14),
    21: ((0, 1), 3),
    24: ((0, 1, 2, 3), 10),
    25: (tuple(range(8)), 12),
    26: (tuple(range(6)), 13),
    27: (tuple(range(5)), 14),
    29: (tuple(range(8)), 12),
}
_TRIANGLE, _QUAD, _POLYGON, _LINE, _POLYLINE, _VERTEX, _POLYVERTEX = 5, 9, 7, 3, 4, 1, 2
# Names in lower case, as the solvers' converters write them.
_PARTS = ("part_id", "part_ids", "part", "material_id", "materialids", "materialid", "objectid")
_ALIVE = ("erosion_status", "alive", "status")
_NO_FIELDS = {*NODE_IDS, *ELEMENT_IDS, *_PARTS, *_ALIVE, "vtkghosttype", "vtkoriginalpointids", "vtkoriginalcellids"}
# A displacement beside moving points may differ from their movement by rounding only.
_AGREE = 1e-4


class GridRun(Run):
    """A run whose states are meshes with arrays."""

    def __init__(self, name: str, source: GridSource, solver: str = "unknown") -> None:
        self.name, self.solver, self._source = name, solver, source
        with closed_if_refused(source):
            self._understand(source)

    def _understand(self, source: GridSource) -> None:
        """Look at the first state, and say what the points and arrays mean."""
        self.files, self.time = source.files, source.time
        if not len(self.time):
            raise ReadError(f"{source.files[0]}: no state found")
        first = source.first()
        first.check(source.place(0))
        # A displacement kept as three scalars, told by their names.
        scalars = {n: v for n, v in first.point_data.items() if v.ndim == 1}
        self._joined = {
            name: titles
            for name, titles in vectors_among(list(scalars)).items()
            if field_name(name) in DISPLACEMENT_NAMES and name not in first.point_data
        }
        taken = {title for titles in self._joined.values() for title in titles}
        vectors = {name: np.stack([scalars[t] for t in titles], 1) for name, titles in self._joined.items()}
        kept = {n: v for n, v in first.point_data.items() if n not in taken}
        grid = replace(first, point_data={**kept, **vectors})
        require_finite(grid.points, "the position", source.place(0))
        shapes: dict[tuple[Place, str], tuple[int, ...]] = {("point", n): v.shape for n, v in grid.point_data.items()}
        self._shapes = shapes | {("cell", n): v.shape for n, v in grid.cell_data.items()}
        self._faces, self._cells = _sort_cells(grid, source.place(0))
        self._reading, reference, problems = self._what_moves(grid)
        self.mesh = self._read_mesh(grid, reference)
        self._arrays, self.fields = self._offered(grid)
        self.parameters: Mapping[str, Parameter] = {}
        self._life = _find(grid.cell_data, _ALIVE, everywhere=False)
        titles = [t for n in grid.point_data for t in self._joined.get(n, (n,)) if field_name(n) in DISPLACEMENT_NAMES]
        told = {grid.units.get(t) for t in titles}
        self.units = "SI" if told == {"m"} else None
        self.problems = (
            *source.problems,
            *problems,
            *time_problems(self.time, [source.place(k) for k in range(len(self.time))]),
        )

    # What the points and arrays mean

    def _what_moves(self, grid: Grid) -> tuple[_Reading, NDArray[np.float64], list[str]]:
        """How to get displacements, the undeformed positions, and what contradicts itself."""
        source, start = self._source, np.asarray(grid.points, np.float64)
        last = len(self.time) - 1
        ends = source.points(last) if last else grid.points
        moving = not np.array_equal(ends, grid.points)
        vectors = [n for n, v in grid.point_data.items() if field_name(n) in DISPLACEMENT_NAMES and v.shape[1:] == (3,)]
        # "u" is a velocity to some: the plainer name goes before it, and what is passed over is said.
        vectors.sort(key=lambda n: DISPLACEMENT_NAMES.index(field_name(n)))
        name = vectors[0] if vectors else None
        if vectors[1:]:
            others = " and ".join(repr(n) for n in vectors[1:])
            self.notes = (f"{source.place(0)}: displacements are read from the array {name!r}, not from {others}",)
        if name is None:
            if not last:
                raise ReadError(
                    f"{source.place(0)}: is the only state of the run and has no point array called displacement, so "
                    "nothing says what moved; expected the undeformed state as well, or the displacement "
                    f"(3 components); found {', '.join(grid.point_data) or 'no arrays'}"
                )
            if not moving:
                raise ReadError(
                    f"{source.place(last)}: its points stand where they stood in the first state, and there is no point "
                    f"array called displacement (3 components); found {', '.join(grid.point_data) or 'no arrays'}"
                )
            return _Reading(None, True, False), start, []
        first = np.asarray(grid.point_data[name], np.float64)
        if holds_positions(first, start):
            return _Reading(name, moving, True), start, []
        if not moving:
            return _Reading(name, False, False), start, []
        reference = start - first
        told = np.asarray(self._array("point", name, last), np.float64)
        size = float(np.ptp(start, axis=0).max())
        difference = float(np.nanmax(np.abs(np.asarray(ends, np.float64) - reference - told), initial=0.0))
        if difference > _AGREE * size:
            text = (
                f"{source.place(last)}: its points have moved otherwise than the array {name!r} says "
                f"(by up to {difference:.3g} in a mesh of size {size:.3g}); expected either to stay or both to agree"
            )
            return _Reading(None, True, False), reference, [text]
        return _Reading(None, True, False), reference, []

    def _read_mesh(self, grid: Grid, reference: NDArray[np.float64]) -> RunMesh:
        count = len(grid.points)
        node_id = _ids(grid.point_data, NODE_IDS, count)
        element_id = _ids(grid.cell_data, ELEMENT_IDS, len(grid.types))
        owner, parts = _parts(grid, node_id, element_id)
        return RunMesh(
            position=reference,
            node_id=node_id,
            face_nodes=self._faces.nodes,
            face_part=owner[self._faces.rows],
            face_id=element_id[self._faces.rows],
            parts=parts,
            cell_nodes=self._cells.nodes,
            cell_type=self._cells.types,
            cell_part=owner[self._cells.rows],
            cell_id=element_id[self._cells.rows],
        )

    def _offered(
        self, grid: Grid
    ) -> tuple[dict[str, tuple[Place, str, NDArray[np.bool_] | None]], dict[str, FieldInfo]]:
        """Where each field is found: kind, name of its array, and the cells it is written for (None: all)."""
        arrays: dict[str, tuple[Place, str, NDArray[np.bool_] | None]] = {}
        fields: dict[str, FieldInfo] = {}

        def offer(name: str, place: str, info: tuple[Place, str, NDArray[np.bool_] | None], values: Any) -> None:
            if name not in fields:
                components = values.shape[1] if values.ndim == 2 else 1
                arrays[name] = info
                fields[name] = FieldInfo(name, place, components, quantity(name.removeprefix("cell_")))  # type: ignore[arg-type]

        for title, values in grid.point_data.items():
            plain = field_name(title)
            if _is_field(title, values) and plain not in DISPLACEMENT_NAMES:
                offer(plain, "node", ("point", title, None), values)
        for title, values in grid.cell_data.items():
            if not _is_field(title, values):
                continue
            plain, kind = _element_kind(title)
            theirs = {"1D": _LINE, "SPH": _VERTEX}.get(kind)
            if len(self._faces.rows) and kind in ("", "2D"):
                offer(plain, "face", ("cell", title, None), values)
            if len(self._cells.rows) and kind != "2D":
                told = None
                if kind:
                    types = self._cells.types
                    told = types == theirs if theirs else (types != _LINE) & (types != _VERTEX)
                word = {"": "cell_", "1D": "beam_", "3D": "solid_", "SPH": "sph_"}[kind]
                offer(word + plain, "cell", ("cell", title, told), values)
        return arrays, fields

    # Values of states

    def displacement(self, first: int, last: int) -> NDArray[np.float32]:
        how, reference = self._reading, self.mesh.position
        out = np.empty((last - first, len(reference), 3), np.float32)
        for row, state in enumerate(range(first, last)):
            points = self._points(state)
            if how.array is not None:
                values = self._array("point", how.array, state)
                if not how.moving and not np.array_equal(points, reference):
                    raise ReadError(
                        f"{self._source.place(state)}: its points have moved, but neither in the first nor in the last "
                        "state; expected them to stay or to move in every state"
                    )
                out[row] = values - reference if how.positions else values
            else:
                out[row] = points - reference
            if self._life is None:  # where elements erode, a node may end in NaN, which ingest checks
                require_finite(out[row], "the displacement", self._source.place(state))
        return out

    def field(self, name: str, first: int, last: int) -> NDArray[np.float32]:
        kind, title, told = self._arrays[name]
        values = np.stack([self._array(kind, title, s) for s in range(first, last)]).astype(np.float32)
        if kind == "point":
            return values
        values = values[:, (self._faces if self.fields[name].location == "face" else self._cells).rows]
        if told is not None:
            values[:, ~told] = np.nan
        return values

    def alive(self, first: int, last: int) -> NDArray[np.bool_] | None:
        return self._living(self._faces.rows, first, last)

    def alive_cells(self, first: int, last: int) -> NDArray[np.bool_] | None:
        return self._living(self._cells.rows, first, last) if len(self._cells.rows) else None

    def _living(self, rows: NDArray[np.int64], first: int, last: int) -> NDArray[np.bool_] | None:
        life = self._life
        if life is None:
            return None
        return np.stack([self._array("cell", life, s)[rows] != 0 for s in range(first, last)])

    def _points(self, state: int) -> NDArray[np.floating]:
        with reading(self._source.place(state)):
            return self._source.points(state)

    def _array(self, kind: Place, name: str, state: int) -> NDArray[Any]:
        with reading(self._source.place(state)):
            if kind == "point" and name in self._joined:
                found = np.stack([self._source.array(kind, title, state) for title in self._joined[name]], axis=1)
            else:
                found = self._source.array(kind, name, state)
        if found.shape != self._shapes[kind, name]:
            raise ReadError(
                f"{self._source.place(state)}: {kind} array {name!r} has shape {found.shape}, "
                f"expected {self._shapes[kind, name]} as in the first state"
            )
        return found

    def file_of(self, state: int) -> Path:
        return self._source.file_of(state)

    def close(self) -> None:
        self._source.close()


@dataclass(frozen=True)
class _Reading:
    """How displacements are found: in `array`, else in the points; `positions`: the array holds positions."""

    array: str | None
    moving: bool
    positions: bool


@dataclass(frozen=True)
class _Group:
    """Faces or cells of a grid: their rows in it, their nodes padded with -1, and their types."""

    rows: NDArray[np.int64]
    nodes: NDArray[np.int32]
    types: NDArray[np.uint8]


def _sort_cells(grid: Grid, place: str) -> tuple[_Group, _Group]:
    """Faces and cells of a grid, each in the grid's order.

    Raises
    ------
    ReadError
        For cells of another shape.
    """
    sizes = np.diff(grid.offsets)
    types = grid.types.copy()
    types[(types == _POLYGON) & (sizes == 3)] = _TRIANGLE
    types[(types == _POLYGON) & (sizes == 4)] = _QUAD
    types[(types == _POLYLINE) & (sizes == 2)] = _LINE
    types[(types == _POLYVERTEX) & (sizes == 1)] = _VERTEX
    types[(types == _TRIANGLE) & (sizes == 4)] = _QUAD  # a triangle with its last node twice
    count = len(types)
    width = max((len(_CELLS[t][0]) for t in np.unique(types).tolist() if t in _CELLS), default=0)
    faces, cells = np.full((count, 4), -1, np.int32), np.full((count, width), -1, np.int32)
    is_face = np.zeros(count, bool)
    linear = np.zeros(count, np.uint8)
    for kind in np.unique(types).tolist():
        corners = _FACES.get(kind) or _CELLS.get(kind, (None,))[0]
        rows = np.flatnonzero(types == kind)
        if corners is None or sizes[rows].min() <= max(corners):
            raise ReadError(
                f"{place}: cell {int(rows[0])} has VTK type {kind} with {int(sizes[rows[0]])} points; expected "
                "triangles, quadrilaterals, lines, vertices, tetrahedra, pyramids, wedges or hexahedra"
            )
        nodes = grid.connectivity[grid.offsets[rows][:, None] + np.asarray(corners)]
        if kind in _FACES:
            faces[rows, : len(corners)] = nodes
            is_face[rows] = True
        else:
            cells[rows, : len(corners)] = nodes
            linear[rows] = _CELLS[kind][1]
    face_rows, cell_rows = np.flatnonzero(is_face), np.flatnonzero(~is_face)
    quads = faces[face_rows]
    all_triangles = len(quads) > 0 and bool((quads[:, 3] < 0).all())
    return (
        _Group(
            face_rows, np.ascontiguousarray(quads[:, :3]) if all_triangles else shell_faces(quads), types[face_rows]
        ),
        _Group(cell_rows, cells[cell_rows], linear[cell_rows]),
    )


def _find(arrays: Mapping[str, NDArray[Any]], names: tuple[str, ...], everywhere: bool = True) -> str | None:
    """The first of `names` among the scalar arrays; `everywhere`: it must have a value for all."""
    lower = {n.lower(): n for n, v in arrays.items() if v.ndim == 1 and (not everywhere or np.isfinite(v).all())}
    return next((lower[n] for n in names if n in lower), None)


def _ids(arrays: Mapping[str, NDArray[Any]], names: tuple[str, ...], count: int) -> NDArray[np.int64]:
    name = _find(arrays, names)
    return np.arange(1, count + 1) if name is None else np.asarray(arrays[name], np.int64)


def _parts(
    grid: Grid, node_id: NDArray[np.int64], element_id: NDArray[np.int64]
) -> tuple[NDArray[np.int32], tuple[Part, ...]]:
    """Part index of every cell, and the parts.

    OpenRadioss draws rigid walls with elements and nodes numbered 0, and its converter gives them the number of
    the wall as part number: they become a part of their own.
    """
    name = _find(grid.cell_data, _PARTS)
    numbers = np.asarray(grid.cell_data[name], np.int64) if name else np.ones(len(grid.types), np.int64)
    wall = element_id == 0
    if wall.any():
        corner_cell = np.repeat(np.arange(len(grid.types)), np.diff(grid.offsets))
        wall[corner_cell[node_id[grid.connectivity] != 0]] = False
    found, owner = np.unique(numbers[~wall], return_inverse=True)
    index = np.full(len(numbers), len(found), np.int32)
    index[~wall] = owner
    parts = []
    for number in found.tolist():
        called = grid.part_names.get(number, f"part {number}" if name else "structure")
        parts.append(Part(number, called, WALL_NAME.search(called) is not None))
    if wall.any():
        parts.append(Part(0, "rigid wall", rigid_wall=True))
    return index, tuple(parts)


def _element_kind(title: str) -> tuple[str, str]:
    """Name of a cell array's field, and the elements it is written for: "1D", "2D", "3D", "SPH" or "" for all.

    OpenRadioss's converters write 2DELEM_Plastic_Strain or Plastic Strain_2D, and zeros on all other elements.
    """
    front = re.fullmatch(r"(1D|2D|3D|SPH)ELEM_(.+)", title)
    behind = re.fullmatch(r"(.+)_(1D|2D|3D|SPH)", title)
    name, kind = (front[2], front[1]) if front else (behind[1], behind[2]) if behind else (title, "")
    return field_name(name), kind


def _is_field(name: str, values: NDArray[Any]) -> bool:
    return name.lower() not in _NO_FIELDS and values.dtype.kind in "fiu" and values.ndim <= 2
