"""What NVIDIA's PhysicsNeMo Curator makes of crash runs: one VTP file or one Zarr store a run.

VTP: points are the reference position, and the point arrays displacement_t0.000, displacement_t0.005, ... the states,
with the time in their names; other arrays named so (stress_vm_t0.005) are fields. Names with a bare number
(displacement_t003) count states.

Zarr: mesh_pos (state, node, 3) are positions, mesh_connectivity_flat and mesh_connectivity_offsets the cells; newer
stores have no cells but edges, and need a mesh file (option `mesh`). The stores hold no times.

Where times are missing, the option `time_step` gives the time between two states.

A trap: some versions take the positions of a d3plot for displacements. Where displacement_t of the first state is
the reference position instead of zero, the arrays are read as positions, with a warning in the log. In a Zarr store
made that way the positions are sums of two, which cannot be detected.
"""

from __future__ import annotations

import logging
import re
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
from crashkit.readers._vtk_process import point_array_names, read_xml
from crashkit.readers.base import Run, Runs
from crashkit.readers.checks import holds_positions, reading, require_options, time_step_option

_STATE = re.compile(r"(?P<name>.+)_t(?P<time>\d+(?:\.\d+)?)")
_DISPLACEMENT = "displacement"
_POSITION, _FLAT, _OFFSETS = "mesh_pos", "mesh_connectivity_flat", "mesh_connectivity_offsets"
# Arrays stand in headings, which come before appended data; with data between them the first will do.
_HEAD = 1 << 20
_log = logging.getLogger(__name__)


class PhysicsNemo:
    """Reader of one VTP file or Zarr store, or of a folder of them."""

    name = "physicsnemo"
    description = "PhysicsNeMo Curator's crash data: a VTP file with displacement_t... arrays, or a Zarr store, a run"

    def sniff(self, path: Path) -> bool:
        return recognises(_found, path)

    def runs(self, path: Path, **options: object) -> Runs:
        require_options(self.name, options, ("mesh", "time_step"))
        mesh, step = options.get("mesh"), time_step_option(options)
        found = _found(path)
        if not found:
            raise ReadError(
                f"{path}: no VTP file with arrays displacement_t... and no Zarr store with {_POSITION} here"
            )
        mesh_file = None if mesh is None else Path(str(mesh))
        return Runs(
            {name: partial(_open, name, file, mesh_file, step) for name, file in found.runs.items()}, found.aside
        )


def _found(path: Path) -> Collected[Path]:
    return one_file_each(path, lambda entry: _is_vtp(entry) or _is_zarr(entry))


def _is_vtp(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        if b'type="PolyData"' not in (head := stream.read(1024)):
            return False
        return f'Name="{_DISPLACEMENT}_t'.encode() in head + stream.read(_HEAD)


def _is_zarr(path: Path) -> bool:
    """A Zarr group of version 2 or 3 with the array of positions, by its metadata files."""
    group = any((path / name).is_file() for name in (".zgroup", "zarr.json"))
    return group and any((path / _POSITION / name).is_file() for name in (".zarray", "zarr.json"))


def _open(name: str, path: Path, mesh: Path | None, step: float | None) -> Run:
    with reading(path):
        return GridRun(name, _ZarrStore(path, mesh, step) if path.is_dir() else _VtpStates(path, step))


def _times(count: int, step: float | None, path: Path) -> NDArray[np.float64]:
    if step is None:
        raise ReadError(
            f"{path}: tells no times of its {count} states; give the time between two of them (--time-step)"
        )
    return np.arange(count, dtype=np.float64) * step


class _VtpStates(GridSource):
    """The states in the arrays of one VTP file; they are read one by one."""

    def __init__(self, file: Path, step: float | None) -> None:
        self.file, self.files = file, (file,)
        self._arrays: dict[str, dict[str, str]] = {}
        for title in point_array_names(file):
            if match := _STATE.fullmatch(title):
                self._arrays.setdefault(match["name"], {})[match["time"]] = title
        if _DISPLACEMENT not in self._arrays:
            raise ReadError(f"{file}: no point arrays {_DISPLACEMENT}_t...; found {', '.join(self._arrays) or 'none'}")
        told = sorted(self._arrays[_DISPLACEMENT], key=float)
        others = sorted({t for titles in self._arrays.values() for t in titles} - set(told), key=float)
        if others:
            self.problems = (f"{file}: has arrays of time {others[0]} but no {_DISPLACEMENT}_t{others[0]}; damaged",)
        self.time = np.array(told, np.float64) if any("." in t for t in told) else _times(len(told), step, file)
        self._states = [{name: titles.get(t) for name, titles in self._arrays.items()} for t in told]
        whole = read_xml(file, [])
        fields = [name for name in self._arrays if all(state[name] for state in self._states)]
        self._points = whole.points
        start = {name: self.array("point", name, 0) for name in fields}
        self._grid = Grid(whole.points, whole.connectivity, whole.offsets, whole.types, start)
        if holds_positions(self._grid.point_data[_DISPLACEMENT], whole.points):
            _log.warning("%s: its displacement arrays hold positions; they are read as such", file)

    def place(self, state: int) -> str:
        return f"{self.file}, state {state} ({self._states[state][_DISPLACEMENT]})"

    def first(self) -> Grid:
        return self._grid

    def points(self, state: int) -> NDArray[np.floating]:
        return self._grid.points

    def array(self, kind: Place, name: str, state: int) -> NDArray[Any]:
        title = self._states[state][name]
        found = read_xml(self.file, [title]).point_data.get(title) if title else None
        if found is None or len(found) != len(self._points):
            raise ReadError(f"{self.place(state)}: its array {title} cannot be read; the file is damaged")
        return found


class _ZarrStore(GridSource):
    """One Zarr store, read state by state."""

    def __init__(self, path: Path, mesh: Path | None, step: float | None) -> None:
        import zarr

        self.path = path
        self.files = tuple(sorted(p for p in path.rglob("*") if p.is_file()))
        self._store: Any = zarr.open_group(str(path), mode="r")
        position: Any = self._store[_POSITION]
        shape, kind = position.shape, position.dtype.kind
        if len(shape) != 3 or shape[2] != 3 or 0 in shape or kind != "f":
            raise ReadError(f"{path}: {_POSITION} has shape {shape}, expected (state, node, 3)")
        self._position = position
        self.time = _times(shape[0], step, path)
        self._require_chunks()
        connectivity, offsets = self._cells(mesh)
        sizes = np.diff(offsets)
        types = np.full(len(sizes), 7, np.uint8)  # polygons; what they are is told by their number of corners
        self._grid = Grid(self.points(0), connectivity, offsets, types)

    def _require_chunks(self) -> None:
        """A chunk that is missing reads as fill values, which would be zeros."""
        position = self._position
        missing = position.nchunks - position.nchunks_initialized
        if missing:
            raise ReadError(
                f"{self.path}: {missing} of {position.nchunks} chunks of {_POSITION} are missing; copy it again"
            )

    def _cells(self, mesh: Path | None) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        if _FLAT in self._store and _OFFSETS in self._store:
            flat, offsets = (self._read(self._store[name], ...).astype(np.int64) for name in (_FLAT, _OFFSETS))
            return flat, offsets
        if mesh is None:
            raise ReadError(
                f"{self.path}: has no {_FLAT}, so its cells are not known; "
                "name a mesh file with the same nodes (--mesh FILE)"
            )
        from crashkit.readers._mesh_file import faces_of

        faces = faces_of(mesh, self._read(self._position, 0))
        valid = faces >= 0
        return faces[valid].astype(np.int64), np.concatenate([[0], np.cumsum(valid.sum(axis=1))])

    def _read(self, array: Any, index: Any) -> NDArray[Any]:
        with reading(f"{self.path}, {array.name}"):
            return np.asarray(array[index])

    def place(self, state: int) -> str:
        return f"{self.path}, state {state}"

    def first(self) -> Grid:
        return self._grid

    def points(self, state: int) -> NDArray[np.floating]:
        return self._read(self._position, state)

    def array(self, kind: Place, name: str, state: int) -> NDArray[Any]:
        raise KeyError(name)


register(PhysicsNemo())
