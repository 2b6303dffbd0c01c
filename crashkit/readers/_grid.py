"""Meshes as VTK, Exodus and XDMF files hold them, and where the states of a run of them come from."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import ReadError
from crashkit.readers._names import NODE_IDS
from crashkit.readers.checks import require_indices

Place = Literal["point", "cell"]


@dataclass(frozen=True)
class Grid:
    """A mesh as VTK keeps it: cell k joins the points `connectivity[offsets[k] : offsets[k + 1]]`.

    `part_names` names the numbers in a part array, `units` the unit of arrays that say so.
    """

    points: NDArray[np.floating]
    connectivity: NDArray[np.int64]
    offsets: NDArray[np.int64]
    types: NDArray[np.uint8]
    point_data: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    cell_data: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    field_data: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    part_names: Mapping[int, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)

    def check(self, place: object) -> None:
        """Raise ReadError where cells and arrays do not fit the points."""
        count = len(self.points)
        if not count or not len(self.types):
            raise ReadError(f"{place}: holds {count} points and {len(self.types)} cells; expected a mesh")
        sizes = np.diff(self.offsets)
        if len(sizes) != len(self.types) or (sizes < 0).any() or self.offsets[-1] != len(self.connectivity):
            raise ReadError(
                f"{place}: its cells end at {self.offsets[-1]} of {len(self.connectivity)} corners; damaged"
            )
        require_indices(self.connectivity, count, "corner", place)
        for arrays, expected in ((self.point_data, count), (self.cell_data, len(self.types))):
            for name, values in arrays.items():
                if len(values) != expected:
                    raise ReadError(f"{place}: array {name!r} has {len(values)} values, expected {expected}; damaged")


class GridSource(ABC):
    """Where the states of a run come from.

    first()       the mesh of the first state with all its arrays
    points()      (node, 3) of one state, after a check that the state has the first one's cells
    array()       one array of one state
    place()       file and state for messages

    Attributes
    ----------
    files, time, problems
        As in `Run`.
    """

    files: tuple[Path, ...]
    time: NDArray[np.float64]
    problems: tuple[str, ...] = ()

    @abstractmethod
    def first(self) -> Grid: ...

    @abstractmethod
    def points(self, state: int) -> NDArray[np.floating]: ...

    @abstractmethod
    def array(self, kind: Place, name: str, state: int) -> NDArray[Any]: ...

    @abstractmethod
    def place(self, state: int) -> str: ...

    def file_of(self, state: int) -> Path:
        """The file that holds a state."""
        return self.files[0]

    def close(self) -> None:  # noqa: B027 - most sources hold nothing open
        """Let go of files."""


class WholeStates(GridSource):
    """States whose mesh and arrays are read at once by `read`; the first and the last one read are kept."""

    _first: Grid | None = None
    _kept: tuple[int, Grid] | None = None

    @abstractmethod
    def read(self, state: int) -> Grid: ...

    def first(self) -> Grid:
        if self._first is None:
            self._first = self.read(0)
            self._first.check(self.place(0))
        return self._first

    def _state(self, state: int) -> Grid:
        if self._kept is None or self._kept[0] != state:
            grid, first = self.read(state), self.first()
            grid.check(self.place(state))
            parts = ("types", "offsets", "connectivity")
            same = len(grid.points) == len(first.points)
            if not same or not all(np.array_equal(getattr(grid, part), getattr(first, part)) for part in parts):
                raise ReadError(
                    f"{self.place(state)}: holds {len(grid.points)} points and {len(grid.types)} cells, the first state "
                    f"{len(first.points)} and {len(first.types)}, or joins them otherwise; "
                    "the mesh changed during the run, which is not supported"
                )
            missing = [n for n in first.point_data if n not in grid.point_data]
            missing += [n for n in first.cell_data if n not in grid.cell_data]
            if missing:
                raise ReadError(
                    f"{self.place(state)}: lacks the array {missing[0]!r} of the first state; it is cut short, or its "
                    "output changed during the run, which is not supported"
                )
            numbers = [n for n, v in first.point_data.items() if n.lower() in NODE_IDS and v.ndim == 1]
            if other := next((n for n in numbers if not np.array_equal(grid.point_data[n], first.point_data[n])), None):
                raise ReadError(
                    f"{self.place(state)}: numbers its nodes otherwise than the first state ({other}); expected one order "
                    "of nodes in all states"
                )
            self._kept = (state, grid)
        return self._kept[1]

    def points(self, state: int) -> NDArray[np.floating]:
        return self._state(state).points

    def array(self, kind: Place, name: str, state: int) -> NDArray[Any]:
        grid = self._state(state)
        return (grid.point_data if kind == "point" else grid.cell_data)[name]

    def close(self) -> None:
        self._kept = None
