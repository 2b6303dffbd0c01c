"""OpenRadioss animation files: NAMEA001, NAMEA002, ..., plain or gzip, one file a state.

Rigid walls are drawn as nodes and facets of their own. They have no number in the deck: a part whose elements and
nodes all carry number 0 is one (measured: the wall's part in real files; the structure's numbers start at 1). Where
a file holds no numbers, the part's name must say it.

Beside the animation files, the decks are looked at if they are there: NAME_0000.rad for the units (/BEGIN), and
NAME_0001.rad and later for the end time (/RUN).

Fields keep the solver's names in lower case with underscores. Those of shells and nodes stand alone
(`plastic_strain`, `velocity`); those of other elements carry their kind in front (`solid_plastic_strain`).
"""

from __future__ import annotations

import re
from collections import OrderedDict
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import ReadError
from crashkit.readers import _radioss_deck as deck
from crashkit.readers import register
from crashkit.readers._cells import LINE, VERTEX, shell_faces, solid_cells, stack_cells
from crashkit.readers._folders import Collected, files_in, named, recognises, runs_in
from crashkit.readers._names import DISPLACEMENT_NAMES, WALL_NAME, field_name, quantity
from crashkit.readers._radioss_file import Array, Content, beginning, read_layout, starts_well
from crashkit.readers._radioss_history import read_history
from crashkit.readers.base import FieldInfo, Parameter, Part, Run, RunMesh, Runs, distinct_parts
from crashkit.readers.checks import require_finite, require_indices, require_options, time_problems
from crashkit.readers.history import History

_FILE = re.compile(r"(?P<root>.+)A(?P<number>\d{3,4})(?:\.gz)?")
# Unpacked gzip files are kept up to this many bytes, so that a state's fields need not unpack it again.
_CACHE = 64 << 20


class OpenRadioss:
    """Reader of a file, of a folder with one run or several (told apart by NAME), or of a folder of such folders."""

    name = "openradioss"
    description = "OpenRadioss animation files (NAMEA001, NAMEA002, ...), plain or gzip"

    def sniff(self, path: Path) -> bool:
        return recognises(_families, path)

    def runs(self, path: Path, **options: object) -> Runs:
        require_options(self.name, options)
        found = _families(path)
        if not found:
            raise ReadError(f"{path}: no OpenRadioss animation files (NAMEA001, NAMEA002, ...) here")
        return Runs({name: partial(_RadiossRun, name, files) for name, files in found.runs.items()}, found.aside)


def _families(path: Path) -> Collected[dict[int, Path]]:
    """Run name -> {number: file} for all runs at `path`."""
    if path.is_file():
        match = _FILE.fullmatch(path.name)
        if match is None or not starts_well(path):
            return Collected()
        found = _families_in(path.parent).runs
        root = match["root"]
        return Collected({root if len(found) > 1 else path.resolve().parent.name: found[root]})
    if not path.is_dir():
        return Collected()
    return runs_in(path, _families_in)


def _families_in(folder: Path) -> Collected[dict[int, Path]]:
    families: dict[str, dict[int, Path]] = {}
    for file in files_in(folder):
        match = _FILE.fullmatch(file.name)
        if not match:
            continue
        states, number = families.setdefault(match["root"], {}), int(match["number"])
        there = states.setdefault(number, file)  # the plain file comes first and wins over its gzip copy
        if there.name.removesuffix(".gz") != file.name.removesuffix(".gz"):
            raise ReadError(
                f"{folder}: {there.name} and {file.name} have the same number; expected one file a state, so rename or "
                "remove one of them"
            )
    # One good file is enough: the damaged ones of its family are to be named, not overlooked.
    return Collected(
        named(
            (root, root, dict(sorted(files.items())))
            for root, files in families.items()
            if any(map(starts_well, files.values()))
        )
    )


class _RadiossRun(Run):
    """One family of animation files; arrays are read from a state's file when they are asked for."""

    def __init__(self, name: str, files: Mapping[int, Path]) -> None:
        self.name, self.solver = name, "OpenRadioss"
        self._numbers, self._states = tuple(files), tuple(files.values())
        self._contents: OrderedDict[int, Content] = OrderedDict()
        self._checked: set[int] = set()
        first = self._content(0)
        self._layout = read_layout(first)
        self._nodes = {kind: first.read(e.nodes.offset, e.nodes.bytes) for kind, e in self._layout.kinds.items()}
        self.time = np.array([self._time(k) for k in range(len(self._states))])
        self._cell_kinds = tuple(k for k in ("solid", "beam", "sph") if k in self._layout.kinds)
        self._arrays, self.fields = self._name_fields()
        self.mesh = self._read_mesh()
        self.parameters: Mapping[str, Parameter] = {}
        decks = deck.decks(self._states[0].parent, self._root)
        curves = self._states[0].with_name(f"{self._root}T01")
        self._curves = curves if curves.is_file() else None
        self.files = (*self._states, *decks, *([self._curves] if self._curves is not None else []))
        self.units = deck.units(decks)
        self.end_time = deck.end_time(decks)
        self.problems = (*self._gaps(), *time_problems(self.time, self._states), *self._start())

    @property
    def _root(self) -> str:
        match = _FILE.fullmatch(self._states[0].name)
        return match["root"] if match else ""

    def history(self) -> History | None:
        """The curves of NAMET01, where it is beside the animation files."""
        return read_history(self._curves) if self._curves is not None else None

    def file_of(self, state: int) -> Path:
        return self._states[state]

    def printed(self) -> tuple[Path, str] | None:
        """NAME_0001.out, where it stands beside the animation files."""
        return self._states[0].parent, self._root

    # Files

    def _time(self, state: int) -> float:
        """Time of a state whose header and size agree with the first; the rest of it is checked when it is read."""
        file = self._states[state]
        time, counts, size = beginning(file)
        if (counts, size) != (self._layout.counts, self._layout.size):
            self._require_same(self._content(state))
        return time

    def _content(self, state: int) -> Content:
        if state in self._contents:
            self._contents.move_to_end(state)
            return self._contents[state]
        content = self._contents[state] = Content(self._states[state])
        while len(self._contents) > 1 and sum(c.held for c in self._contents.values()) > _CACHE:
            self._contents.popitem(last=False)
        return content

    def _require_same(self, content: Content) -> None:
        """Raise ReadError unless the file has the layout and the elements of the first."""
        layout, first = read_layout(content), self._layout
        if layout != first:
            raise ReadError(
                f"{content.file}: holds {layout.describe()}, {self._states[0].name} holds {first.describe()}; "
                "the mesh or the output changed during the run, which is not supported"
            )
        for kind, elements in first.kinds.items():
            if content.read(elements.nodes.offset, elements.nodes.bytes) != self._nodes[kind]:
                raise ReadError(
                    f"{content.file}: the {kind}s at byte {elements.nodes.offset} join other nodes than in "
                    f"{self._states[0].name}; the mesh changed during the run, or the file is damaged"
                )

    def _state(self, state: int) -> Content:
        """The content of a state, checked against the first when it is first used."""
        content = self._content(state)
        if state not in self._checked:
            self._require_same(content)
            self._checked.add(state)
        return content

    # What the run is

    def _read_mesh(self) -> RunMesh:
        content, layout = self._state(0), self._layout
        position = content.array(layout.position).astype(np.float64)
        if layout.time != 0 and (moved := self._displacement_vector()) is not None:
            position -= content.array(moved)
        require_finite(position, "the position", f"{content.file}, byte {layout.position.offset}")
        count = len(position)
        node_id = _numbers(content, layout.node_numbers, count)
        parts: list[Part] = []
        owners, ids = {}, {}
        for kind, elements in layout.kinds.items():
            nodes = content.array(elements.nodes)
            require_indices(nodes, count, kind, f"{content.file}, byte {elements.nodes.offset}")
            ids[kind] = _numbers(content, elements.numbers, elements.count)
            owners[kind] = len(parts) + np.searchsorted(elements.part_ends, np.arange(elements.count), "right")
            numbered = elements.numbers is not None and layout.node_numbers is not None
            for start, end, text in zip((0, *elements.part_ends), elements.part_ends, elements.part_names):
                ours = slice(start, end)
                if kind != "shell" or start == end:
                    wall = False
                elif numbered:
                    wall = not ids[kind][ours].any() and not node_id[nodes[ours]].any()
                else:
                    wall = WALL_NAME.search(text) is not None
                parts.append(_part(text, len(parts) + 1, wall))
        cells, types = [], []
        for kind in self._cell_kinds:
            nodes = content.array(layout.kinds[kind].nodes).astype(np.int32)
            kinds = np.full(len(nodes), LINE if kind == "beam" else VERTEX, np.uint8)
            if kind == "solid":
                nodes, kinds = solid_cells(nodes)
            cells.append(nodes)
            types.append(kinds)
        shells = layout.kinds["shell"]
        return RunMesh(
            position=position,
            node_id=node_id,
            face_nodes=shell_faces(content.array(shells.nodes)),
            face_part=owners["shell"].astype(np.int32),
            face_id=ids["shell"],
            parts=distinct_parts(parts),
            cell_nodes=stack_cells(cells),
            cell_type=np.concatenate([np.empty(0, np.uint8), *types]),
            cell_part=np.concatenate([np.empty(0, np.int32), *(owners[k] for k in self._cell_kinds)]).astype(np.int32),
            cell_id=np.concatenate([np.empty(0, np.int64), *(ids[k] for k in self._cell_kinds)]),
        )

    def _displacement_vector(self) -> Array | None:
        for name, array in self._layout.node_values.items():
            if field_name(name) in DISPLACEMENT_NAMES and len(array.shape) == 2:
                return array
        return None

    def _name_fields(self) -> tuple[dict[str, tuple[str, Array]], dict[str, FieldInfo]]:
        arrays: dict[str, tuple[str, Array]] = {}
        fields: dict[str, FieldInfo] = {}
        for kind, values in (
            ("node", self._layout.node_values),
            *((k, e.values) for k, e in self._layout.kinds.items()),
        ):
            for title, array in values.items():
                plain = field_name(title)
                if kind == "node" and plain in DISPLACEMENT_NAMES:
                    continue
                name = plain if kind in ("node", "shell") else f"{kind}_{plain}"
                name = f"{kind}_{plain}" if name in fields else name
                place = "node" if kind == "node" else "face" if kind == "shell" else "cell"
                components = array.shape[1] if len(array.shape) == 2 else 1
                arrays[name] = (kind, array)
                fields[name] = FieldInfo(name, place, components, quantity(plain))  # type: ignore[arg-type]
        return arrays, fields

    # Why it may be incomplete

    def _gaps(self) -> list[str]:
        missing = sorted(set(range(1, self._numbers[-1] + 1)) - set(self._numbers))
        if not missing:
            return []
        names = ", ".join(f"{self._root}A{n:03d}" for n in missing[:5]) + (", ..." if len(missing) > 5 else "")
        return [
            f"{self._states[0].parent}: {len(missing)} of the animation files up to {self._states[-1].name} "
            f"are missing: {names}"
        ]

    def _start(self) -> list[str]:
        problems = []
        if self._layout.time != 0 and self._displacement_vector() is None:
            problems.append(
                f"{self._states[0]}: the first state is at time {self._layout.time:g} and has no displacements, so the "
                "undeformed positions are not known; expected a state at time 0"
            )
        size = self._content(0).size
        if size != self._layout.size:
            problems.append(
                f"{self._states[0]}: {size - self._layout.size} bytes behind byte {self._layout.size}, its end"
            )
        return problems

    # Values of states

    def displacement(self, first: int, last: int) -> NDArray[np.float32]:
        out = np.empty((last - first, len(self.mesh.position), 3), np.float32)
        for row, state in enumerate(range(first, last)):
            content = self._state(state)
            position = content.array(self._layout.position)
            place = f"{content.file}, state {state}, byte {self._layout.position.offset}"
            require_finite(position, "the position", place)
            out[row] = position - self.mesh.position
        return out

    def field(self, name: str, first: int, last: int) -> NDArray[np.float32]:
        kind, array = self._arrays[name]
        values = np.stack([self._state(s).array(array) for s in range(first, last)]).astype(np.float32)
        return values if self.fields[name].location != "cell" else self._among_cells(kind, values, np.nan)

    def alive(self, first: int, last: int) -> NDArray[np.bool_] | None:
        return self._status("shell", first, last)

    def alive_cells(self, first: int, last: int) -> NDArray[np.bool_] | None:
        if not self._cell_kinds:
            return None
        return np.concatenate([self._status(kind, first, last) for kind in self._cell_kinds], axis=1)

    def _status(self, kind: str, first: int, last: int) -> NDArray[np.bool_]:
        status = self._layout.kinds[kind].status
        return np.stack([self._state(s).array(status) != 0 for s in range(first, last)])

    def _among_cells(self, kind: str, values: NDArray[np.float32], missing: float) -> NDArray[np.float32]:
        """Values of one kind of cells as values of all cells, `missing` on the others."""
        counts = [self._layout.kinds[k].count for k in self._cell_kinds]
        start = sum(counts[: self._cell_kinds.index(kind)])
        out = np.full((len(values), sum(counts), *values.shape[2:]), missing, np.float32)
        out[:, start : start + values.shape[1]] = values
        return out

    def close(self) -> None:
        self._contents.clear()


def _numbers(content: Content, where: Array | None, count: int) -> NDArray[np.int64]:
    """The solver's numbers, or 1, 2, ... where the file holds none."""
    return np.arange(1, count + 1) if where is None else content.array(where).astype(np.int64)


def _part(text: str, order: int, wall: bool) -> Part:
    """A part named as the solver writes it, "12: front rail"."""
    number, colon, name = text.partition(":")
    if colon and number.strip().isdigit():
        return Part(int(number), name.strip(), wall)
    return Part(order, text, wall)


register(OpenRadioss())
