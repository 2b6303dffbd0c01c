"""Exodus II files (.exo, .e, .g) with time, as classic NetCDF or HDF5.

Coordinates are undeformed; the nodal variables DISPLX, DISPLY, DISPLZ (or displ_x, disp_x, ...) move them. Element
blocks become parts. An element variable is NaN in blocks that do not have it; `status` is 1 for living elements.

The file is read slice by slice, HDF5 by h5py and classic NetCDF by SciPy, which refuses one that is cut short.
vtkExodusIIReader is not used: it ended the interpreter or hung on 8 of 400 files with one bit flipped or the end cut
off, and reads a cut-off classic file as zeros (VTK 9.7).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import ReadError
from crashkit.readers import register
from crashkit.readers._checks import LIBRARY_ERRORS, reading, require_options
from crashkit.readers._folders import runs_in
from crashkit.readers._grid import Grid, GridSource, Place
from crashkit.readers._grid_run import GridRun
from crashkit.readers.base import Run, Runs

_CLASSIC, _HDF5 = (b"CDF\x01", b"CDF\x02"), b"\x89HDF\r\n\x1a\n"
# Beginning of an element type's name -> corners, VTK type. Nodes behind the corners are in the middle of edges.
_SHAPES = {
    "TRI": (3, 5), "QUAD": (4, 9), "SHELL": (4, 9), "TET": (4, 10), "HEX": (8, 12), "WEDGE": (6, 13), "PYR": (5, 14),
    "BAR": (2, 3), "BEAM": (2, 3), "TRUSS": (2, 3), "ROD": (2, 3), "EDGE": (2, 3), "SPHERE": (1, 1), "CIRCLE": (1, 1),
}  # fmt: skip
_VECTOR = re.compile(r"(?P<name>.+?)_?(?P<axis>[xyz])", re.IGNORECASE)


class Exodus:
    """Reader of one file, of a folder with one file a run, or of a folder of such folders."""

    name = "exodus"
    description = "Exodus II with time (classic NetCDF or HDF5)"

    def sniff(self, path: Path) -> bool:
        try:
            return bool(_files(path))
        except OSError:
            return False

    def runs(self, path: Path, **options: object) -> Runs:
        require_options(self.name, options)
        files = _files(path) or ({path.stem: path} if path.is_file() else {})
        if not files:
            raise ReadError(f"{path}: no Exodus file here")
        return Runs({name: partial(_open, name, file) for name, file in files.items()})


def _files(path: Path) -> dict[str, Path]:
    if path.is_file():
        return {path.stem: path} if _is_exodus(path) else {}
    if not path.is_dir():
        return {}
    return _files_in(path) or runs_in(path, _files_in)


def _files_in(folder: Path) -> dict[str, Path]:
    return {p.stem: p for p in sorted(folder.iterdir()) if p.is_file() and _is_exodus(p)}


def _is_exodus(file: Path) -> bool:
    with file.open("rb") as stream:
        start = stream.read(8)
        if start[:4] in _CLASSIC:
            head = stream.read(1 << 16)
            return b"num_nodes" in head and b"num_el_blk" in head
    if start != _HDF5:
        return False
    import h5py

    try:
        with h5py.File(file, "r") as opened:
            return "eb_prop1" in opened and ("coordx" in opened or "coord" in opened)
    except LIBRARY_ERRORS:
        return False


def _open(name: str, file: Path) -> Run:
    with reading(file):
        return GridRun(name, _Blocks(file))


class _Blocks(GridSource):
    """The variables of one file."""

    def __init__(self, file: Path) -> None:
        self.file, self.files = file, (file,)
        self._opened = _opened(file)
        self.time = np.asarray(self._take("time_whole", ...), np.float64).reshape(-1)
        self._points = self._coordinates()
        self._read_blocks()
        self._nodal = _grouped(self._texts("name_nod_var"))
        self._element = _grouped(self._texts("name_elem_var"))
        self.problems = self._unread()

    def place(self, state: int) -> str:
        return f"{self.file}, state {state}"

    @property
    def _variables(self) -> Mapping[str, Any]:
        # Asked for anew each time: SciPy can close its file only once nobody holds a variable.
        variables: Mapping[str, Any] = getattr(self._opened, "variables", self._opened)
        return variables

    def _take(self, name: str, index: Any) -> NDArray[Any]:
        if name not in self._variables:
            raise ReadError(f"{self.file}: has no variable {name}; it is damaged or holds no states")
        with reading(f"{self.file}, {name}"):
            return np.array(self._variables[name][index])

    def _unread(self) -> tuple[str, ...]:
        """A problem where a classic file goes on behind its last variable: then it holds more states than it says."""
        if not hasattr(self._opened, "variables"):  # HDF5 knows where it ends
            return ()
        end = max(_end(variable.data) for variable in self._variables.values())
        behind = self.file.stat().st_size - end
        return (f"{self.file}: {behind} bytes behind its last variable, at byte {end}; damaged",) if behind > 3 else ()

    def _texts(self, name: str) -> list[str]:
        if name not in self._variables:
            return []
        rows = np.atleast_2d(self._take(name, ...))
        return [b"".join(row.astype("S1")).split(b"\0")[0].decode("latin-1").strip() for row in rows]

    def _coordinates(self) -> NDArray[np.float64]:
        if "coordx" in self._variables:
            axes = [self._take(f"coord{axis}", ...) for axis in "xyz" if f"coord{axis}" in self._variables]
        else:
            axes = list(np.atleast_2d(self._take("coord", ...)))
        points = np.zeros((len(axes[0]), 3))
        points[:, : len(axes)] = np.stack(axes, axis=1)
        return points

    def _read_blocks(self) -> None:
        ids = self._take("eb_prop1", ...).astype(np.int64)
        names = self._texts("eb_names")
        self._sizes: list[int] = []
        joined, corners, types = [], [np.zeros(0, np.int64)], []
        for k in range(len(ids)):
            name = f"connect{k + 1}"
            if name not in self._variables:  # an empty block
                self._sizes.append(0)
                continue
            nodes = self._take(name, ...).astype(np.int64) - 1
            kind = _attribute(self._variables[name], "elem_type").upper()
            shape = next((shape for start, shape in _SHAPES.items() if kind.startswith(start)), None)
            if shape is None or nodes.ndim != 2 or nodes.shape[1] < min(3, shape[0]):
                raise ReadError(f"{self.file}: block {ids[k]} holds elements {kind!r}, which are not read")
            count, vtk_type = (3, 5) if nodes.shape[1] == 3 and shape == _SHAPES["SHELL"] else shape
            joined.append(nodes[:, :count].reshape(-1))
            corners.append(np.full(len(nodes), count, np.int64))
            types.append(np.full(len(nodes), vtk_type, np.uint8))
            self._sizes.append(len(nodes))
        self._connectivity = np.concatenate(joined) if joined else np.zeros(0, np.int64)
        self._offsets = np.concatenate([[0], np.cumsum(np.concatenate(corners))])
        self._types = np.concatenate(types) if types else np.zeros(0, np.uint8)
        self._part = np.repeat(ids, self._sizes)
        self._part_names = {int(n): t for n, t in zip(ids, names) if t}

    def first(self) -> Grid:
        points = {name: self.array("point", name, 0) for name in self._nodal}
        cells = {name: self.array("cell", name, 0) for name in self._element}
        cells["part_id"] = self._part
        for name, place, arrays in (("node_num_map", "node_id", points), ("elem_num_map", "element_id", cells)):
            if name in self._variables:
                arrays[place] = self._take(name, ...).astype(np.int64)
        return Grid(
            self._points, self._connectivity, self._offsets, self._types, points, cells, part_names=self._part_names
        )

    def points(self, state: int) -> NDArray[np.floating]:
        return self._points

    def array(self, kind: Place, name: str, state: int) -> NDArray[Any]:
        columns = (self._nodal if kind == "point" else self._element)[name]
        values = [self._nodal_values(k, state) if kind == "point" else self._element_values(k, state) for k in columns]
        return values[0] if len(values) == 1 else np.stack(values, axis=1)

    def _nodal_values(self, column: int, state: int) -> NDArray[Any]:
        name = f"vals_nod_var{column + 1}"
        if name in self._variables:
            return self._take(name, state)
        return self._take("vals_nod_var", (state, column))  # all variables in one, as older files have it

    def _element_values(self, column: int, state: int) -> NDArray[Any]:
        found = []
        for block, size in enumerate(self._sizes):
            name = f"vals_elem_var{column + 1}eb{block + 1}"
            found.append(self._take(name, state) if name in self._variables else np.full(size, np.nan))
        return np.concatenate(found)

    def close(self) -> None:
        self._opened.close()


def _grouped(names: list[str]) -> dict[str, tuple[int, ...]]:
    """Variables by name; three that end in x, y and z are one vector."""
    axes: dict[str, dict[str, int]] = {}
    for k, name in enumerate(names):
        if match := _VECTOR.fullmatch(name):
            axes.setdefault(match["name"], {})[match["axis"].lower()] = k
    vectors = {name: tuple(found[a] for a in "xyz") for name, found in axes.items() if len(found) == 3}
    taken = {k for columns in vectors.values() for k in columns}
    return {**vectors, **{name: (k,) for k, name in enumerate(names) if k not in taken}}


def _opened(file: Path) -> Any:
    """The opened file, by SciPy (its variables in `variables`) or h5py (itself a mapping)."""
    with file.open("rb") as stream:
        classic = stream.read(4) in _CLASSIC
    if classic:
        from scipy.io import netcdf_file

        return netcdf_file(str(file), "r", mmap=True)
    import h5py

    return h5py.File(file, "r")


def _end(values: NDArray[Any]) -> int:
    """Where an array ends in the mapped file that it is a view of."""
    root = values
    while isinstance(root.base, np.ndarray):
        root = root.base
    return int(np.lib.array_utils.byte_bounds(values)[1] - np.lib.array_utils.byte_bounds(root)[0])


def _attribute(variable: Any, name: str) -> str:
    value = variable.attrs.get(name, "") if hasattr(variable, "attrs") else getattr(variable, name, "")
    value = value if isinstance(value, (bytes, str)) else (np.atleast_1d(value)[0] if np.size(value) else "")
    return value.decode("latin-1") if isinstance(value, bytes) else str(value)


register(Exodus())
