"""XDMF time series, and numbered files of every format that meshio reads.

XDMF is recognised by its content. Other formats are read when this reader is asked for by name: files that differ by a
number in their name are the states of a run, and the option `time_step` gives the time between two of them, since
they hold none.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import CrashkitError, ReadError
from crashkit.extras import need
from crashkit.readers import register
from crashkit.readers._folders import Collected, files_in, named, one_file_each, recognises
from crashkit.readers._grid import Grid, WholeStates
from crashkit.readers._grid_run import GridRun
from crashkit.readers._hdf5_data import files_behind
from crashkit.readers.base import Run, Runs
from crashkit.readers.checks import reading, require_options, time_step_option

_XDMF = re.compile(rb"<Xdmf[\s>]")
_NUMBERED = re.compile(r"(?P<stem>.*?)[_.-]?(?P<number>\d+)")
# meshio's names of cells -> VTK type, corners.
_SHAPES = {
    "vertex": (1, 1), "line": (3, 2), "triangle": (5, 3), "quad": (9, 4), "tetra": (10, 4), "hexahedron": (12, 8),
    "wedge": (13, 6), "pyramid": (14, 5), "line3": (3, 2), "triangle6": (5, 3), "quad8": (9, 4), "quad9": (9, 4),
    "tetra10": (10, 4), "hexahedron20": (12, 8), "hexahedron27": (12, 8), "wedge15": (13, 6), "pyramid13": (14, 5),
}  # fmt: skip


class MeshioSeries:
    """Reader of an XDMF file or a folder of them; by name also of numbered files (option `time_step`)."""

    name = "meshio"
    description = "XDMF time series, and (asked for by name) numbered files of any format meshio reads"

    def sniff(self, path: Path) -> bool:
        return recognises(_xdmf_files, path)

    def runs(self, path: Path, **options: object) -> Runs:
        require_options(self.name, options, ("time_step",))
        step = time_step_option(options)
        found = _xdmf_files(path)
        if found:
            return Runs({name: partial(_open_xdmf, name, file, step) for name, file in found.runs.items()}, found.aside)
        families = _numbered(path)
        if not families:
            raise ReadError(f"{path}: no XDMF file, and no files that differ by a number in their name")
        if step is None:
            raise CrashkitError(f"{path}: its files hold no times; give the time between two of them (--time-step)")
        return Runs({name: partial(_open_files, name, files, step) for name, files in families.items()})


def _xdmf_files(path: Path) -> Collected[Path]:
    return one_file_each(path, _is_xdmf)


def _is_xdmf(file: Path) -> bool:
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        return _XDMF.search(stream.read(4096)) is not None


def _numbered(path: Path) -> dict[str, list[Path]]:
    """Families of at least two files that differ by a number, in the order of their numbers."""
    folder = path if path.is_dir() else path.parent
    families: dict[tuple[str, str], dict[int, Path]] = {}
    for file in files_in(folder):
        match = _NUMBERED.fullmatch(file.stem)
        if match and (path.is_dir() or file.suffix == path.suffix):
            states = families.setdefault((match["stem"] or folder.resolve().name, file.suffix), {})
            other = states.setdefault(int(match["number"]), file)
            if other != file:
                raise ReadError(
                    f"{folder}: {other.name} and {file.name} have the same number; expected one file a state, so rename "
                    "or remove one of them"
                )
    listed = [(*key, [files[n] for n in sorted(files)]) for key, files in families.items() if len(files) > 1]
    found = named((stem, stem + suffix, files) for stem, suffix, files in listed)
    return {name: files for name, files in found.items() if path.is_dir() or path in files}


def _open_xdmf(name: str, file: Path, step: float | None) -> Run:
    with reading(file):
        source = _Xdmf(file, step)
        run = GridRun(name, source)
        run.notes = (*source.notes, *run.notes)
        return run


def _open_files(name: str, files: list[Path], step: float) -> Run:
    with reading(files[0]):
        return GridRun(name, _Files(files, step))


def _grid(
    place: object,
    points: NDArray[Any],
    blocks: list[Any],
    point_data: Mapping[str, Any],
    cell_data: Mapping[str, list[Any]],
) -> Grid:
    """meshio's mesh as a Grid."""
    xyz = np.zeros((len(points), 3))
    xyz[:, : points.shape[1]] = points
    joined, sizes, types = [], [np.zeros(0, np.int64)], []
    for block in blocks:
        shape = _SHAPES.get(block.type)
        if shape is None:
            raise ReadError(f"{place}: holds cells {block.type!r}, which are not read")
        joined.append(np.asarray(block.data, np.int64)[:, : shape[1]].reshape(-1))
        sizes.append(np.full(len(block.data), shape[1], np.int64))
        types.append(np.full(len(block.data), shape[0], np.uint8))
    return Grid(
        xyz,
        np.concatenate(joined) if joined else np.zeros(0, np.int64),
        np.concatenate([[0], np.cumsum(np.concatenate(sizes))]),
        np.concatenate(types) if types else np.zeros(0, np.uint8),
        {name: np.asarray(values) for name, values in point_data.items()},
        {name: np.concatenate([np.asarray(v) for v in values]) for name, values in cell_data.items() if values},
    )


class _Xdmf(WholeStates):
    """The states of an XDMF file, through meshio."""

    def __init__(self, file: Path, step: float | None) -> None:
        need(f"reading {file}", "formats")
        from meshio.xdmf import TimeSeriesReader

        self.file = file
        self.notes: tuple[str, ...] = ()
        try:
            self._reader = TimeSeriesReader(file)
            times = [grid.find("Time") for grid in self._reader.collection]
            own = [float(t.attrib["Value"]) for t in times if t is not None]
        except Exception as error:  # meshio raises whatever its parsing meets, often without a text
            raise ReadError(
                f"{file}: not readable as an XDMF time series ({_text(error)}); it is damaged, holds one state only, or "
                "is no XDMF of version 3"
            ) from error
        _refuse_checkpoint(file, self._reader.domain)
        count = len(times)
        if own and len(own) < count:
            raise ReadError(f"{file}: {count - len(own)} of its states have no time; expected all or none")
        if not own and step is None:
            raise ReadError(f"{file}: its {count} states have no time; give the time between two (--time-step)")
        if own and step is not None:
            self.notes = (f"{file}: holds times of its own, so --time-step is not used",)
        self.time = np.array(own or [k * (step or 0.0) for k in range(count)], np.float64)
        for grid, time in zip(self._reader.collection, self.time, strict=True) if not own else ():
            ElementTree.SubElement(grid, "Time", Value=str(time))  # meshio reads no state without one
        self._take_in_others()
        self._mesh = self._reader.mesh_grid
        self.files = (file, *sorted(self._data_files()))

    def _take_in_others(self) -> None:
        """Arrays of the other time series of the file: some programs write one for every function."""
        mine = self._reader.collection
        for series in self._reader.domain:
            if series.get("CollectionType") != "Temporal" or len(series) != len(mine) or list(series) == list(mine):
                continue
            times = [t.attrib.get("Value") for grid in series if (t := grid.find("Time")) is not None]
            if [float(t or "nan") for t in times] != self.time.tolist():
                continue
            for grid, other in zip(mine, series, strict=True):
                known = {a.get("Name") for a in grid.findall("Attribute")}
                grid.extend(a for a in other.findall("Attribute") if a.get("Name") not in known)

    def _data_files(self) -> set[Path]:
        """The HDF5 files with the values, which have to be there whole."""
        import h5py

        out: set[Path] = set()
        items = self._reader.domain.iter("DataItem")
        named = {i.text.strip() for i in items if i.get("Format") == "HDF" and i.text}
        for name in sorted({text.split(":")[0].strip() for text in named}):
            path = self.file.parent / name
            if not path.is_file():
                raise ReadError(f"{self.file}: its values are in {name}, which is not there; copy it beside")
            out.add(path)
            with reading(path), h5py.File(path, "r") as opened:
                for inside in (text.split(":", 1)[1] for text in named if text.split(":")[0].strip() == name):
                    found = opened.get(inside)
                    if isinstance(found, h5py.Dataset):
                        out |= files_behind(found, path)
        return out

    def place(self, state: int) -> str:
        return f"{self.file}, state {state}"

    def read(self, state: int) -> Grid:
        reader = self._reader
        try:
            # A state with a mesh of its own is read as the mesh; meshio by itself would take the first for all.
            own = reader.collection[state].find("Geometry") is not None
            reader.mesh_grid = reader.collection[state] if own else self._mesh
            points, blocks = reader.read_points_cells()
            _, point_data, cell_data = reader.read_data(state)
        except Exception as error:
            raise ReadError(
                f"{self.place(state)}: not readable ({_text(error)}); it is cut short or damaged"
            ) from error
        return _grid(self.place(state), points, blocks, point_data, cell_data)

    def close(self) -> None:
        super().close()
        for opened in self._reader.hdf5_files.values():
            opened.close()
        self._reader.hdf5_files.clear()


class _Files(WholeStates):
    """States in files of their own, read by meshio."""

    def __init__(self, files: list[Path], step: float) -> None:
        self.files = tuple(files)
        self.time = np.arange(len(files), dtype=np.float64) * step

    def place(self, state: int) -> str:
        return f"{self.files[state]}, state {state}"

    def file_of(self, state: int) -> Path:
        return self.files[state]

    def read(self, state: int) -> Grid:
        file = self.files[state]
        need(f"reading {file}", "formats")
        import meshio

        try:
            mesh = meshio.read(file)
        except (Exception, SystemExit) as error:  # meshio leaves the program over a format it does not know
            raise ReadError(f"{file}: not readable with meshio ({_text(error)})") from error
        return _grid(file, mesh.points, mesh.cells, mesh.point_data, mesh.cell_data)


def _refuse_checkpoint(file: Path, domain: Any) -> None:
    """Checkpoints of FEniCS keep a function by its degrees of freedom, not by nodes."""
    if any(a.get("ItemType") == "FiniteElementFunction" for a in domain.iter("Attribute")):
        raise ReadError(
            f"{file}: is a checkpoint of FEniCS (FiniteElementFunction), which keeps no values at nodes; write the "
            "displacement, interpolated to degree 1, with XDMFFile.write or write_function"
        )


def _text(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


register(MeshioSeries())
