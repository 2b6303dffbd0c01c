"""VTKHDF files with time: `Steps` in an UnstructuredGrid, in PolyData, or in the parts of a collection of them.

The layout is that of VTK's documentation (VTKHDF 2.x): everything lies one behind the other, and `Steps` says where
each state begins in each array. It is read with h5py, slice by slice: VTK's reader loads whole states, and takes an
offset from a damaged file for granted.

The parts of a PartitionedDataSetCollection (or MultiBlockDataSet) become the run's parts, named as in the file; an
array that a part does not have is NaN there. A part called a rigid wall (RWALL_1) is taken for one.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import ReadError
from crashkit.readers import register
from crashkit.readers._folders import Collected, one_file_each, recognises
from crashkit.readers._grid import Grid, GridSource, Place
from crashkit.readers._grid_run import GridRun
from crashkit.readers._hdf5_data import SIGNATURE, files_behind
from crashkit.readers.base import Run, Runs
from crashkit.readers.checks import LIBRARY_ERRORS, closed_if_refused, reading, require_options

_GRIDS = ("UnstructuredGrid", "PolyData")
_COLLECTIONS = ("PartitionedDataSetCollection", "MultiBlockDataSet")
_POLYDATA = {"Vertices": 2, "Lines": 4, "Polygons": 7}
_CHUNK_CACHE = 64 << 20


class VtkHdf:
    """Reader of one file, of a folder with one file a run, or of a folder of such folders."""

    name = "vtkhdf"
    description = "VTKHDF with time (UnstructuredGrid, PolyData, or a collection of them)"

    def sniff(self, path: Path) -> bool:
        return recognises(_found, path)

    def runs(self, path: Path, **options: object) -> Runs:
        require_options(self.name, options)
        found = _found(path) or Collected({path.stem: path} if path.is_file() else {})
        if not found:
            raise ReadError(f"{path}: no VTKHDF file here")
        return Runs({name: partial(_open, name, file) for name, file in found.runs.items()}, found.aside)


def _found(path: Path) -> Collected[Path]:
    return one_file_each(path, _is_vtkhdf)


def _is_vtkhdf(file: Path) -> bool:
    import h5py

    if not file.is_file():
        return False
    with file.open("rb") as stream:
        if stream.read(8) != SIGNATURE:
            return False
    try:
        with h5py.File(file, "r") as opened:
            return "VTKHDF" in opened and _kind(opened["VTKHDF"]) in (*_GRIDS, *_COLLECTIONS)
    except LIBRARY_ERRORS:
        return False


def _kind(group: Any) -> str:
    return _text(group.attrs.get("Type"))


def _text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else "" if value is None else str(value)


def _open(name: str, file: Path) -> Run:
    with reading(file):
        return GridRun(name, _Steps(file))


class _Part:
    """One UnstructuredGrid or PolyData of a file; every slice is checked against the array it is taken from."""

    def __init__(self, file: Path, group: Any) -> None:
        self.file, self._group = file, group
        self._behind: dict[str, set[Path]] = {}
        self.name = group.name.rsplit("/", 1)[-1]
        if "Steps" not in group:
            raise ReadError(f"{file}: {group.name} has one state without time; expected a group Steps")
        self.time = self._all("Steps/Values").astype(np.float64)
        self._lists = [""] if _kind(group) == "UnstructuredGrid" else list(_POLYDATA)
        pieces = self._all("Steps/NumberOfParts") if "Steps/NumberOfParts" in group else np.ones(len(self.time), int)
        if (pieces != 1).any():
            raise ReadError(
                f"{file}: state {int(np.argmax(pieces != 1))} of {group.name} is in {int(pieces.max())} pieces, expected 1"
            )
        self.nodes = self._number("NumberOfPoints", 0)
        self.mesh = self._cells(0)
        self._same = {self._cell_place(0)}

    def _dataset(self, name: str) -> Any:
        import h5py

        found = self._group.get(name)
        if not isinstance(found, h5py.Dataset):
            raise ReadError(
                f"{self.file}: no dataset {self._group.name}/{name}; it is damaged or no VTKHDF of version 2"
            )
        if name not in self._behind:
            self._behind[name] = files_behind(found, self.file)
        return found

    def _all(self, name: str) -> NDArray[Any]:
        return self._slice(name, 0, len(self._dataset(name)))

    def _slice(self, name: str, first: int, last: int) -> NDArray[Any]:
        found = self._dataset(name)
        if not 0 <= first <= last <= len(found):
            raise ReadError(
                f"{self.file}: rows {first} to {last} of {found.name} are asked for, it has {len(found)}; "
                "the file is damaged"
            )
        with reading(f"{self.file}, {found.name}"):
            return np.asarray(found[first:last])

    def _offset(self, name: str, state: int, column: int = 0) -> int:
        """Where a state begins in an array; 0 where the file does not say."""
        if f"Steps/{name}" not in self._group:
            return 0
        row = self._slice(f"Steps/{name}", state, state + 1).reshape(-1)
        return int(row[min(column, len(row) - 1)])

    def _number(self, name: str, state: int) -> int:
        # A number that is stored once holds for all states.
        piece = self._offset("PartOffsets", state) if len(self._dataset(name)) > 1 else 0
        return int(self._slice(name, piece, piece + 1)[0])

    def _cell_place(self, state: int) -> tuple[int, ...]:
        """Where the cells of a state stand: states at the same place have the same cells."""
        named = ("CellOffsets", "ConnectivityIdOffsets")
        offsets = [self._offset(name, state, k) for name in named for k in range(len(self._lists))]
        return (self._offset("PartOffsets", state), *offsets)

    def _cells(self, state: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint8]]:
        """Connectivity, offsets (cell + 1) and types of the cells of a state, all lists one behind the other."""
        joined, ends, types = [], [np.zeros(1, np.int64)], []
        start = 0
        piece = self._offset("PartOffsets", state)
        for column, group in enumerate(self._lists):
            at = f"{group}/" if group else ""
            cells = self._number(f"{at}NumberOfCells", state)
            corners = self._number(f"{at}NumberOfConnectivityIds", state)
            cell_at = self._offset("CellOffsets", state, column)
            corner_at = self._offset("ConnectivityIdOffsets", state, column)
            offsets = self._cell_offsets(f"{at}Offsets", cell_at, piece, cells, corners)
            joined.append(self._slice(f"{at}Connectivity", corner_at, corner_at + corners).astype(np.int64))
            ends.append(offsets[1:] + start)
            start += corners
            if group:
                types.append(np.full(cells, _POLYDATA[group], np.uint8))
            else:
                types.append(self._slice("Types", cell_at, cell_at + cells).astype(np.uint8))
        return np.concatenate(joined), np.concatenate(ends), np.concatenate(types)

    def _cell_offsets(self, name: str, cell_at: int, piece: int, cells: int, corners: int) -> NDArray[np.int64]:
        """Where the cells of a state begin in their corners, (cells + 1,), from 0 to `corners`.

        Every piece before has one more offset than cells, so a state's begin at `cell_at + piece`; but where the
        cells are stored once for all states and `piece` counts on, they begin at `cell_at`.
        """
        for start in dict.fromkeys((cell_at + piece, cell_at)):
            if start + cells < len(self._dataset(name)):
                found = self._slice(name, start, start + cells + 1).astype(np.int64)
                if found[0] == 0 and found[-1] == corners and (np.diff(found) >= 0).all():
                    return found
        raise ReadError(
            f"{self.file}: {self._group.name}/{name} does not lead from 0 to {corners} in the {cells} cells of piece "
            f"{piece}; the file is damaged"
        )

    def points(self, state: int) -> NDArray[Any]:
        nodes, place = self._number("NumberOfPoints", state), self._cell_place(state)
        if place not in self._same or nodes != self.nodes:
            now, then = self._cells(state), self.mesh
            if nodes != self.nodes or not all(np.array_equal(now[k], then[k]) for k in range(3)):
                raise ReadError(
                    f"{self.file}, state {state}: the mesh {self._group.name} is not that of the first state; "
                    "it changed during the run, which is not supported"
                )
            self._same.add(place)
        first = self._offset("PointOffsets", state)
        return self._slice("Points", first, first + nodes)

    def require_present(self) -> None:
        """Values that are absent are to be found now, not while the run is read."""
        for name in ("Points", *(f"{g}/{n}" for g in ("PointData", "CellData") for n in self._group.get(g, {}))):
            self._dataset(name)

    @property
    def files(self) -> set[Path]:
        """Files that hold values beside the one that was opened."""
        return set().union(*self._behind.values())

    def arrays(self, kind: Place) -> dict[str, str]:
        """Name -> unit of its point or cell arrays."""
        group = self._group.get("PointData" if kind == "point" else "CellData", {})
        return {name: _text(group[name].attrs.get("units")) for name in group}

    def array(self, kind: Place, name: str, state: int) -> NDArray[Any]:
        group, count = ("PointData", self.nodes) if kind == "point" else ("CellData", len(self.mesh[2]))
        if kind == "cell" and sum(self._number(f"{g}/NumberOfCells", 0) > 0 for g in self._lists if g) > 1:
            raise ReadError(
                f"{self.file}: {self._group.name} has cell data on several kinds of cells, which is not read"
            )
        first = self._offset(f"{group}Offsets/{name}", state)
        return self._slice(f"{group}/{name}", first, first + count)


class _Steps(GridSource):
    """The states of one file; the parts of a collection one behind the other."""

    def __init__(self, file: Path) -> None:
        import h5py

        self.file, self.files = file, (file,)
        self._opened = h5py.File(file, "r", rdcc_nbytes=_CHUNK_CACHE)
        with closed_if_refused(self._opened):
            root = self._opened.get("VTKHDF")
            kind = _kind(root) if isinstance(root, h5py.Group) else ""
            if kind in _COLLECTIONS:
                groups = [g for g in root.values() if isinstance(g, h5py.Group) and _kind(g) in _GRIDS]
            elif kind in _GRIDS:
                groups = [root]
            else:
                groups = []
            if not groups:
                raise ReadError(
                    f"{file}: holds VTKHDF type {kind or 'nothing'}, expected {' or '.join(_GRIDS)} with Steps"
                )
            self._parts = [_Part(file, group) for group in groups]
            self.time = self._parts[0].time
            for part in self._parts:
                if not np.array_equal(part.time, self.time):
                    raise ReadError(f"{file}: part {part.name} has other times than part {self._parts[0].name}")

            for part in self._parts:
                part.require_present()
            self.files = (file, *sorted(set().union(*(part.files for part in self._parts))))

    def place(self, state: int) -> str:
        return f"{self.file}, state {state}"

    def first(self) -> Grid:
        nodes = np.cumsum([0, *(part.nodes for part in self._parts)])
        corners = np.cumsum([0, *(len(part.mesh[0]) for part in self._parts)])
        units = {
            name: unit for part in self._parts for kind in ("point", "cell") for name, unit in part.arrays(kind).items()
        }
        numbers = np.arange(1, len(self._parts) + 1)
        cell_data = {name: self.array("cell", name, 0) for name in self._names("cell")}
        names: dict[int, str] = {}
        if len(self._parts) > 1:
            cell_data["part_id"] = np.repeat(numbers, [len(part.mesh[2]) for part in self._parts])
            names = dict(zip(numbers.tolist(), (part.name for part in self._parts), strict=True))
        return Grid(
            self.points(0),
            np.concatenate([part.mesh[0] + start for part, start in zip(self._parts, nodes)]),
            np.concatenate([[0], *(part.mesh[1][1:] + start for part, start in zip(self._parts, corners))]),
            np.concatenate([part.mesh[2] for part in self._parts]),
            {name: self.array("point", name, 0) for name in self._names("point")},
            cell_data,
            part_names=names,
            units=units,
        )

    def _names(self, kind: Place) -> list[str]:
        return list(dict.fromkeys(name for part in self._parts for name in part.arrays(kind)))

    def points(self, state: int) -> NDArray[np.floating]:
        return np.concatenate([part.points(state) for part in self._parts])

    def array(self, kind: Place, name: str, state: int) -> NDArray[Any]:
        if len(self._parts) == 1:
            return self._parts[0].array(kind, name, state)
        found = [part.array(kind, name, state) if name in part.arrays(kind) else None for part in self._parts]
        shapes = {values.shape[1:] for values in found if values is not None}
        if len(shapes) > 1:
            raise ReadError(f"{self.place(state)}: array {name!r} has {sorted(shapes)} components in its parts")
        width = shapes.pop()
        sizes = [part.nodes if kind == "point" else len(part.mesh[2]) for part in self._parts]
        return np.concatenate(
            [np.full((size, *width), np.nan) if v is None else v for v, size in zip(found, sizes, strict=True)]
        )

    def close(self) -> None:
        self._opened.close()


register(VtkHdf())
