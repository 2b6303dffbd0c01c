"""VTK files with time: a PVD collection of VTU or VTP, or files with a number each.

A run is a `.pvd`; or a `.series` list as ParaView writes it; or files that differ by a number in their name
(run_0000.vtu, kartA001.vtk), each with its time in the field data (TimeValue, or TIME as OpenRadioss's converter to
legacy VTK writes it). VTU and VTP are read by VTK, legacy files here (both for reasons told in the modules that do
it).

Of legacy files made from OpenRadioss, the solver's node, element and part numbers are kept, EROSION_STATUS (1 for
living elements) becomes `alive`, and elements numbered 0 on nodes numbered 0 are a rigid wall.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import CrashkitError, ReadError
from crashkit.readers import register
from crashkit.readers._checks import reading, require_options
from crashkit.readers._folders import runs_in
from crashkit.readers._grid import Grid, WholeStates
from crashkit.readers._grid_run import GridRun
from crashkit.readers._vtk_legacy import is_legacy, legacy_field_data, read_legacy
from crashkit.readers._vtk_process import read_xml
from crashkit.readers.base import Run, Runs

_NUMBERED = re.compile(r"(?P<stem>.*?)(?P<number>\d+)")
_XML_GRID = re.compile(rb'<VTKFile[^>]*type="(UnstructuredGrid|PolyData)"')
_COLLECTION = re.compile(rb'<VTKFile[^>]*type="Collection"')
_TIMES = ("timevalue", "time")
# Of files with all states in arrays of one mesh, which another reader knows.
_STATES_IN_ARRAYS = b'Name="displacement_t'
_HEAD = 1 << 14


class VtkSeries:
    """Reader of PVD collections, file series and numbered VTU, VTP and legacy VTK files, or a folder of them."""

    name = "vtk-series"
    description = "VTK files with time: PVD with VTU or VTP, or numbered VTU, VTP and legacy VTK files"

    def sniff(self, path: Path) -> bool:
        try:
            return bool(_found(path))
        except (OSError, CrashkitError):
            return False

    def runs(self, path: Path, **options: object) -> Runs:
        require_options(self.name, options)
        found = _found(path)
        if not found:
            raise ReadError(f"{path}: no VTK files with time (.pvd, .series, or numbered .vtu, .vtp, .vtk files) here")
        return Runs({name: partial(_open, name, files) for name, files in found.items()})


def _found(path: Path) -> dict[str, Sequence[Path]]:
    """Run name -> its list of states (one .pvd or .series file), or the files of its states."""
    if path.is_file():
        kind = _kind(path)
        if kind in ("pvd", "series"):
            return {_stem(path): [path]}
        if kind != "grid":
            return {}
        numbered = _numbered(path.parent)
        alone = path.resolve().parent.name if len(numbered) == 1 else None
        return next(({alone or name: files} for name, files in numbered.items() if path in files), {})
    if not path.is_dir():
        return {}
    # A list of states names what stands in the folders beside it.
    return _lists(path) or runs_in(path, lambda folder: _lists(folder) or dict(_numbered(folder)))


def _lists(folder: Path) -> dict[str, Sequence[Path]]:
    lists = [p for p in sorted(folder.iterdir()) if p.suffix in (".pvd", ".series") and _kind(p) in ("pvd", "series")]
    return {_stem(p): [p] for p in lists}


def _stem(file: Path) -> str:
    return file.name.split(".")[0]


def _numbered(folder: Path) -> dict[str, list[Path]]:
    """Families of at least two files that differ by a number, in the order of their numbers."""
    families: dict[tuple[str, str], dict[int, Path]] = {}
    for file in sorted(folder.iterdir()):
        match = _NUMBERED.fullmatch(file.stem)
        if match and file.suffix in (".vtu", ".vtp", ".vtk") and file.is_file():
            families.setdefault((match["stem"], file.suffix), {})[int(match["number"])] = file
    found = {}
    for (stem, _), files in families.items():
        ordered = [files[n] for n in sorted(files)]
        if len(ordered) > 1 and any(_kind(f) == "grid" for f in ordered):
            found[stem.rstrip("_.- ") or folder.resolve().name] = ordered
    return found


def _kind(file: Path) -> str:
    """What a file is by its content: "pvd", "series", "grid", or "" for anything else."""
    with file.open("rb") as stream:
        head = stream.read(_HEAD)
    if _COLLECTION.search(head):
        return "pvd"
    if _XML_GRID.search(head):
        return "" if _STATES_IN_ARRAYS in head else "grid"
    if head.lstrip().startswith(b"{") and b"file-series-version" in head:
        return "series"
    return "grid" if is_legacy(file) else ""


def _open(name: str, files: Sequence[Path]) -> Run:
    with reading(files[0]):
        return _opened(name, files)


def _opened(name: str, files: Sequence[Path]) -> Run:
    kind = _kind(files[0]) if len(files) == 1 else "grid"
    if kind in ("pvd", "series"):
        listed = _collection(files[0]) if kind == "pvd" else _file_series(files[0])
        missing = [f for _, pieces in listed for f in pieces if not f.is_file()]
        listed = [(time, pieces) for time, pieces in listed if all(f.is_file() for f in pieces)]
        if not listed:
            raise ReadError(
                f"{files[0]}: none of the files it lists is there ({missing[0] if missing else 'it lists none'})"
            )
        source = FileSeries(listed, index=files[0])
        run = GridRun(name, source, _solver(source))
        if missing:
            text = f"{files[0]}: {len(missing)} of the files it lists are missing: {missing[0].name}"
            run.problems = (text + (", ..." if len(missing) > 1 else ""), *run.problems)
        return run
    source = FileSeries([(_time_of(f), (f,)) for f in files])
    run = GridRun(name, source, _solver(source))
    run.problems = (*_gaps(files), *run.problems)
    return run


def _gaps(files: Sequence[Path]) -> list[str]:
    """Numbers that are missing between the first and the last; steps of ten, say, are no gaps."""
    numbers = [int(m["number"]) for f in files if (m := _NUMBERED.fullmatch(f.stem))]
    steps = np.diff(numbers)
    if not len(steps) or (steps == steps.min()).all():
        return []
    k = int(np.argmax(steps != steps.min()))
    return [f"{files[k].parent}: {files[k].name} is followed by {files[k + 1].name}; files between them are missing"]


def _collection(file: Path) -> list[tuple[float, tuple[Path, ...]]]:
    """Time and files of every state of a PVD; several files of one time are pieces of one mesh."""
    try:
        root = ElementTree.fromstring(file.read_bytes())
        states: dict[float, list[Path]] = {}
        for entry in root.iter("DataSet"):
            states.setdefault(float(entry.attrib["timestep"]), []).append(file.parent / entry.attrib["file"])
    except (ElementTree.ParseError, KeyError, ValueError) as error:
        raise ReadError(f"{file}: not readable as a PVD collection ({error}); it is cut short or damaged") from error
    return [(time, tuple(pieces)) for time, pieces in states.items()]


def _file_series(file: Path) -> list[tuple[float, tuple[Path, ...]]]:
    try:
        listed = json.loads(file.read_text())["files"]
        return [(float(entry["time"]), (file.parent / entry["name"],)) for entry in listed]
    except (ValueError, KeyError, TypeError) as error:
        raise ReadError(f"{file}: not readable as a file series ({error}); it is cut short or damaged") from error


def _time_of(file: Path) -> float:
    data = legacy_field_data(file) if is_legacy(file) else read_xml(file).field_data
    for name, values in data.items():
        if name.lower() in _TIMES and values.size == 1:
            return float(values.reshape(-1)[0])
    raise ReadError(f"{file}: has no time in its field data (TimeValue or TIME); list the states in a .pvd file")


def _solver(source: FileSeries) -> str:
    names = {n.upper() for n in source.first().cell_data}
    return "OpenRadioss" if {"EROSION_STATUS", "ELEMENT_ID", "PART_ID"} <= names else "unknown"


class FileSeries(WholeStates):
    """States in files of their own, or in several files that are pieces of one mesh."""

    def __init__(self, states: Sequence[tuple[float, tuple[Path, ...]]], index: Path | None = None) -> None:
        self.time = np.array([time for time, _ in states], np.float64)
        self._states = [files for _, files in states]
        self.files = (*(() if index is None else (index,)), *(f for files in self._states for f in files))

    def place(self, state: int) -> str:
        return f"{self._states[state][0]}, state {state}"

    def read(self, state: int) -> Grid:
        pieces = [read_legacy(f) if is_legacy(f) else read_xml(f) for f in self._states[state]]
        for file, grid in zip(self._states[state], pieces, strict=True):
            grid.check(file)
        return pieces[0] if len(pieces) == 1 else _joined(pieces)


def _joined(pieces: Sequence[Grid]) -> Grid:
    """Pieces of one state as one mesh; arrays that not all pieces have are left out."""
    points = np.cumsum([0, *(len(g.points) for g in pieces)])
    corners = np.cumsum([0, *(len(g.connectivity) for g in pieces)])

    def common(arrays: Sequence[Any]) -> dict[str, NDArray[Any]]:
        names = [n for n, v in arrays[0].items() if all(n in a and a[n].shape[1:] == v.shape[1:] for a in arrays)]
        return {n: np.concatenate([a[n] for a in arrays]) for n in names}

    cell_data = common([g.cell_data for g in pieces])
    cell_data.setdefault("part_id", np.repeat(np.arange(1, len(pieces) + 1), [len(g.types) for g in pieces]))
    return Grid(
        np.concatenate([g.points for g in pieces]),
        np.concatenate([g.connectivity + start for g, start in zip(pieces, points)]),
        np.concatenate([[0], *(g.offsets[1:] + start for g, start in zip(pieces, corners))]),
        np.concatenate([g.types for g in pieces]),
        common([g.point_data for g in pieces]),
        cell_data,
        pieces[0].field_data,
        units=pieces[0].units,
    )


register(VtkSeries())
