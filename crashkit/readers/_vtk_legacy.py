"""Legacy VTK files (.vtk), ASCII and binary, with unstructured grids or poly data.

VTK's own reader takes an ASCII file that is cut short for a whole one (114 of 300 cut at random places came back
changed without an error, one ended the interpreter, VTK 9.7), so every count is held against what is there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import ReadError
from crashkit.readers._grid import Grid

_BEGINNING = b"# vtk DataFile Version"
_FRONT = 1 << 16
# VTK's names of types; `bit` is packed and no result of a crash solver.
_TYPES = {
    "unsigned_char": "u1", "char": "i1", "unsigned_short": "u2", "short": "i2", "unsigned_int": "u4", "int": "i4",
    "unsigned_long": "u8", "long": "i8", "vtktypeint64": "i8", "vtkidtype": "i8", "vtktypeuint8": "u1",
    "float": "f4", "double": "f8",
}  # fmt: skip
_POLYDATA = {"VERTICES": 2, "LINES": 4, "POLYGONS": 7}
_ATTRIBUTES = ("SCALARS", "VECTORS", "NORMALS", "TENSORS", "FIELD", "LOOKUP_TABLE", "TEXTURE_COORDINATES")


def is_legacy(file: Path) -> bool:
    with file.open("rb") as stream:
        return stream.read(len(_BEGINNING)) == _BEGINNING


def read_legacy(file: Path) -> Grid:
    """The mesh and arrays of one legacy file.

    Raises
    ------
    ReadError
        Naming the byte where it stops making sense.
    """
    try:
        content = file.read_bytes()
    except OSError as error:
        raise ReadError(f"{file}: not readable ({error.strerror})") from error
    return _Legacy(file, content).grid()


def legacy_field_data(file: Path) -> dict[str, NDArray[Any]]:
    """The field data in front of the mesh, such as the time, without reading further."""
    with file.open("rb") as stream:
        return _Legacy(file, stream.read(_FRONT)).front()


class _Legacy:
    """Goes through a file once, from its first word to its last."""

    def __init__(self, file: Path, content: bytes) -> None:
        self.file, self._content, self._at = file, content, 0
        if not self._line().startswith(_BEGINNING.decode()):
            raise self._wrong("no '# vtk DataFile Version' in its first line")
        self._line()  # title
        encoding = self._line().strip().upper()
        if encoding not in ("ASCII", "BINARY"):
            raise self._wrong(f"it says {encoding[:20]!r}, expected ASCII or BINARY")
        self._binary = encoding == "BINARY"
        self._points: NDArray[Any] = np.empty((0, 3))
        self._cells: list[tuple[NDArray[np.int64], NDArray[np.int64], int]] = []
        self._types: NDArray[np.uint8] | None = None
        self._data: dict[str, dict[str, NDArray[Any]]] = {"field": {}, "point": {}, "cell": {}}

    def _wrong(self, what: str) -> ReadError:
        return ReadError(f"{self.file}: {what} (byte {self._at} of {len(self._content)}); it is cut short or damaged")

    def _heading(self) -> None:
        kind = self._words(2)
        if kind[0] != "DATASET" or kind[1] not in ("UNSTRUCTURED_GRID", "POLYDATA"):
            raise self._wrong(f"holds {' '.join(kind)}, expected DATASET UNSTRUCTURED_GRID or POLYDATA")

    def front(self) -> dict[str, NDArray[Any]]:
        self._heading()
        while self._word() == "FIELD":
            self._read_attribute("FIELD", "field", 0)
        return self._data["field"]

    def grid(self) -> Grid:
        self._heading()
        place, count = "field", 0
        while word := self._word():
            if word == "POINTS":
                number, kind_of = self._words(2)
                self._points = self._values(self._count(number) * 3, kind_of).reshape(-1, 3)
            elif word == "CELLS" or word in _POLYDATA:
                self._cells.append((*self._read_cells(), _POLYDATA.get(word, 0)))
            elif word == "CELL_TYPES":
                self._types = self._values(self._count(self._words(1)[0]), "int").astype(np.uint8)
            elif word in ("POINT_DATA", "CELL_DATA"):
                place, count = word.split("_")[0].lower(), self._count(self._words(1)[0])
            elif word in _ATTRIBUTES:
                self._read_attribute(word, place, count)
            elif word == "METADATA":
                self._line()
                while self._line().strip():  # up to an empty line
                    pass
            else:
                raise self._wrong(f"the word {word[:30]!r} is not known")
        return self._whole()

    def _whole(self) -> Grid:
        if not len(self._points) or not self._cells:
            raise self._wrong("no mesh in it")
        starts = np.cumsum([0, *(len(joined) for _, joined, _ in self._cells)])
        offsets = np.concatenate([[0], *(o[1:] + s for (o, _, _), s in zip(self._cells, starts))]).astype(np.int64)
        if self._types is None:
            kinds = [np.full(len(o) - 1, kind, np.uint8) for o, _, kind in self._cells]
            self._types = np.concatenate(kinds)
        joined = np.concatenate([joined for _, joined, _ in self._cells])
        data = self._data
        return Grid(self._points, joined, offsets, self._types, data["point"], data["cell"], data["field"])

    def _read_cells(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Offsets (n + 1,) and corners of a list of cells, in the old form (count, corners) or the new (offsets)."""
        first, second = (self._count(w) for w in self._words(2))
        before = self._at
        if self._word() == "OFFSETS":
            offsets = self._values(first, self._words(1)[0]).astype(np.int64)
            if self._word() != "CONNECTIVITY":
                raise self._wrong("no CONNECTIVITY behind OFFSETS")
            return offsets, self._values(second, self._words(1)[0]).astype(np.int64)
        self._at = before
        listed = self._values(second, "int").astype(np.int64)
        starts = self._cell_starts(listed, first)
        corner = np.ones(second, bool)
        corner[starts] = False
        return np.concatenate([[0], np.cumsum(listed[starts])]), listed[corner]

    def _cell_starts(self, listed: NDArray[np.int64], count: int) -> NDArray[np.int64]:
        """Where each cell's number of corners stands in a list (corners, node, node, ...)."""
        width = len(listed) // count if count else 0
        if width and width * count == len(listed) and (listed[::width] == width - 1).all():
            return np.arange(count) * width
        starts = np.empty(count, np.int64)
        at = 0
        for k in range(count):  # cells of different kinds: each tells where the next begins
            if at >= len(listed) or listed[at] < 0:
                raise self._wrong(f"cell {k} of {count} begins behind the list's end, or has no corners")
            starts[k] = at
            at += int(listed[at]) + 1
        if at != len(listed):
            raise self._wrong(f"{count} cells take {at} numbers, {len(listed)} are announced")
        return starts

    def _read_attribute(self, word: str, place: str, count: int) -> None:
        if word == "FIELD":
            for _ in range(self._count(self._words(2)[1])):
                name, width, tuples, kind = self._words(4)
                self._keep(place, name, self._table(self._count(tuples), self._count(width), kind))
            return
        name, kind = self._words(2)
        if word == "LOOKUP_TABLE":  # colours: the second word is their number
            self._values(4 * self._count(kind), "unsigned_char" if self._binary else "float")
            return
        components = {"VECTORS": 3, "NORMALS": 3, "TENSORS": 9}.get(word, 1)
        if word == "TEXTURE_COORDINATES":
            components, kind = self._count(kind), self._words(1)[0]
        if word == "SCALARS":
            before = self._at
            following = self._word()
            if following.isdigit():
                components, before = int(following), self._at
                following = self._word()
            if following == "LOOKUP_TABLE":
                self._words(1)
            else:
                self._at = before
        self._keep(place, name, self._table(count, components, kind))

    def _table(self, rows: int, columns: int, kind: str) -> NDArray[Any]:
        return self._values(rows * columns, kind).reshape(rows, columns)

    def _keep(self, place: str, name: str, values: NDArray[Any]) -> None:
        self._data[place][name.replace("%20", " ")] = values[:, 0] if values.shape[1] == 1 else values

    # Words and numbers

    def _line(self) -> str:
        end = self._content.find(b"\n", self._at)
        end = len(self._content) if end < 0 else end
        line, self._at = self._content[self._at : end], min(end + 1, len(self._content))
        return line.decode("latin-1")

    def _word(self) -> str:
        """The next word, "" at the end of the file."""
        content, at = self._content, self._at
        while at < len(content) and content[at] in b" \t\r\n":
            at += 1
        start = at
        while at < len(content) and content[at] not in b" \t\r\n":
            at += 1
        self._at = at
        return content[start:at].decode("latin-1")

    def _words(self, count: int) -> list[str]:
        found = [self._word() for _ in range(count)]
        if "" in found:
            raise self._wrong("it ends within a heading")
        return found

    def _count(self, word: str) -> int:
        # No array can have more numbers than the file has bytes.
        if not word.isascii() or not word.isdigit() or int(word) > len(self._content):
            raise self._wrong(f"{word[:30]!r} stands where a number of values should")
        return int(word)

    def _values(self, count: int, kind: str) -> NDArray[Any]:
        """The next `count` numbers."""
        if kind.lower() not in _TYPES:
            raise self._wrong(f"values of type {kind[:30]!r}")
        dtype = np.dtype(_TYPES[kind.lower()])
        if self._binary:
            self._line()  # the rest of the heading's line
            end = self._at + count * dtype.itemsize
            if end > len(self._content):
                raise self._wrong(f"{count} values of {kind} should end at byte {end}")
            values = np.frombuffer(self._content[self._at : end], dtype.newbyteorder(">"))
            self._at = end
            return values.astype(dtype)
        values = self._ascii_values(count, dtype)
        if self._at >= len(self._content) and count and self._content[-1:] not in (b"\n", b" ", b"\t", b"\r"):
            raise self._wrong("it ends within a number")
        return values

    def _ascii_values(self, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
        pieces: list[bytes] = []
        missing = count
        while missing:
            # At least two bytes a number; split() forgets where a piece ended, so pieces end at line ends.
            end = self._content.find(b"\n", min(len(self._content), self._at + 2 * missing))
            end = len(self._content) if end < 0 else end + 1
            words = self._content[self._at : end].split()
            if len(words) > missing:
                return self._ascii_tail(pieces, missing, dtype)
            pieces += words
            missing -= len(words)
            if missing and end == len(self._content):
                raise self._wrong(f"{missing} of {count} values are missing")
            self._at = end
        return self._numbers(pieces, dtype)

    def _ascii_tail(self, pieces: list[bytes], missing: int, dtype: np.dtype[Any]) -> NDArray[Any]:
        """The last numbers one by one: behind them, in the same piece, other words follow."""
        pieces += [word.encode("latin-1") for word in self._words(missing)]
        return self._numbers(pieces, dtype)

    def _numbers(self, words: list[bytes], dtype: np.dtype[Any]) -> NDArray[Any]:
        try:
            return np.array(words, dtype="S").astype(dtype) if words else np.empty(0, dtype)
        except (ValueError, OverflowError) as error:
            raise self._wrong(f"a value is no number of type {dtype.name} ({error})") from error
