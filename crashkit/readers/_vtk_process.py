"""VTU and VTP files read by VTK, in a process of its own.

VTK believes the sizes in these files: one wrong bit in the size of a compressed block ends the whole interpreter
(std::bad_alloc, division by zero; 154 of 400 single bits flipped in block headers, VTK 9.7). So VTK reads in a child
process that may die. Arrays come back over a pipe as raw bytes behind one line of JSON.
"""

from __future__ import annotations

import atexit
import json
import os
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from crashkit import siblings
from crashkit.errors import ReadError
from crashkit.readers._grid import Grid

# A file that takes longer than this, and its size at a slow disk's speed, hangs.
_PATIENCE = 60.0
_SLOW_DISK = 2e6
_POLYHEDRON = 42


def read_xml(file: Path, point_arrays: Sequence[str] | None = None) -> Grid:
    """The mesh and arrays of one VTU or VTP file; of the point arrays only `point_arrays` where they are given.

    Raises
    ------
    ReadError
        Where VTK reports an error, dies or hangs.
    """
    answer, arrays = _ask(file, {"file": os.fspath(file), "point_arrays": point_arrays})
    named: dict[str, dict[str, NDArray[Any]]] = {"mesh": {}, "point": {}, "cell": {}, "field": {}}
    for (kind, name), values in arrays.items():
        named[kind][name] = values
    mesh = named["mesh"]
    return Grid(
        mesh["points"],
        mesh["connectivity"].astype(np.int64),
        mesh["offsets"].astype(np.int64),
        mesh["types"],
        named["point"],
        named["cell"],
        named["field"],
        units=answer["units"],
    )


def point_array_names(file: Path) -> list[str]:
    """The names of the point arrays of a VTU or VTP file, without reading them."""
    answer, _ = _ask(file, {"file": os.fspath(file), "names": True})
    return [str(name) for name in answer["names"]]


def _ask(file: Path, question: Mapping[str, object]) -> tuple[Any, dict[tuple[str, str], NDArray[Any]]]:
    try:
        size = file.stat().st_size
    except OSError as error:
        raise ReadError(f"{file}: not readable ({error.strerror})") from error
    answer, arrays = _child().ask(question, _PATIENCE + size / _SLOW_DISK)
    if answer is None:
        raise ReadError(f"{file}: VTK died or hung on it; the file is damaged, copy it again")
    if "error" in answer:
        raise ReadError(
            f"{file}: not readable with VTK ({answer['error']}); it is cut short, damaged or of another kind"
        )
    return answer, arrays


class _Child:
    """The child process; started when first asked, and again after it died."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None

    def ask(self, question: Mapping[str, object], patience: float) -> tuple[Any, dict[tuple[str, str], NDArray[Any]]]:
        """The answer and its arrays, or None where there was no answer in time."""
        with self._lock:
            process = self._started()
            if process.stdin is None or process.stdout is None:
                return None, {}
            watchdog = threading.Timer(patience, process.kill)
            watchdog.start()
            try:
                process.stdin.write(json.dumps(question).encode() + b"\n")
                process.stdin.flush()
                answer = json.loads(process.stdout.readline())
                return answer, {
                    (kind, name): _take(process.stdout, dtype, shape)
                    for kind, name, dtype, shape in answer.get("arrays", ())
                }
            except (OSError, EOFError, ValueError):
                self.stop()
                return None, {}
            finally:
                watchdog.cancel()

    def _started(self) -> subprocess.Popen[bytes]:
        if self._process is None or self._process.poll() is not None:
            self._process = subprocess.Popen(
                siblings.command(__name__),
                env=siblings.environment(),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
            )
        return self._process

    def stop(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()


def _take(stream: Any, dtype: str, shape: list[int]) -> NDArray[Any]:
    values = np.empty(shape, dtype)
    view = values.reshape(-1).view(np.uint8).data
    done = 0
    while done < len(view):
        count = stream.readinto(view[done:])
        if not count:
            raise EOFError
        done += count
    return values


_children: dict[int, _Child] = {}


def _child() -> _Child:
    """One child for each process: a forked one must not share its parent's pipes."""
    own = os.getpid()
    if own not in _children:
        _children.clear()
        child = _children[own] = _Child()
        atexit.register(child.stop)
    return _children[own]


# In the child


def _serve(questions: BinaryIO, answers: BinaryIO) -> None:
    for line in questions:
        question = json.loads(line)
        try:
            if question.get("names"):
                answers.write(json.dumps({"names": _names(_reader(question["file"])[0])}).encode() + b"\n")
                answers.flush()
                continue
            arrays, units = _read(question["file"], question["point_arrays"])
        except Exception as error:  # whatever VTK's wrapping raises is the file's fault here
            answers.write(json.dumps({"error": str(error)}).encode() + b"\n")
        else:
            header = [[kind, name, v.dtype.str, v.shape] for (kind, name), v in arrays.items()]
            answers.write(json.dumps({"arrays": header, "units": units}).encode() + b"\n")
            for values in arrays.values():
                answers.write(np.ascontiguousarray(values).reshape(-1).view(np.uint8).data)
        answers.flush()


def _reader(file: str) -> tuple[Any, list[str]]:
    """VTK's reader with the file's headings read, and the list that its errors go to."""
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLUnstructuredGridReader

    with Path(file).open("rb") as stream:
        head = stream.read(4096)
    polydata = b'type="PolyData"' in head
    if not polydata and b'type="UnstructuredGrid"' not in head:
        raise ValueError("neither an UnstructuredGrid nor a PolyData file")
    reader: Any = (vtkXMLPolyDataReader if polydata else vtkXMLUnstructuredGridReader)()
    errors: list[str] = []
    reader.AddObserver("ErrorEvent", lambda *_: errors.append("error"))
    reader.SetFileName(file)
    reader.UpdateInformation()
    if errors or reader.GetErrorCode():
        raise ValueError("its headings make no sense")
    return reader, errors


def _names(reader: Any) -> list[str]:
    return [reader.GetPointArrayName(k) for k in range(reader.GetNumberOfPointArrays())]


def _read(file: str, point_arrays: list[str] | None) -> tuple[dict[tuple[str, str], NDArray[Any]], dict[str, str]]:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkDataArray

    reader, errors = _reader(file)
    for name in _names(reader) if point_arrays is not None else ():
        reader.SetPointArrayStatus(name, int(name in (point_arrays or ())))
    reader.Update()
    data = reader.GetOutput()
    if errors or reader.GetErrorCode() or data is None or not data.GetNumberOfPoints():
        raise ValueError("no whole mesh in it")
    mesh = {"points": vtk_to_numpy(data.GetPoints().GetData())}
    if data.IsA("vtkPolyData"):
        if data.GetNumberOfStrips():
            raise ValueError("triangle strips, expected polygons")
        parts = [
            (vtk_to_numpy(cells.GetOffsetsArray()), vtk_to_numpy(cells.GetConnectivityArray()), kind)
            for cells, kind in ((data.GetVerts(), 2), (data.GetLines(), 4), (data.GetPolys(), 7))
        ]
        starts = np.cumsum([0, *(len(joined) for _, joined, _ in parts)])
        mesh["connectivity"] = np.concatenate([joined for _, joined, _ in parts])
        mesh["offsets"] = np.concatenate([[0], *(o[1:] + s for (o, _, _), s in zip(parts, starts))])
        mesh["types"] = np.concatenate([np.full(max(0, len(o) - 1), kind, np.uint8) for o, _, kind in parts])
    else:
        cells = data.GetCells()
        mesh["connectivity"] = vtk_to_numpy(cells.GetConnectivityArray())
        mesh["offsets"] = vtk_to_numpy(cells.GetOffsetsArray())
        mesh["types"] = vtk_to_numpy(data.GetCellTypesArray()) if data.GetNumberOfCells() else np.empty(0, np.uint8)
        if (mesh["types"] == _POLYHEDRON).any():
            raise ValueError("polyhedra, expected common cells")
    arrays = {("mesh", name): values for name, values in mesh.items()}
    units = {}
    for kind, found in (("point", data.GetPointData()), ("cell", data.GetCellData()), ("field", data.GetFieldData())):
        for k in range(found.GetNumberOfArrays()):
            array = found.GetArray(k)  # None for texts
            if array is not None and array.GetName():
                arrays[kind, array.GetName()] = vtk_to_numpy(array)
                if array.GetInformation().Has(vtkDataArray.UNITS_LABEL()):
                    units[array.GetName()] = array.GetInformation().Get(vtkDataArray.UNITS_LABEL())
    return arrays, units


if __name__ == "__main__":
    _serve(sys.stdin.buffer, sys.stdout.buffer)
