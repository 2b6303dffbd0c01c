"""The layout of one OpenRadioss animation file.

All numbers are big-endian. A file is: magic 0x542c, time, three texts, ten flags, eight counts, then the nodes and
shells ("2D"), and behind them, where the flags say so, masses, solver numbers, solids ("3D"), beams, springs and
trusses ("1D"), the tree of subsets, nodes of the time history, and particles ("SPH"). Positions are current ones.
The status byte of an element is 0 once it is deleted.
"""

from __future__ import annotations

import gzip
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import ReadError

MAGIC = b"\x00\x00\x54\x2c"
_TEXT, _PART_TEXT = 81, 50
_MASSES, _NUMBERS, _SOLIDS, _LINES, _TREE, _HISTORY, _SPH = 0, 1, 2, 3, 4, 5, 7
# Packed results grow by a factor of 3 to 20 when unpacked; only what is made to fill the memory grows by more than this.
_EXPANSION, _UNPACKED_FREELY = 200, 64 << 20
# Time, texts, flags, counts.
_FLAGS_AT = 8 + 3 * _TEXT
_HEADER = _FLAGS_AT + 18 * 4


def starts_well(file: Path) -> bool:
    """Whether the file begins, once unpacked, as an animation file does."""
    try:
        return _first_bytes(file, 4) == MAGIC
    except (OSError, EOFError, zlib.error):
        return False


def beginning(file: Path) -> tuple[float, tuple[int, ...], int]:
    """Time, flags with counts, and size when unpacked, without reading (or unpacking) more than the beginning.

    Raises
    ------
    ReadError
        Where the file is no animation file or ends within its header.
    """
    try:
        header = _first_bytes(file, _HEADER)
        size = file.stat().st_size
        if file.suffix == ".gz":  # the trailer of a gzip stream holds its unpacked size
            with file.open("rb") as stream:
                stream.seek(-4, 2)
                size = int.from_bytes(stream.read(4), "little")
    except (OSError, EOFError, zlib.error) as error:
        raise ReadError(f"{file}: not readable ({error}); the file is cut short or damaged, copy it again") from error
    if header[:4] != MAGIC:
        raise _no_animation(file, header[:4])
    if len(header) < _HEADER:
        raise ReadError(f"{file}: ends at byte {len(header)}, within its header; copy it again or compute it again")
    return (
        float(np.frombuffer(header, ">f4", 1, 4)[0]),
        tuple(int(v) for v in np.frombuffer(header, ">i4", 18, _FLAGS_AT)),
        size,
    )


def _no_animation(file: Path, magic: bytes) -> ReadError:
    return ReadError(
        f"{file}: begins with bytes {magic.hex(' ') or '(none)'}, expected {MAGIC.hex(' ')}; "
        "this is no animation file, or it is damaged"
    )


def _first_bytes(file: Path, count: int) -> bytes:
    if file.suffix == ".gz":
        with gzip.open(file) as stream:
            return stream.read(count)
    with file.open("rb") as stream:
        return stream.read(count)


class Content:
    """The bytes of one animation file: fetched from the disk piece by piece, or unpacked from gzip as far as asked for.

    `size` is that of the whole file; of a gzip file it is what its last four bytes say.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self._packed = file.suffix == ".gz"
        self._unpacked = bytearray()
        self._stream = gzip.GzipFile(file) if self._packed else None
        with file.open("rb") as stream:
            self._on_disk = self.size = stream.seek(0, 2)
            if self._packed and self.size >= 4:
                stream.seek(-4, 2)
                self.size = int.from_bytes(stream.read(4), "little")

    @property
    def held(self) -> int:
        """Bytes in memory."""
        return len(self._unpacked)

    @property
    def end(self) -> int:
        """Where the content ends, as far as it was looked at."""
        return len(self._unpacked) if self._packed else self.size

    def reaches(self, end: int) -> bool:
        """Whether the file has at least `end` bytes."""
        if not self._packed:
            return end <= self.size
        if end > max(_UNPACKED_FREELY, _EXPANSION * self._on_disk):
            raise ReadError(
                f"{self.file}: {self._on_disk} packed bytes would become {end} or more, which no result does; the file is "
                "damaged or was made to fill the memory"
            )
        self._unpack(end)
        return end <= len(self._unpacked)

    def finish(self, end: int) -> None:
        """Look at what stands behind byte `end`, where the content should: only then gzip has checked its sum."""
        if self._packed:
            self._unpack(end + 1)
            self.size = max(self.size, len(self._unpacked))
            self._close()

    def _unpack(self, end: int) -> None:
        try:
            while self._stream is not None and len(self._unpacked) < end:
                piece = self._stream.read(min(1 << 20, end - len(self._unpacked)))
                if not piece:
                    self._close()
                self._unpacked += piece
        except (OSError, EOFError, zlib.error) as error:
            raise ReadError(
                f"{self.file}: the gzip stream is damaged behind byte {len(self._unpacked)} of its content ({error}); "
                "the file is cut short or damaged, copy it again"
            ) from error

    def _close(self) -> None:
        if self._stream is not None:
            self._stream.close()
        self._stream = None

    def read(self, offset: int, count: int) -> bytes:
        if self._packed:
            self.reaches(offset + count)
            return bytes(memoryview(self._unpacked)[offset : offset + count])
        with self.file.open("rb") as stream:
            stream.seek(offset)
            return stream.read(count)

    def array(self, where: Array) -> NDArray[Any]:
        found = self.read(where.offset, where.bytes)
        if len(found) != where.bytes:  # the file shrank since it was opened
            raise ReadError(f"{self.file}: ends at byte {where.offset + len(found)}; expected {where.bytes} bytes more")
        return np.frombuffer(found, where.dtype).reshape(where.shape)


@dataclass(frozen=True)
class Array:
    """Where an array stands in a file."""

    offset: int
    dtype: str
    shape: tuple[int, ...]

    @property
    def bytes(self) -> int:
        return math.prod(self.shape) * np.dtype(self.dtype).itemsize


@dataclass(frozen=True)
class Elements:
    """One kind of elements; `values` are scalars (element,) and tensors (element, component) by name."""

    count: int
    nodes: Array
    status: Array
    part_ends: tuple[int, ...]
    part_names: tuple[str, ...]
    values: Mapping[str, Array]
    numbers: Array | None


@dataclass(frozen=True)
class FileLayout:
    """Where everything stands in one animation file; equal for all states of a run but for the time."""

    time: float = field(compare=False)
    counts: tuple[int, ...]
    position: Array
    node_numbers: Array | None
    node_values: Mapping[str, Array]
    kinds: Mapping[str, Elements]
    size: int

    def describe(self) -> str:
        elements = ", ".join(f"{e.count} {kind}s" for kind, e in self.kinds.items())
        return f"{self.position.shape[0]} nodes, {elements} in {self.size} bytes"


class _Cursor:
    """Walks through a file; every step is checked against its end before anything is read."""

    def __init__(self, content: Content) -> None:
        self._content, self.offset = content, 0

    def array(self, what: str, dtype: str, *shape: int) -> Array:
        found = Array(self.offset, dtype, shape)
        if min(shape) < 0 or not self._content.reaches(self.offset + found.bytes):
            raise ReadError(
                f"{self._content.file}: {what} at byte {self.offset} should take {found.bytes} bytes, but the file "
                f"ends at byte {self._content.end}; it is cut short or damaged, copy it again or compute it again"
            )
        self.offset += found.bytes
        return found

    def integers(self, what: str, count: int) -> tuple[int, ...]:
        return tuple(int(v) for v in self._content.array(self.array(what, ">i4", count)))

    def counts(self, what: str, count: int) -> tuple[int, ...]:
        start = self.offset
        found = self.integers(what, count)
        if min(found) < 0:
            raise ReadError(f"{self._content.file}: {what} at byte {start} are {list(found)}; the file is damaged")
        return found

    def texts(self, what: str, count: int, width: int) -> tuple[str, ...]:
        raw = self._content.array(self.array(what, "u1", count, width))
        return tuple(bytes(row).split(b"\0")[0].decode("latin-1").strip() for row in raw)


def read_layout(content: Content) -> FileLayout:
    """Walk through a whole file.

    Raises
    ------
    ReadError
        At the first place that cannot be.
    """
    cursor = _Cursor(content)
    if content.read(0, 4) != MAGIC:
        raise _no_animation(content.file, content.read(0, 4))
    cursor.array("the magic number", "u1", 4)
    time = float(content.array(cursor.array("the time", ">f4", 1))[0])
    cursor.texts("the titles", 3, _TEXT)
    flags = cursor.integers("the flags", 10)
    if any(f not in (0, 1) for f in flags[:8]):
        raise ReadError(
            f"{content.file}: the flags at byte 251 are {list(flags)}, expected 0 or 1; the file is damaged"
        )
    counts = cursor.counts("the counts", 8)
    nodes, shells, parts, node_scalars, shell_scalars, vectors, tensors, skews = counts
    cursor.array("the skews", ">u2", skews, 6)
    position = cursor.array("the node positions", ">f4", nodes, 3)
    shell_nodes = cursor.array("the shells", ">i4", shells, 4)
    status = cursor.array("the status of the shells", "u1", shells)
    ends = cursor.integers("the ends of the parts", parts)
    names = cursor.texts("the names of the parts", parts, _PART_TEXT)
    cursor.array("the normals", ">u2", nodes, 3)
    scalar_names = cursor.texts("the names of the scalars", node_scalars + shell_scalars, _TEXT)
    node_values = _named(cursor, scalar_names[:node_scalars], nodes)
    shell_values = _named(cursor, scalar_names[node_scalars:], shells)
    node_values |= _named(cursor, cursor.texts("the names of the vectors", vectors, _TEXT), nodes, 3)
    shell_values |= _named(cursor, cursor.texts("the names of the tensors", tensors, _TEXT), shells, 3)
    if flags[_MASSES]:
        cursor.array("the masses", ">f4", shells + nodes)
    node_numbers = shell_numbers = None
    if flags[_NUMBERS]:
        node_numbers = cursor.array("the node numbers", ">i4", nodes)
        shell_numbers = cursor.array("the shell numbers", ">i4", shells)
    if flags[_TREE]:
        cursor.array("the subsets of the parts", ">i4", 3, parts)
    kinds = {"shell": Elements(shells, shell_nodes, status, ends, names, shell_values, shell_numbers)}
    if flags[_SOLIDS]:
        kinds["solid"] = _read_elements(cursor, flags, "solids", 8, 6)
    if flags[_LINES]:
        kinds["beam"] = _read_elements(cursor, flags, "beams", 2, 9)
    if flags[_TREE]:
        _skip_tree(cursor)
    if flags[_HISTORY]:
        for listed in cursor.counts("the counts of the time history", 4):
            cursor.array("the list of the time history", ">i4", listed)
            cursor.array("the names of the time history", "u1", listed, _PART_TEXT)
    if flags[_SPH]:
        kinds["sph"] = _read_elements(cursor, flags, "particles", 1, 6)
    content.finish(cursor.offset)
    for kind, elements in kinds.items():
        _check_parts(content.file, kind, elements)
    return FileLayout(time, (*flags, *counts), position, node_numbers, node_values, kinds, cursor.offset)


def _read_elements(cursor: _Cursor, flags: tuple[int, ...], what: str, corners: int, components: int) -> Elements:
    """Solids, beams or particles, which are written alike."""
    count, parts, scalars, tensors, *skews = cursor.counts(f"the counts of the {what}", 5 if what == "beams" else 4)
    nodes = cursor.array(f"the {what}", ">i4", count, corners)
    status = cursor.array(f"the status of the {what}", "u1", count)
    ends = cursor.integers(f"the ends of the parts of {what}", parts)
    names = cursor.texts(f"the names of the parts of {what}", parts, _PART_TEXT)
    values = _named(cursor, cursor.texts(f"the scalars of the {what}", scalars, _TEXT), count)
    values |= _named(cursor, cursor.texts(f"the tensors of the {what}", tensors, _TEXT), count, components)
    if skews and skews[0]:
        cursor.array(f"the skews of the {what}", ">i4", count)
    if flags[_MASSES]:
        cursor.array(f"the masses of the {what}", ">f4", count)
    numbers = cursor.array(f"the numbers of the {what}", ">i4", count) if flags[_NUMBERS] else None
    if flags[_TREE]:
        cursor.array(f"the subsets of the {what}", ">i4", 3, parts)
    return Elements(count, nodes, status, ends, names, values, numbers)


def _named(cursor: _Cursor, names: tuple[str, ...], *shape: int) -> dict[str, Array]:
    return {name: cursor.array(f"the values of {name}", ">f4", *shape) for name in names}


def _skip_tree(cursor: _Cursor) -> None:
    (subsets,) = cursor.counts("the number of subsets", 1)
    for _ in range(subsets):
        cursor.array("a subset", "u1", _PART_TEXT + 4)
        for what in ("sons", "2D parts", "3D parts", "1D parts"):
            cursor.array(f"the {what} of a subset", ">i4", *cursor.counts(f"the number of {what} of a subset", 1))
    for listed in cursor.counts("the numbers of materials and properties", 2):
        cursor.array("materials and properties", "u1", listed, _PART_TEXT + 4)


def _check_parts(file: Path, kind: str, elements: Elements) -> None:
    ends = elements.part_ends
    if any(a > b for a, b in zip((0, *ends), ends)) or (elements.count and (not ends or ends[-1] != elements.count)):
        raise ReadError(f"{file}: the parts of its {elements.count} {kind}s end at {list(ends)}; the file is damaged")
