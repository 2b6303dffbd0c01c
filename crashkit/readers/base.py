"""What every reader yields: a `Run`, in the solver's own units, read in bounded pieces.

A reader is one file in this folder with a class that has `name`, `sniff`, `runs` and ends with
`register(...)`. Readers write nothing and convert nothing: units, alignment, part selection and the dataset's
layout belong to `crashkit.ingestion`, so that they are the same for every format.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from crashkit.readers.history import History


@dataclass(frozen=True)
class Part:
    """One part of the solver's model. `rigid_wall` parts are drawn by solvers but are no structure."""

    id: int
    name: str
    rigid_wall: bool = False


@dataclass(frozen=True)
class RunMesh:
    """The mesh of one run as its solver wrote it, everything included.

    face_nodes (face, 3 or 4) int32, 0-based, -1 in the last corner of a triangle: shells only; the outer skin
               of solids is found by ingest
    face_part  (face,) int32 index into `parts`
    face_id    (face,) int64 element number
    cell_nodes (cell, corner) int32, padded with -1: solids and beams; cell_type (cell,) uint8 VTK cell type
    cell_part, cell_id as for faces

    Attributes
    ----------
    position
        (node, 3) float64, solver's length unit: the undeformed configuration.
    node_id
        (node,) int64.
    """

    position: NDArray[np.float64]
    node_id: NDArray[np.int64]
    face_nodes: NDArray[np.int32]
    face_part: NDArray[np.int32]
    face_id: NDArray[np.int64]
    parts: tuple[Part, ...]
    cell_nodes: NDArray[np.int32] = field(default_factory=lambda: np.empty((0, 0), np.int32))
    cell_type: NDArray[np.uint8] = field(default_factory=lambda: np.empty(0, np.uint8))
    cell_part: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    cell_id: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))


@dataclass(frozen=True)
class FieldInfo:
    """A further result field a run offers.

    `quantity` names what it measures for the change to SI ("velocity", "stress", "one", ... as in
    `data_schema.units`); `components` is 1 for a scalar.
    """

    name: str
    location: Literal["node", "face", "cell"]
    components: int = 1
    quantity: str = "one"


@dataclass(frozen=True)
class Parameter:
    """A design parameter as its source states it; `unit` may be empty."""

    value: float
    unit: str = ""


class Run(ABC):
    """One solver run, opened lazily. Everything is in the units of its source.

    Attributes
    ----------
    name
        Unique in its source: folder or file name, or the number in the file.
    solver
        "LS-DYNA", "OpenRadioss", ... as far as known.
    files
        Every file the run is read from, for checksums.
    time
        (state,) float64.
    mesh
        RunMesh.
    parameters
        Known from the source itself, often empty.
    fields
        What `field` can give, by name.
    units
        Unit system if the source states one ("SI"), else None: the user must say.
    end_time
        The end time the control data asks for, None where the source does not say.
    left_out
        What the source holds and this reader does not give, by name.
    problems
        Reasons why the run is incomplete or damaged though it can be opened; ingest refuses such runs.
    notes
        What a user should know though nothing is wrong, such as states that were listed twice.
    withheld
        Fields that are in the files and not offered: name -> why, and what to do.
    """

    name: str
    solver: str
    files: tuple[Path, ...]
    time: NDArray[np.float64]
    mesh: RunMesh
    parameters: Mapping[str, Parameter]
    fields: Mapping[str, FieldInfo]
    units: str | None = None
    end_time: float | None = None
    left_out: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    withheld: Mapping[str, str] = MappingProxyType({})

    @abstractmethod
    def displacement(self, first: int, last: int) -> NDArray[np.float32]:
        """Displacements (state, node, 3) of the states first <= state < last, from `mesh.position`."""

    def field(self, name: str, first: int, last: int) -> NDArray[np.float32]:
        """Field `name` (state, node | face | cell [, component]) of the states first <= state < last."""
        raise KeyError(name)

    def alive(self, first: int, last: int) -> NDArray[np.bool_] | None:
        """(state, face) whether each shell still exists; None where nothing in this run can erode."""
        return None

    def alive_cells(self, first: int, last: int) -> NDArray[np.bool_] | None:
        """(state, cell) the same for solids and beams."""
        return None

    def history(self) -> History | None:
        """Curves of energies, forces and the like, at times of their own; None where the source holds none.

        Raises
        ------
        ReadError
            Where they are there and cannot be read.
        """
        return None

    def file_of(self, state: int) -> Path:
        """The file that holds a state, for messages. Without a reader's own answer: of as many files as states, that one."""
        return self.files[state if len(self.files) == len(self.time) else 0]

    def printed(self) -> tuple[Path, str] | None:
        """Folder and name under which the solver printed how this run went, where it stands beside the results."""
        return None

    def close(self) -> None:  # noqa: B027 - most readers hold nothing open
        """Let go of files."""


class Runs(Iterator[Run]):
    """Runs of one source, by name; each is opened only when its turn comes or when it is asked for.

    One that cannot be opened raises ReadError, and the iteration goes on behind it. `passed_over` says in words what
    the source holds beside them.
    """

    def __init__(self, openers: Mapping[str, Callable[[], Run]], passed_over: Sequence[str] = ()) -> None:
        self._openers = dict(openers)
        self._left = iter(self._openers)
        self.passed_over = tuple(passed_over)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._openers)

    def open(self, name: str) -> Run:
        """The run called `name`, without opening any other.

        Raises
        ------
        KeyError, ReadError
            As in the iteration.
        """
        return self._openers[name]()

    def __next__(self) -> Run:
        return self.open(next(self._left))


class Reader(Protocol):
    """One source format."""

    name: str
    description: str

    def sniff(self, path: Path) -> bool:
        """Whether the content of `path` (a file, or a folder holding one run or several) is this format.

        Looks at magic bytes or structure, never only at the suffix; never raises; never reads much.
        """

    def runs(self, path: Path, **options: object) -> Iterator[Run]:
        """The runs in `path`, opened one after the other; the readers of this folder give `Runs`.

        Raises crashkit.errors.ReadError, naming the file and the place in it.
        """


def distinct_parts(parts: Sequence[Part]) -> tuple[Part, ...]:
    """The parts, each with a number of its own: solvers count shells, beams and rigid bodies from 1 each.

    The first part of a number keeps it; later ones get the next numbers behind the largest. A wall may share one: it is
    no part of the structure.
    """
    out: list[Part] = []
    used: set[int] = set()
    free = max((p.id for p in parts), default=0) + 1
    for part in parts:
        if part.id in used and not part.rigid_wall:
            part, free = replace(part, id=free), free + 1
        if not part.rigid_wall:
            used.add(part.id)
        out.append(part)
    return tuple(out)
