"""Runs as files for ParaView: PVD with one VTU a state, VTKHDF with the mesh once, or one state as VTU or VTP.

The points of a file are the reference position and the movement is the point array `displacement`, so that the
mesh stands once in a VTKHDF file and several fields (true, predicted) can warp the same mesh: ParaView's *Warp By
Vector* shows the crash. `deform=True` moves the points themselves instead.

VTU and VTP go through VTK's own writers. VTKHDF is written with h5py after its specification
(https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format/index.html, version 2.0, the first with time):
vtkHDFWriter of VTK 9.7 keeps times in single precision, repeats arrays that never change in every state and is
several times slower (benchmarks/paraview.py).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crashkit.errors import DataError, OutputError, ReadError
from crashkit.writers.paraview_view import ValueRanges, view_script
from data_schema.replace import put_in_place, room_beside

if TYPE_CHECKING:
    import h5py

SUFFIXES = (".pvd", ".vtkhdf", ".vtu", ".vtp")

Arrays = Mapping[str, NDArray[Any]]
_Steps = Iterator[tuple["State", NDArray[Any]]]

# zlib level 1: levels above cost time and win next to nothing on floating point numbers.
_COMPRESSION = 1
# The same in HDF5, with bytes of one significance side by side: two thirds of the time, four fifths of the size.
_PACKED: dict[str, Any] = {"compression": "gzip", "compression_opts": _COMPRESSION, "shuffle": True}
_VTK_LINE, _VTK_TRIANGLE, _VTK_QUAD = 3, 5, 9
_COMPONENTS = 9  # of a full tensor, the widest array there is
_HIDDEN_CELL = 32  # vtkDataSetAttributes::HIDDENCELL
# Sizes of the mesh from the origin up to which single precision keeps points to a millionth of the mesh.
_FAR = 10


@dataclass(frozen=True)
class State:
    """The arrays of one state.

    Attributes
    ----------
    point_data
        Name -> (n,) or (n, components).
    cell_data
        Name -> (c,) or (c, components), faces first, then lines.
    """

    point_data: Arrays
    cell_data: Arrays = field(default_factory=dict)


def write_paraview(
    path: str | os.PathLike[str],
    points: ArrayLike,
    faces: ArrayLike,
    time: ArrayLike,
    point_data: Mapping[str, Any] | None = None,
    cell_data: Mapping[str, Any] | None = None,
    lines: ArrayLike | None = None,
    units: Mapping[str, str] | None = None,
    alive: Any | None = None,
    deform: bool = False,
    field_data: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Write the states of one run to `path`, for ParaView, PyVista and everything else that reads VTK files.

    Beside a `.pvd` or `.vtkhdf` file stands `NAME_view.py`, which ParaView loads as a state (File > Load State): the
    warped mesh, coloured over one range for all states.

    Returns the files written, the one to open first.

    Parameters
    ----------
    path
        The suffix says what is written: `.pvd` a list of states beside a folder `NAME_states` with one compressed
        binary VTU each; `.vtkhdf` one file with all states; `.vtu` or `.vtp` a single state. Missing folders are
        made. What was there is replaced once everything new is written.
    points
        (n, 3) reference position, m.
    faces
        (m, 3 or 4) 0-based nodes, -1 in the last corner of a triangle.
    time
        (t,) s.
    point_data
        Name -> (t, n) or (t, n, components), or without t where an array is the same in all states. Anything that
        can be indexed by state will do (numpy, HDF5, Zarr): one state is read at a time.
    cell_data
        The same with c = m + number of lines values, faces first.
    lines
        (e, 2) edges without a face, written behind the faces.
    units
        Name of an array -> its unit, kept in the file (VTU: UNITS_LABEL, VTKHDF: attribute `units`).
    alive
        (t, m) bool, False once an element has eroded: becomes the cell array `alive`, and VTK's ghost array, so
        that eroded elements are not drawn.
    deform
        Move the points by the array `displacement`. Nodes where it is NaN stay where they were last.
    field_data
        What belongs to the file as a whole: name -> number, text, or a row of either.

    Raises
    ------
    DataError
        Where arrays and mesh do not belong together.
    OutputError
        Where `path` cannot be written.
    """
    times = _times(time)
    mesh = _mesh(points, faces, lines)
    faces_shape = (times.size, mesh.n_cells - mesh.n_lines)
    if alive is not None and np.shape(alive) != faces_shape:
        raise DataError(
            f"alive has shape {np.shape(alive)}: expected {faces_shape[0]} states and {faces_shape[1]} faces"
        )
    fixed_points, moving_points = _sort(point_data or {}, times.size, mesh.n_points, "points")
    fixed_cells, moving_cells = _sort(cell_data or {}, times.size, mesh.n_cells, "cells")

    def states() -> Iterator[State]:
        for k in range(times.size):
            cells = {name: np.asarray(values[k]) for name, values in moving_cells.items()}
            if alive is not None:
                cells |= _life(alive[k], mesh)
            yield State({name: np.asarray(values[k]) for name, values in moving_points.items()}, cells)

    constant = State(fixed_points, fixed_cells)
    return _write(path, mesh, times, states(), constant, _Extras(units or {}, _field_data(field_data or {})), deform)


def write_states(
    path: str | os.PathLike[str],
    points: ArrayLike,
    faces: ArrayLike,
    time: ArrayLike,
    states: Iterable[State],
    constant: State | None = None,
    lines: ArrayLike | None = None,
    units: Mapping[str, str] | None = None,
    deform: bool = False,
    field_data: Mapping[str, Any] | None = None,
) -> list[Path]:
    """The same as `write_paraview` for states that come one after the other: only one is held in memory.

    Parameters
    ----------
    states
        One `State` for each of `time`, all with the same arrays.
    constant
        The arrays that are the same in all states.

    Raises
    ------
    DataError
        Also where `states` are fewer or more than `time`, or change their arrays; nothing is left behind then.
    """
    mesh = _mesh(points, faces, lines)
    extras = _Extras(units or {}, _field_data(field_data or {}))
    return _write(path, mesh, _times(time), states, constant or State({}), extras, deform)


def read_state(path: str | os.PathLike[str], state: int = -1) -> tuple[float, Any]:
    """Time (s) and mesh, a `pyvista.UnstructuredGrid`, of one state of a `.pvd` or `.vtkhdf` file, through VTK.

    `state` counts from 0, or back from -1.

    Raises
    ------
    ReadError
        For files that are neither, and states they lack.
    """
    import pyvista as pv
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline
    from vtkmodules.vtkIOHDF import vtkHDFReader

    source = Path(path)
    hdf = source.suffix.lower() == ".vtkhdf"
    if not source.is_file() or not (hdf or source.suffix.lower() == ".pvd"):
        raise ReadError(f"{source}: expected a .pvd or .vtkhdf file that is there")
    if hdf:
        reader = vtkHDFReader()
        reader.SetFileName(os.fspath(source))
        reader.UpdateInformation()
        times = reader.GetOutputInformation(0).Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS()) or ()
    else:
        listed: Any = pv.PVDReader(os.fspath(source))
        times = tuple(listed.time_values)
    if not -len(times) <= state < len(times):
        raise ReadError(f"{source}: state {state} asked for; it has {len(times)} states")
    time = float(times[state])
    if not hdf:
        listed.set_active_time_value(time)
        return time, listed.read()[0]
    reader.UpdateTimeStep(time)
    return time, pv.wrap(reader.GetOutputDataObject(0))


def rounded(values: NDArray[np.floating], size: float) -> NDArray[np.float32]:
    """`values` to about 1/40000 of `size`, both in m, as single precision numbers that compress to two thirds.

    Predictions carry noise in their last digits, far below their error, which takes most of the space in a file.
    """
    if not size > 0:
        return np.asarray(values, np.float32)
    step = np.float32(2.0 ** np.floor(np.log2(5e-5 * size)))
    return np.round(np.asarray(values, np.float32) / step) * step


# --- what is written -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Extras:
    """What stands beside the arrays: their units, and field data as numbers (k,) or texts."""

    units: Mapping[str, str]
    field_data: Mapping[str, NDArray[Any] | list[str]]


def _field_data(given: Mapping[str, Any]) -> dict[str, NDArray[Any] | list[str]]:
    out: dict[str, NDArray[Any] | list[str]] = {}
    for name, value in given.items():
        if not name or "/" in name or "." in name:
            raise DataError(f"field data {name!r}: expected a name without '/' and '.'")
        array = np.atleast_1d(np.asarray(value))
        if array.dtype.kind in "UO":
            out[name] = [str(text) for text in array]
        elif array.dtype.kind in "iufb" and array.ndim == 1:
            out[name] = array.astype(np.int64 if array.dtype.kind in "iub" else np.float64)
        else:
            raise DataError(
                f"field data {name!r} is {array.dtype} of shape {array.shape}: expected a row of numbers or texts"
            )
    return out


@dataclass(frozen=True)
class _Mesh:
    """Points (n, 3) and cells, faces first, as VTK keeps them: `connectivity`, `offsets` (c + 1), `types` (c)."""

    points: NDArray[np.floating[Any]]
    connectivity: NDArray[np.int64]
    offsets: NDArray[np.int64]
    types: NDArray[np.uint8]
    n_lines: int

    @property
    def n_points(self) -> int:
        return len(self.points)

    @property
    def n_cells(self) -> int:
        return len(self.types)


def _mesh(points: ArrayLike, faces: ArrayLike, lines: ArrayLike | None) -> _Mesh:
    xyz = np.ascontiguousarray(points)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or not np.isrealobj(xyz):
        raise DataError(f"points have shape {xyz.shape}: expected (n, 3) positions in m")
    if not len(xyz):
        raise DataError("no points: expected a mesh")
    xyz = xyz if xyz.dtype in (np.float32, np.float64) else xyz.astype(np.float64)
    if not np.isfinite(xyz).all():
        raise DataError(f"point {int(np.argmin(np.isfinite(xyz).all(axis=1)))} is not finite: expected positions in m")
    if np.abs(xyz).max() <= _FAR * np.ptp(xyz, axis=0).max():
        xyz = xyz.astype(np.float32)  # half the size; in VTU the points stand in every state
    corners, ends = np.asarray(faces), np.asarray(np.empty((0, 2), np.int64) if lines is None else lines)
    if corners.size == 0:
        corners = np.empty((0, 3), np.int64)
    for name, nodes, widths in (("faces", corners, (3, 4)), ("lines", ends, (2,))):
        if nodes.ndim != 2 or nodes.shape[1] not in widths or nodes.dtype.kind not in "iu":
            expected = " or ".join(f"(number, {w})" for w in widths)
            raise DataError(f"{name} have shape {nodes.shape} and type {nodes.dtype}: expected integers {expected}")
        padded = nodes[:, :3] if name == "faces" else nodes
        if nodes.size and (padded.min() < 0 or nodes.max() >= len(xyz) or nodes.min() < -1):
            raise DataError(
                f"{name} name the nodes {nodes.min()} to {nodes.max()}: expected 0 to {len(xyz) - 1}"
                + (", and -1 only in the last of four corners" if name == "faces" else "")
            )
    valid = corners >= 0
    sizes = np.concatenate([valid.sum(axis=1), np.full(len(ends), 2)])
    types = np.array([0, 0, _VTK_LINE, _VTK_TRIANGLE, _VTK_QUAD], np.uint8)[sizes]
    connectivity = np.concatenate([corners[valid], ends.ravel()]).astype(np.int64)
    return _Mesh(xyz, connectivity, np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64), types, len(ends))


def _times(time: ArrayLike) -> NDArray[np.float64]:
    times = np.asarray(time, np.float64)
    if times.ndim != 1 or times.size == 0 or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise DataError(f"time has shape {times.shape}: expected a row of increasing times in s, one for each state")
    return times


def _life(alive: ArrayLike, mesh: _Mesh) -> dict[str, NDArray[np.uint8]]:
    """Cell arrays of one state from `alive` (m,) of its faces; lines always live."""
    life = np.concatenate([np.asarray(alive, bool), np.ones(mesh.n_lines, bool)])
    return {"alive": life.astype(np.uint8), "vtkGhostType": np.where(life, 0, _HIDDEN_CELL).astype(np.uint8)}


def _sort(arrays: Mapping[str, Any], states: int, size: int, what: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arrays that are the same in all states, and arrays over time."""
    fixed, moving = {}, {}
    for name, values in arrays.items():
        values = values if hasattr(values, "shape") else np.asarray(values)
        shape = tuple(values.shape)
        if shape == (states, size) and states == size <= _COMPONENTS:
            raise DataError(
                f"array {name!r} has shape {shape}: {states} states x {size} {what}, or {size} {what} x {size} "
                "components? Give it a third axis to tell: (states, size, components)"
            )
        if shape[:2] == (states, size) and len(shape) in (2, 3):
            moving[name] = values
        elif shape[:1] == (size,) and len(shape) in (1, 2):
            fixed[name] = np.asarray(values)
        else:
            raise DataError(
                f"array {name!r} has shape {shape}: expected {states} states x {size} {what} [x components], "
                f"or {size} {what} [x components] where all states are the same"
            )
    return fixed, moving


def _checked(state: State, mesh: _Mesh, place: str) -> State:
    """`state` with arrays as VTK takes them: contiguous, numbers, of the mesh's sizes."""

    def checked(arrays: Arrays, size: int, what: str) -> dict[str, NDArray[Any]]:
        good = {}
        for name, values in arrays.items():
            array = np.ascontiguousarray(values)
            if not name or "/" in name or "." in name:
                raise DataError(f"array name {name!r} in {place}: expected a name without '/' and '.'")
            if array.ndim not in (1, 2) or len(array) != size:
                raise DataError(f"array {name!r} in {place} has shape {array.shape}: expected ({size} {what}, ...)")
            if array.dtype.kind == "b":
                array = array.astype(np.uint8)
            if array.dtype.kind not in "iuf" or array.dtype.itemsize > 8:
                raise DataError(f"array {name!r} in {place} has type {array.dtype}: expected numbers")
            good[name] = array.astype(np.float32) if array.dtype == np.float16 else array
        return good

    return State(checked(state.point_data, mesh.n_points, "points"), checked(state.cell_data, mesh.n_cells, "cells"))


def _in_step(
    states: Iterable[State], constant: State, mesh: _Mesh, times: NDArray[np.float64], deform: bool
) -> Iterator[tuple[State, NDArray[Any]]]:
    """The checked states, each with its points; refuses where states and times do not match."""
    points, first, count = mesh.points, None, 0
    for k, raw in enumerate(states):
        if k == times.size:
            raise DataError(f"more states than the {times.size} times: expected one state for each time")
        state = _checked(raw, mesh, f"state {k}")
        form = {name: (a.dtype, a.shape) for part in (state.point_data, state.cell_data) for name, a in part.items()}
        first = first or form
        if form != first:
            changed = sorted(n for n in form.keys() | first.keys() if form.get(n) != first.get(n))
            raise DataError(f"state {k} changes the arrays {', '.join(changed)}: expected the same in all states")
        if deform:
            points = _moved(mesh, {**constant.point_data, **state.point_data}, points)
        count = k + 1
        yield state, points
    if count < times.size:
        raise DataError(f"{count} states for {times.size} times: expected one state for each time")


def _moved(mesh: _Mesh, arrays: Arrays, last: NDArray[Any]) -> NDArray[Any]:
    displacement = arrays.get("displacement")
    if displacement is None or displacement.shape != (mesh.n_points, 3):
        raise DataError("deform asked for without a point array 'displacement' (n, 3): give it, or leave deform off")
    moved = (mesh.points + displacement).astype(mesh.points.dtype)
    # A position that is not a number spoils the bounds, and with them the camera, of every program.
    return np.where(np.isfinite(moved), moved, last)


def _write(
    path: str | os.PathLike[str],
    mesh: _Mesh,
    times: NDArray[np.float64],
    states: Iterable[State],
    constant: State,
    extras: _Extras,
    deform: bool,
) -> list[Path]:
    target = Path(path)
    suffix = target.suffix.lower()
    if suffix not in SUFFIXES:
        raise OutputError(f"{target}: suffix {suffix or 'missing'!r}: expected one of {', '.join(SUFFIXES)}")
    if suffix in (".vtu", ".vtp") and times.size != 1:
        raise OutputError(f"{target}: {times.size} states: a {suffix} file holds one; take .pvd or .vtkhdf")
    if target.is_dir():
        raise OutputError(f"{target}: is a folder: expected the name of a file")
    constant = _checked(constant, mesh, "the constant arrays")
    ranges = ValueRanges()
    ranges.note(constant.point_data, constant.cell_data)
    steps = _followed(_in_step(states, constant, mesh, times, deform), ranges)
    with _output(target) as folder:
        if suffix == ".vtkhdf":
            _write_vtkhdf(folder / target.name, mesh, times, steps, constant, extras, deform)
            others: list[Path] = []
        elif suffix == ".pvd":
            others = _write_pvd(folder, target, mesh, times, steps, constant, extras)
        else:
            write = _xml_writer(mesh, constant, extras, polydata=suffix == ".vtp")
            for state, points in steps:
                write(folder / target.name, float(times[0]), state, points)
            put_in_place(folder / target.name, target)
            return [target]
        put_in_place(folder / target.name, target)
        script = target.with_name(f"{target.stem}_view.py")
        (folder / script.name).write_text(view_script(target.name, ranges, extras.units), encoding="utf-8")
        put_in_place(folder / script.name, script)
    return [target, *others, script]


def _followed(steps: _Steps, ranges: ValueRanges) -> _Steps:
    """`steps` as they are, and the ranges of what goes by are noted."""
    for state, points in steps:
        ranges.note(state.point_data, state.cell_data)
        yield state, points


@contextmanager
def _output(target: Path) -> Iterator[Path]:
    """A folder beside `target` to write into, gone afterwards; failures of the file system as OutputError."""
    try:
        with room_beside(target) as folder:
            yield folder
    except OSError as error:
        raise OutputError(f"{target}: cannot be written: {error.strerror or error}; choose another place") from error


# --- PVD, VTU and VTP through VTK ------------------------------------------------------------------------------


def _write_pvd(
    folder: Path,
    target: Path,
    mesh: _Mesh,
    times: NDArray[np.float64],
    steps: Iterator[tuple[State, NDArray[Any]]],
    constant: State,
    extras: _Extras,
) -> list[Path]:
    place = target.with_name(f"{target.stem}_states")
    digits = max(3, len(str(times.size - 1)))
    names = [f"{target.stem}_{k:0{digits}d}.vtu" for k in range(times.size)]
    _refuse_foreign(place, target.stem)
    write = _xml_writer(mesh, constant, extras)
    written = folder / "states"
    written.mkdir()
    root = ElementTree.Element("VTKFile", type="Collection", version="1.0", byte_order="LittleEndian")
    collection = ElementTree.SubElement(root, "Collection")
    for k, (state, points) in enumerate(steps):
        time = float(times[k])
        write(written / names[k], time, state, points)
        entry = {"timestep": repr(time), "group": "", "part": "0", "file": f"{place.name}/{names[k]}"}
        ElementTree.SubElement(collection, "DataSet", entry)
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(folder / target.name, encoding="utf-8", xml_declaration=True)
    put_in_place(written, place)
    return [place / name for name in names]


def _refuse_foreign(place: Path, stem: str) -> None:
    """The folder of states is replaced as a whole, so it may hold nothing but states."""
    if place.is_dir():
        foreign = [p.name for p in place.iterdir() if not (p.name.startswith(f"{stem}_") and p.suffix == ".vtu")]
    else:
        foreign = [place.name] if place.exists() else []
    if foreign:
        raise OutputError(f"{place}: holds {sorted(foreign)[0]}, which is no state of {stem}: choose another name")


_WriteState = Callable[[Path, float, State, NDArray[Any]], None]


def _xml_writer(mesh: _Mesh, constant: State, extras: _Extras, polydata: bool = False) -> _WriteState:
    """A function that writes one state; mesh and constant arrays are handed to VTK once."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkDataArray, vtkPoints, vtkStringArray
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter, vtkXMLUnstructuredGridWriter

    grid, order = _vtk_polydata(mesh) if polydata else _vtk_grid(mesh)

    def add(attributes: Any, name: str, values: NDArray[Any]) -> None:
        array = numpy_to_vtk(values)
        array.SetName(name)
        if name in extras.units:
            array.GetInformation().Set(vtkDataArray.UNITS_LABEL(), extras.units[name])
        attributes.AddArray(array)

    def add_texts(attributes: Any, name: str, texts: list[str]) -> None:
        array = vtkStringArray()
        array.SetName(name)
        for text in texts:
            array.InsertNextValue(text)
        attributes.AddArray(array)

    def write(path: Path, time: float, state: State, points: NDArray[Any]) -> None:
        output = grid.NewInstance()
        output.CopyStructure(grid)
        if points is not mesh.points or not output.GetPoints():
            moved = vtkPoints()
            moved.SetData(numpy_to_vtk(np.ascontiguousarray(points)))
            output.SetPoints(moved)
        for name, values in {**constant.point_data, **state.point_data}.items():
            add(output.GetPointData(), name, values)
        for name, values in {**constant.cell_data, **state.cell_data}.items():
            add(output.GetCellData(), name, values if order is None else np.ascontiguousarray(values[order]))
        if output.GetPointData().HasArray("displacement"):
            output.GetPointData().SetActiveVectors("displacement")
        add(output.GetFieldData(), "TimeValue", np.array([time]))
        for name, about in extras.field_data.items():
            if isinstance(about, list):
                add_texts(output.GetFieldData(), name, about)
            else:
                add(output.GetFieldData(), name, about)
        writer = (vtkXMLPolyDataWriter if polydata else vtkXMLUnstructuredGridWriter)()
        problems: list[str] = []
        speaker: Any
        for speaker in (writer, writer.GetExecutive()):  # else VTK writes its errors to stderr
            speaker.AddObserver("ErrorEvent", lambda *_: problems.append("error"))
        writer.SetFileName(os.fspath(path))
        writer.SetInputData(output)
        writer.SetDataModeToAppended()
        writer.EncodeAppendedDataOff()
        writer.SetCompressorTypeToZLib()
        writer.SetCompressionLevel(_COMPRESSION)
        if max(mesh.n_points, mesh.connectivity.size) < 2**31:
            writer.SetIdTypeToInt32()
        if not writer.Write() or problems or writer.GetErrorCode():
            raise OSError(None, "VTK could not write it (is the disk full?)", os.fspath(path))

    return write


def _vtk_grid(mesh: _Mesh) -> tuple[Any, None]:
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkUnstructuredGrid

    grid = vtkUnstructuredGrid()
    grid.SetPoints(_vtk_points(mesh))
    types = numpy_to_vtk(mesh.types)
    grid.SetCells(types, _vtk_cells(mesh.offsets, mesh.connectivity))
    return grid, None


def _vtk_polydata(mesh: _Mesh) -> tuple[Any, NDArray[np.int64]]:
    """Poly data, and where its cells come from: VTK puts lines before polygons."""
    from vtkmodules.vtkCommonDataModel import vtkPolyData

    faces = mesh.n_cells - mesh.n_lines
    split = mesh.offsets[faces]
    data = vtkPolyData()
    data.SetPoints(_vtk_points(mesh))
    data.SetPolys(_vtk_cells(mesh.offsets[: faces + 1], mesh.connectivity[:split]))
    if mesh.n_lines:
        data.SetLines(_vtk_cells(mesh.offsets[faces:] - split, mesh.connectivity[split:]))
    return data, np.roll(np.arange(mesh.n_cells), mesh.n_lines)


def _vtk_points(mesh: _Mesh) -> Any:
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints

    points = vtkPoints()
    points.SetData(numpy_to_vtk(mesh.points))
    return points


def _vtk_cells(offsets: NDArray[np.int64], connectivity: NDArray[np.int64]) -> Any:
    from vtkmodules.util.numpy_support import numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonDataModel import vtkCellArray

    cells = vtkCellArray()
    cells.SetData(numpy_to_vtkIdTypeArray(offsets, deep=1), numpy_to_vtkIdTypeArray(connectivity, deep=1))
    return cells


# --- VTKHDF ----------------------------------------------------------------------------------------------------


def _write_vtkhdf(
    path: Path,
    mesh: _Mesh,
    times: NDArray[np.float64],
    steps: Iterator[tuple[State, NDArray[Any]]],
    constant: State,
    extras: _Extras,
    deform: bool,
) -> None:
    """One transient UnstructuredGrid: everything lies one behind the other, and `Steps` says where each state starts.

    A mesh or array that never changes is stored once and every state's offset is 0.
    """
    import h5py

    n, c, t = mesh.n_points, mesh.n_cells, times.size
    with _Disk(path, "w+") as disk, h5py.File(disk, "w") as file:
        root = file.create_group("VTKHDF", track_order=True)
        root.attrs["Version"] = np.array([2, 0], np.int64)
        root.attrs.create("Type", "UnstructuredGrid", dtype=h5py.string_dtype("ascii", len("UnstructuredGrid")))
        _dataset(root, "NumberOfPoints", np.array([n]))
        _dataset(root, "NumberOfCells", np.array([c]))
        _dataset(root, "NumberOfConnectivityIds", np.array([mesh.connectivity.size]))
        small = np.int32 if mesh.connectivity.size < 2**31 else np.int64
        _dataset(root, "Connectivity", mesh.connectivity.astype(small))
        _dataset(root, "Offsets", mesh.offsets.astype(small))
        _dataset(root, "Types", mesh.types)
        where = root.create_group("Steps", track_order=True)
        where.attrs["NSteps"] = t
        _dataset(where, "Values", times)
        still = np.zeros(t, np.int64)
        _dataset(where, "PartOffsets", still)
        _dataset(where, "NumberOfParts", np.ones(t, np.int64))
        _dataset(where, "PointOffsets", np.arange(t, dtype=np.int64) * n if deform else still)
        _dataset(where, "CellOffsets", still[:, None])
        _dataset(where, "ConnectivityIdOffsets", still[:, None])

        if extras.field_data:
            _write_field_data(root, where, extras, t)
        groups = []
        for kind, arrays in (("PointData", constant.point_data), ("CellData", constant.cell_data)):
            group = root.create_group(kind, track_order=True)
            offsets = where.create_group(f"{kind}Offsets", track_order=True)
            for name, values in arrays.items():
                _dataset(group, name, values, extras.units.get(name))
                _dataset(offsets, name, still)
            groups.append((group, offsets))

        for k, (state, points) in enumerate(steps):
            if k == 0:
                moving = _grown(root, "Points", points, t) if deform else _dataset(root, "Points", points)
                for (group, offsets), arrays in zip(groups, (state.point_data, state.cell_data), strict=True):
                    for name, values in arrays.items():
                        _grown(group, name, values, t, extras.units.get(name))
                        _dataset(offsets, name, np.arange(t, dtype=np.int64) * len(values))
            if deform:
                moving[k * n : (k + 1) * n] = points
            for (group, _), arrays in zip(groups, (state.point_data, state.cell_data), strict=True):
                for name, values in arrays.items():
                    group[name][k * len(values) : (k + 1) * len(values)] = values
            disk.check()
    disk.check()


def _write_field_data(root: h5py.Group, where: h5py.Group, extras: _Extras, states: int) -> None:
    """Field data that is the same in all states: every state starts at 0 and takes everything."""
    import h5py

    group = root.create_group("FieldData", track_order=True)
    offsets, sizes = (where.create_group(f"FieldData{what}", track_order=True) for what in ("Offsets", "Sizes"))
    for name, values in extras.field_data.items():
        if isinstance(values, list):  # VTK reads texts of type ASCII alone, and takes their bytes for UTF-8
            texts = np.array([text.encode() for text in values], object)
            group.create_dataset(name, data=texts, dtype=h5py.string_dtype("ascii"))
        else:
            _dataset(group, name, values, extras.units.get(name))
        _dataset(offsets, name, np.zeros(states, np.int64))
        _dataset(sizes, name, np.tile(np.array([1, len(values)], np.int64), (states, 1)))


class _Disk(FileIO):
    """A file for HDF5 that remembers what went wrong instead of saying so.

    When writing fails, on a full disk, HDF5 cannot close its file any more and takes the interpreter with it. So
    it is made to believe that all went well until it has closed the file; `check` then raises what really happened.
    """

    error: OSError | None = None

    def check(self) -> None:
        if self.error is not None:
            raise self.error

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        done = 0
        while done < len(view) and self.error is None:
            try:
                done += super().write(view[done:])
            except OSError as error:
                self.error = error
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.error = self.error or error
            return size or 0


def _dataset(group: h5py.Group, name: str, values: NDArray[Any], unit: str | None = None) -> h5py.Dataset:
    """`values`, compressed where that pays."""
    options = _PACKED if values.nbytes > 4096 else {}
    dataset = group.create_dataset(name, data=values, **options)
    if unit is not None:
        dataset.attrs["units"] = unit
    return dataset


def _grown(group: h5py.Group, name: str, like: NDArray[Any], states: int, unit: str | None = None) -> h5py.Dataset:
    """Room for an array in all states, one state a chunk: that is how ParaView asks for it."""
    shape = (states * len(like), *like.shape[1:])
    options: dict[str, Any] = {}
    if like.size:
        # HDF5 refuses chunks of 4 GiB and above; a large state is cut into pieces.
        rows = max(1, min(len(like), (1 << 26) // max(1, like[:1].nbytes)))
        options = {"chunks": (rows, *like.shape[1:]), **_PACKED}
    dataset = group.create_dataset(name, shape, like.dtype, **options)
    if unit is not None:
        dataset.attrs["units"] = unit
    return dataset
