"""Exodus II files (.exo, .e, .g) with time, as classic NetCDF or HDF5.

A run that was computed on several processors lies in pieces, out.e.4.0 to out.e.4.3, which are joined by their maps
of node and element numbers. Where the mesh was refined on the way (out.e, out.e-s002, ...) the run is refused.

Coordinates are undeformed; the nodal variables DISPLX, DISPLY, DISPLZ (or displ_x, disp_x, ...) move them. Element
blocks become parts. An element variable is NaN in blocks that do not have it; `status` is 1 for living elements.

The file is read slice by slice, HDF5 by h5py and classic NetCDF by SciPy, which refuses one that is cut short.
vtkExodusIIReader is not used: it ended the interpreter or hung on 8 of 400 files with one bit flipped or the end cut
off, and reads a cut-off classic file as zeros (VTK 9.7).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import ReadError
from crashkit.readers import register
from crashkit.readers._folders import Collected, files_in, named, recognises, runs_in
from crashkit.readers._grid import Grid, GridSource, Place
from crashkit.readers._grid_run import GridRun
from crashkit.readers._hdf5_data import SIGNATURE, files_behind
from crashkit.readers._names import vectors_among
from crashkit.readers.base import Run, Runs
from crashkit.readers.checks import LIBRARY_ERRORS, closed_if_refused, reading, require_options

# Zeros behind a classic file up to this many are padding.
_PADDING = 1 << 20
_CLASSIC = (b"CDF\x01", b"CDF\x02")
# Beginning of an element type's name -> corners, VTK type. Nodes behind the corners are in the middle of edges.
_SHAPES = {
    "TRI": (3, 5), "QUAD": (4, 9), "SHELL": (4, 9), "TET": (4, 10), "HEX": (8, 12), "WEDGE": (6, 13), "PYR": (5, 14),
    "BAR": (2, 3), "BEAM": (2, 3), "TRUSS": (2, 3), "ROD": (2, 3), "EDGE": (2, 3), "SPHERE": (1, 1), "CIRCLE": (1, 1),
}  # fmt: skip
# Of a run in pieces: name of the whole, number of pieces, number of the piece. Of a refined mesh: the file before it.
_PIECE = re.compile(r"(?P<whole>.+)\.(?P<count>\d+)\.(?P<number>\d+)")
_REFINED = re.compile(r"(?P<first>.+)-s\d+")


class Exodus:
    """Reader of one file, of a folder with one file a run, or of a folder of such folders."""

    name = "exodus"
    description = "Exodus II with time (classic NetCDF or HDF5)"

    def sniff(self, path: Path) -> bool:
        return recognises(_found, path)

    def runs(self, path: Path, **options: object) -> Runs:
        require_options(self.name, options)
        found = _found(path) or Collected({path.stem: [path]} if path.is_file() else {})
        if not found:
            raise ReadError(f"{path}: no Exodus file here")
        return Runs({name: partial(_open, name, files) for name, files in found.runs.items()}, found.aside)


def _found(path: Path) -> Collected[list[Path]]:
    """Run name -> its file, or its pieces."""
    if path.is_file():
        if not _is_exodus(path):
            return Collected()
        piece = _PIECE.fullmatch(path.name)
        names = [p.name for p in files_in(path.parent)] if piece else []
        family = [path.parent / n for n in names if (m := _PIECE.fullmatch(n)) and piece and _same_family(m, piece)]
        return Collected({_stem(path): family or [path]})
    return runs_in(path, _found_in, own_name_at_top=True) if path.is_dir() else Collected()


def _found_in(folder: Path) -> Collected[list[Path]]:
    files = [p for p in files_in(folder) if _is_exodus(p)]
    aside = []
    families: dict[tuple[str, str], list[Path]] = {}
    for file in files:
        piece = _PIECE.fullmatch(file.name)
        families.setdefault((piece["whole"], piece["count"]) if piece else (file.name, ""), []).append(file)
    for whole, count in list(families):
        if count and (whole, "") in families:
            aside.append(f"{folder}: the pieces {whole}.{count}.* are left aside, since {whole} is there")
            del families[whole, count]
    # A mesh from before the run stands beside its results; alone, it is to be refused as what it is.
    meshes = [key for key, pieces in families.items() if len(families) > 1 and not _has_states(pieces[0])]
    if len(meshes) < len(families):
        for whole, count in meshes:
            aside.append(f"{folder}: {whole} is left aside, it is a mesh without states")
            del families[whole, count]
    listed = ((_stem(pieces[0]), whole, pieces) for (whole, _), pieces in families.items())
    return Collected(named(entry for entry in listed if not _is_continued(entry[2][0], files)), aside)


def _stem(file: Path) -> str:
    piece = _PIECE.fullmatch(file.name)
    return Path(piece["whole"]).stem if piece else file.stem


def _same_family(one: re.Match[str], other: re.Match[str]) -> bool:
    return (one["whole"], one["count"]) == (other["whole"], other["count"])


def _is_continued(file: Path, files: list[Path]) -> bool:
    """Whether a file goes on with another one after the mesh was refined (out.e-s002 with out.e)."""
    later = _REFINED.fullmatch(file.name)
    return later is not None and any(other.name == later["first"] for other in files)


def _is_exodus(file: Path) -> bool:
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        start = stream.read(8)
        if start[:4] in _CLASSIC:
            head = stream.read(1 << 16)
            return b"num_nodes" in head and b"num_el_blk" in head
    if start != SIGNATURE:
        return False
    import h5py

    try:
        with h5py.File(file, "r") as opened:
            return "eb_prop1" in opened and ("coordx" in opened or "coord" in opened)
    except LIBRARY_ERRORS:
        return False


def _has_states(file: Path) -> bool:
    try:
        with reading(file), closing(_opened(file)) as opened:
            return _count(opened, "time_whole") > 0
    except ReadError:
        return True  # what is damaged is to be named as that


def _count(opened: Any, name: str) -> int:
    """Length of a variable, 0 where there is none; SciPy can close its file only once nobody holds a variable."""
    variables = getattr(opened, "variables", opened)
    return int(variables[name].shape[0]) if name in variables else 0


def _open(name: str, files: list[Path]) -> Run:
    file = files[0]
    refined = [p for p in files_in(file.parent) if (m := _REFINED.fullmatch(p.name)) and m["first"] == file.name]
    if refined:
        raise ReadError(
            f"{file}: goes on in {refined[0].name}, so the mesh changes during the run, which is not supported; compute "
            "it on one mesh (no adaptivity)"
        )
    with reading(file):
        return GridRun(name, _Pieces(files) if _PIECE.fullmatch(file.name) else _Blocks(file))


class _Blocks(GridSource):
    """The variables of one file."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self._opened = _opened(file)
        with closed_if_refused(self._opened):
            self._behind: dict[str, set[Path]] = {}
            self.time = np.asarray(self._take("time_whole", ...), np.float64).reshape(-1)
            self._points = self._coordinates()
            self._read_blocks()
            self._nodal = _grouped(self._texts("name_nod_var"))
            self._element = _grouped(self._texts("name_elem_var"))
            for column in (c for columns in self._nodal.values() for c in columns):
                self._require_present(f"vals_nod_var{column + 1}")
            self.files = (file, *sorted(set().union(*self._behind.values())))
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
        self._require_present(name)
        with reading(f"{self.file}, {name}"):
            return np.array(self._variables[name][index])

    def _require_present(self, name: str) -> None:
        if name in self._variables and name not in self._behind:
            variable = self._variables[name]
            self._behind[name] = files_behind(variable, self.file) if hasattr(variable, "is_virtual") else set()

    def _unread(self) -> tuple[str, ...]:
        """A problem where a classic file goes on behind its last variable: then it holds more states than it says."""
        if not hasattr(self._opened, "variables"):  # HDF5 knows where it ends
            return ()
        end = max(_end(variable.data) for variable in self._variables.values())
        with self.file.open("rb") as stream:
            stream.seek(end)
            behind = stream.read(_PADDING + 1)
        # Some programs fill the file up to a block of the disk: zeros alone are no states.
        if len(behind) <= 3 or (len(behind) <= _PADDING and not behind.strip(b"\0")):
            return ()
        size = self.file.stat().st_size - end
        return (f"{self.file}: {size} bytes behind its last variable, at byte {end}; damaged",)

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


class _Pieces(GridSource):
    """A run in pieces, one file a processor: every node and element once, matched by their numbers."""

    def __init__(self, files: list[Path]) -> None:
        found = {int(m["number"]): file for file in files if (m := _PIECE.fullmatch(file.name))}
        match = _PIECE.fullmatch(files[0].name)
        count = int(match["count"]) if match else 0
        missing = sorted(set(range(count)) - set(found))
        if missing or len(found) != len(files):
            raise ReadError(
                f"{files[0]}: of its {count} pieces number {missing[0] if missing else count} is missing; join the whole "
                "run with epu, or copy all pieces"
            )
        self._pieces: list[_Blocks] = []
        with closed_if_refused(self):
            for k in sorted(found):
                self._pieces.append(_Blocks(found[k]))
            self.files = tuple(f for piece in self._pieces for f in piece.files)
            self.problems = tuple(p for piece in self._pieces for p in piece.problems)
            self.time = self._pieces[0].time
            self._grids = [piece.first() for piece in self._pieces]
            for piece, grid in zip(self._pieces, self._grids, strict=True):
                if not np.array_equal(piece.time, self.time):
                    raise ReadError(
                        f"{piece.file}: has other times than {self._pieces[0].file.name}; join them with epu"
                    )
                if "node_id" not in grid.point_data or "element_id" not in grid.cell_data:
                    raise ReadError(
                        f"{piece.file}: is piece of a run and has no node_num_map or elem_num_map; join the pieces with epu"
                    )
            ids = np.concatenate([g.point_data["node_id"] for g in self._grids])
            self._node_id, self._first, inverse = np.unique(ids, return_index=True, return_inverse=True)
            self._inverse = inverse.reshape(-1)
            points = np.concatenate([g.points for g in self._grids])
            self._points = points[self._first]
            if not np.array_equal(self._points[self._inverse], points):
                raise ReadError(
                    f"{files[0]}: its pieces have nodes of one number in different places; join them with epu"
                )

    def place(self, state: int) -> str:
        return f"{self.files[0]} and its pieces, state {state}"

    def first(self) -> Grid:
        grids = self._grids
        nodes = np.cumsum([0, *(len(g.points) for g in grids)])
        corners = np.cumsum([0, *(len(g.connectivity) for g in grids)])
        joined = np.concatenate([g.connectivity + start for g, start in zip(grids, nodes)])
        points = {n: self.array("point", n, 0) for n in self._common("point")}
        cells = {n: np.concatenate([g.cell_data[n] for g in grids]) for n in self._common("cell")}
        names = {number: name for g in grids for number, name in g.part_names.items()}
        return Grid(
            self._points,
            self._inverse[joined],
            np.concatenate([[0], *(g.offsets[1:] + start for g, start in zip(grids, corners))]),
            np.concatenate([g.types for g in grids]),
            {**points, "node_id": self._node_id},
            cells,
            part_names=names,
        )

    def _common(self, kind: Place) -> list[str]:
        """Names of the arrays that all pieces have, without the numbers of nodes."""
        arrays = [g.point_data if kind == "point" else g.cell_data for g in self._grids]
        return [n for n in arrays[0] if n != "node_id" and all(n in a for a in arrays)]

    def points(self, state: int) -> NDArray[np.floating]:
        return self._points

    def array(self, kind: Place, name: str, state: int) -> NDArray[Any]:
        values = np.concatenate([piece.array(kind, name, state) for piece in self._pieces])
        return values[self._first] if kind == "point" else values

    def close(self) -> None:
        for piece in self._pieces:
            piece.close()


def _grouped(names: list[str]) -> dict[str, tuple[int, ...]]:
    """Variables by name; three that end in x, y and z are one vector."""
    vectors = vectors_among(names)
    place = {name: k for k, name in enumerate(names)}
    taken = {title for titles in vectors.values() for title in titles}
    whole = {name: tuple(place[title] for title in titles) for name, titles in vectors.items()}
    return {**whole, **{name: (k,) for k, name in enumerate(names) if name not in taken}}


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
