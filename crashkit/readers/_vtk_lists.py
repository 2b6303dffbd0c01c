"""VTK files that name other files: PVD collections and file series over time, PVTU and VTM within one state."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from crashkit.errors import ReadError
from crashkit.readers._vtk_legacy import is_legacy

_VTK_TYPE = re.compile(rb"<VTKFile\b[^>]*\btype\s*=\s*[\"'](\w+)[\"']")
_KINDS = {
    "UnstructuredGrid": "grid", "PolyData": "grid", "PUnstructuredGrid": "pieces", "PPolyData": "pieces",
    "vtkMultiBlockDataSet": "blocks", "vtkPartitionedDataSetCollection": "blocks", "vtkPartitionedDataSet": "blocks",
    "Collection": "pvd",
}  # fmt: skip
# Of files with all states in arrays of one mesh, which another reader knows.
_STATES_IN_ARRAYS = b'Name="displacement_t'
_HEAD = 1 << 14
# Lists name lists at most this deep.
_DEPTH = 4


@dataclass(frozen=True)
class ListedState:
    """One state of a list: its time, None where the list has none, and its files, which are pieces of one mesh."""

    time: float | None
    files: tuple[Path, ...]


@dataclass(frozen=True)
class Leaf:
    """One file with a mesh; `name` is what the list calls it, `group` the list of domains it is a piece of, if any."""

    file: Path
    name: str = ""
    group: Path | None = None


def kind_of(file: Path) -> str:
    """What a file is by its content: "pvd", "series", "grid", "pieces" (PVTU), "blocks" (VTM), "" for anything else."""
    with file.open("rb") as stream:
        head = stream.read(_HEAD)
    if match := _VTK_TYPE.search(head):
        kind = _KINDS.get(match[1].decode(), "")
        return "" if kind == "grid" and _STATES_IN_ARRAYS in head else kind
    if head.lstrip().startswith(b"{") and b"file-series-version" in head:
        return "series"
    return "grid" if is_legacy(file) else ""


def xml_type(file: Path) -> str:
    """The type that a VTK XML file states, such as "ImageData"; "" where it states none."""
    with file.open("rb") as stream:
        match = _VTK_TYPE.search(stream.read(_HEAD))
    return match[1].decode() if match else ""


def listed_states(file: Path) -> tuple[list[ListedState], tuple[str, ...]]:
    """The states of a PVD collection or of a file series in the order of their times, and a sentence for each oddity of the list.

    A solver that is started again appends to the list of its first start: a state listed twice is one state, and the
    last entry of each part counts.
    """
    entries = _pvd_entries(file) if kind_of(file) == "pvd" else _series_entries(file)
    states: list[tuple[float | None, dict[object, Path]]] = []
    at: dict[float, dict[object, Path]] = {}
    again: set[float] = set()
    for time, part, path in entries:
        pieces = at.get(time) if time is not None else None  # without times every entry is a state of its own
        if pieces is None:
            pieces = {}
            states.append((time, pieces))
            if time is not None:
                at[time] = pieces
        key = path if part is None else part
        if key in pieces and time is not None:
            again.add(time)
        pieces[key] = path
    if all(part is None for _, part, _ in entries):
        again |= _only_the_last(at)
    notes: tuple[str, ...] = ()
    if again:
        notes = (
            f"{file}: {len(again)} state{'s are' if len(again) > 1 else ' is'} listed more than once, from time "
            f"{min(again):g} on; the last entry of each counts",
        )
    told = [time for time, _ in states if time is not None and math.isfinite(time)]
    if len(told) == len(states) and told != sorted(told):
        states.sort(key=lambda state: state[0] or 0.0)
        notes = (*notes, f"{file}: its states are not listed in the order of their times, in which they are taken")
    return [ListedState(time, tuple(pieces.values())) for time, pieces in states], notes


def _only_the_last(states: dict[float, dict[object, Path]]) -> set[float]:
    """Where entries name no part and some times have a multiple of the entries of others, keep the last ones."""
    least = min(map(len, states.values()), default=0)
    if any(len(pieces) % least for pieces in states.values()):
        return set()
    again = {time for time, pieces in states.items() if len(pieces) > least}
    for time in again:
        for earlier in list(states[time])[:-least]:
            del states[time][earlier]
    return again


def _pvd_entries(file: Path) -> list[tuple[float | None, object, Path]]:
    """(time, part, file) of every entry; part is None where the entry names none."""
    entries: list[tuple[float | None, object, Path]] = []
    for entry in _tree(file, "a PVD collection").iter("DataSet"):
        attributes = entry.attrib
        try:
            path = file.parent / attributes["file"]
        except KeyError as error:
            raise ReadError(
                f"{file}: not readable as a PVD collection ({error}); it is cut short or damaged"
            ) from error
        text = attributes.get("timestep", "").strip()
        try:
            time = _seconds(text) if text else None
        except ValueError as error:
            raise ReadError(f"{file}: the timestep {text!r} is no number; expected such as 0.005") from error
        part = tuple(attributes.get(name, "") for name in ("part", "group", "name"))
        entries.append((time, part if any(part) else None, path))
    return entries


def _seconds(text: str) -> float:
    """A time of a list; programs that run in German or French write it with a decimal comma."""
    return float(text.replace(",", ".") if text.count(",") == 1 and "." not in text else text)


def _series_entries(file: Path) -> list[tuple[float | None, object, Path]]:
    try:
        listed = json.loads(file.read_text())["files"]
        return [(float(entry["time"]), "", file.parent / entry["name"]) for entry in listed]
    except (ValueError, KeyError, TypeError) as error:
        raise ReadError(f"{file}: not readable as a file series ({error}); it is cut short or damaged") from error


def _tree(file: Path, what: str) -> ElementTree.Element:
    try:
        return ElementTree.fromstring(file.read_bytes())
    except (ElementTree.ParseError, OSError) as error:
        raise ReadError(f"{file}: not readable as {what} ({error}); it is cut short or damaged") from error


def leaves(file: Path, depth: int = 0) -> list[Leaf]:
    """The files with meshes behind a file of one state: itself, the pieces of a PVTU, or the blocks of a VTM."""
    kind = kind_of(file) if file.is_file() else "grid"
    if kind not in ("pieces", "blocks"):
        return [Leaf(file)]
    if depth == _DEPTH:
        raise ReadError(f"{file}: lists of files name each other {_DEPTH} deep; expected a list of files with meshes")
    root = _tree(file, "a list of files")
    found: list[Leaf] = []
    if kind == "pieces":
        for piece in root.iter("Piece"):
            found.append(Leaf(file.parent / piece.attrib.get("Source", ""), group=file))
    else:
        for name, target in _blocks(root, ""):
            found += [Leaf(leaf.file, name, leaf.group) for leaf in leaves(file.parent / target, depth + 1)]
    if not found:
        raise ReadError(f"{file}: lists no file with a mesh; expected one at least")
    missing = [leaf.file for leaf in found if not leaf.file.is_file()]
    if missing:
        raise ReadError(f"{file}: {len(missing)} of the files it lists are missing, the first is {missing[0].name}")
    return found


def _blocks(element: ElementTree.Element, name: str) -> list[tuple[str, str]]:
    """(name, file) of all data sets below an element of a VTM; a block's name goes down to data sets without one."""
    out = []
    for child in element:
        called = child.attrib.get("name", "") or name
        if child.tag == "DataSet" and child.attrib.get("file"):
            out.append((called, child.attrib["file"]))
        else:
            out += _blocks(child, called)
    return out


def named_files(lists: Sequence[Path]) -> set[Path] | None:
    """All files that lists over time name, and the pieces behind them; None where one of the lists cannot be read."""
    out: set[Path] = set()
    try:
        for file in lists:
            for state in listed_states(file)[0]:
                for listed in state.files:
                    out.add(listed.resolve())
                    out.update(leaf.file.resolve() for leaf in leaves(listed))
    except (ReadError, OSError):
        return None
    return out
