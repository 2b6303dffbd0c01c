"""XDMF time series, and numbered files of every format that meshio reads.

XDMF is told by its content. Other formats are read when this reader is asked for by name: files that differ by a
number in their name are the states of a run, and the option `time_step` gives the time between two of them, since
they hold none.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import CrashkitError, ReadError
from crashkit.extras import need
from crashkit.readers import register
from crashkit.readers._checks import reading, require_options
from crashkit.readers._folders import runs_in
from crashkit.readers._grid import Grid, WholeStates
from crashkit.readers._grid_run import GridRun
from crashkit.readers.base import Run, Runs

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
        try:
            return bool(_xdmf_files(path))
        except OSError:
            return False

    def runs(self, path: Path, **options: object) -> Runs:
        require_options(self.name, options, ("time_step",))
        found = _xdmf_files(path)
        if found:
            return Runs({name: partial(_open_xdmf, name, file) for name, file in found.items()})
        step = options.get("time_step")
        families = _numbered(path)
        if not families:
            raise ReadError(f"{path}: no XDMF file, and no files that differ by a number in their name")
        try:
            time_step = float(str(step))
        except ValueError:
            raise CrashkitError(
                f"{path}: its files hold no times; give the time between two of them (--time-step), found {step!r}"
            ) from None
        return Runs({name: partial(_open_files, name, files, time_step) for name, files in families.items()})


def _xdmf_files(path: Path) -> dict[str, Path]:
    if path.is_file():
        return {path.stem: path} if _is_xdmf(path) else {}
    if not path.is_dir():
        return {}
    return _xdmf_in(path) or runs_in(path, _xdmf_in)


def _xdmf_in(folder: Path) -> dict[str, Path]:
    return {p.stem: p for p in sorted(folder.iterdir()) if p.is_file() and _is_xdmf(p)}


def _is_xdmf(file: Path) -> bool:
    with file.open("rb") as stream:
        return _XDMF.search(stream.read(4096)) is not None


def _numbered(path: Path) -> dict[str, list[Path]]:
    folder = path if path.is_dir() else path.parent
    families: dict[str, dict[int, Path]] = {}
    for file in sorted(folder.iterdir()):
        match = _NUMBERED.fullmatch(file.stem)
        if match and file.is_file() and (path.is_dir() or file.suffix == path.suffix):
            name = match["stem"] or folder.resolve().name
            families.setdefault(f"{name}{file.suffix}", {})[int(match["number"])] = file
    listed = {name: [files[n] for n in sorted(files)] for name, files in families.items() if len(files) > 1}
    return {Path(name).stem: files for name, files in listed.items() if path.is_dir() or path in files}


def _open_xdmf(name: str, file: Path) -> Run:
    with reading(file):
        return GridRun(name, _Xdmf(file))


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

    def __init__(self, file: Path) -> None:
        need(f"reading {file}", "formats")
        from meshio.xdmf import TimeSeriesReader

        self.file = file
        try:
            self._reader = TimeSeriesReader(file)
            times = [step.find("Time") for step in self._reader.collection]
            self.time = np.array([float(t.attrib["Value"]) for t in times if t is not None], np.float64)
        except Exception as error:  # meshio raises whatever its parsing meets, often without a text
            raise ReadError(
                f"{file}: not readable as an XDMF time series ({_text(error)}); it is damaged or has no time"
            ) from error
        if len(self.time) != len(self._reader.collection):
            raise ReadError(f"{file}: {len(self._reader.collection) - len(self.time)} of its states have no time")
        self._mesh = self._reader.mesh_grid
        items = self._reader.domain.iter("DataItem")
        named = {i.text.split(":")[0].strip() for i in items if i.get("Format") == "HDF" and i.text}
        self.files = (file, *sorted(file.parent / name for name in named if (file.parent / name).is_file()))

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

    def read(self, state: int) -> Grid:
        file = self.files[state]
        need(f"reading {file}", "formats")
        import meshio

        try:
            mesh = meshio.read(file)
        except (Exception, SystemExit) as error:  # meshio leaves the program over a format it does not know
            raise ReadError(f"{file}: not readable with meshio ({_text(error)})") from error
        return _grid(file, mesh.points, mesh.cells, mesh.point_data, mesh.cell_data)


def _text(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


register(MeshioSeries())
