"""A run as the dataset keeps it: chosen nodes, faces and cells in the dataset's order, in SI units; read by states."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import ReadError
from crashkit.ingestion.structure import Structure
from crashkit.ingestion.survey import Field, cell_fields
from crashkit.readers.base import Run
from crashkit.readers.checks import reading
from data_schema.units import UnitSystem, UnknownUnits

Flags = NDArray[np.bool_]


class RunView:
    """`run` with the nodes, faces and cells of `structure`, whose `*_source` arrays point into the run's mesh."""

    def __init__(self, run: Run, structure: Structure, system: UnitSystem) -> None:
        self.run, self.structure, self.system = run, structure, system

    def displacement(self, first: int, last: int) -> NDArray[np.float32]:
        """(state, node, 3), m, of the states first <= state < last; may be the reader's own, so not to be written to."""
        with reading(f"run {self.run.name}, displacement of states {first} to {last - 1}"):
            values = self.run.displacement(first, last)
        self._expect(values, (last - first, len(self.run.mesh.position), 3), "displacement")
        return _scaled(_gather(values, self.structure.node), self.system.length)

    def alive(self, first: int, last: int) -> tuple[Flags | None, Flags | None]:
        """(state, face) and (state, cell), None where the run does not say; a skin face is alive while its solid is."""
        with reading(f"run {self.run.name}, life of elements in states {first} to {last - 1}"):
            shells, cells = self.run.alive(first, last), self.run.alive_cells(first, last)
        source = self.structure.face_source
        faces = None
        if shells is not None or cells is not None:
            faces = np.ones((last - first, len(source)), bool)
            if shells is not None:
                faces[:, source >= 0] = shells[:, source[source >= 0]]
            if cells is not None:
                faces[:, source < 0] = cells[:, -1 - source[source < 0]]
        return faces, None if cells is None else cells[:, self.structure.cell_source]

    def field(self, wanted: Field, first: int, last: int) -> NDArray[np.float32]:
        """(state, node | face | cell[, component]) in SI; NaN where the run has no value."""
        info, s = wanted.info, self.structure
        if info.location == "node":
            values = _gather(self._read(info.name, first, last), s.node)
        elif info.location == "cell":
            values = _gather(self._read(info.name, first, last), s.cell_source)
        else:
            values = self._on_faces(wanted, first, last)
        with contextlib.suppress(UnknownUnits):  # what is not known is kept as it is, and labelled so
            values = _scaled(values, self.system.factor(info.quantity))
        return values

    def field_rows(self, wanted: Field) -> int:
        """How many values of a state have to be held to read a field."""
        mesh = self.run.mesh
        count = {"node": len(mesh.position), "face": len(mesh.face_nodes), "cell": len(mesh.cell_nodes)}
        return max(count[wanted.info.location], len(self.structure.face_source))

    def _read(self, name: str, first: int, last: int) -> NDArray[np.float32]:
        with reading(f"run {self.run.name}, {name} of states {first} to {last - 1}"):
            values = self.run.field(name, first, last)
        mesh, info = self.run.mesh, self.run.fields[name]
        count = {"node": len(mesh.position), "face": len(mesh.face_nodes), "cell": len(mesh.cell_nodes)}[info.location]
        width = (info.components,) if info.components > 1 else ()
        self._expect(values, (last - first, count, *width), name)
        return values

    def _expect(self, values: NDArray[Any], shape: tuple[int, ...], name: str) -> None:
        if values.shape != shape:
            raise ReadError(
                f"run {self.run.name}: its reader gave {name} of shape {values.shape}, expected {shape}; the file is "
                "damaged, or the reader is at fault"
            )

    def _on_faces(self, wanted: Field, first: int, last: int) -> NDArray[np.float32]:
        """Values of shells, and on the skin of solids those of the solid behind."""
        source, name = self.structure.face_source, wanted.info.name
        width = (wanted.info.components,) if wanted.info.components > 1 else ()
        out = np.full((last - first, len(source), *width), np.nan, np.float32)
        shell = source >= 0
        if name in self.run.fields and shell.any():
            out[:, shell] = self._read(name, first, last)[:, source[shell]]
        for other in cell_fields(self.run, name) if not shell.all() else ():
            values = self._read(other, first, last)[:, -1 - source[~shell]]
            out[:, ~shell] = np.where(np.isnan(values), out[:, ~shell], values)
        return out


def gone_nodes(structure: Structure, faces: Flags | None, cells: Flags | None, states: int) -> Flags | None:
    """(state, node): nodes whose elements have all died; None where there are none."""
    if (faces is None or faces.all()) and (cells is None or cells.all()):
        return None
    kinds = [(structure.face_nodes, faces), (structure.cell_nodes, cells)]
    out = np.zeros((states, structure.n_nodes), bool)
    for state in range(states):
        if all(alive is None or alive[state].all() for _, alive in kinds):
            continue
        living = np.zeros(structure.n_nodes, bool)
        for nodes, alive in kinds:
            there = nodes if alive is None else nodes[alive[state]]
            living[there[there >= 0]] = True
        out[state] = ~living
    return out if out.any() else None


def _gather(values: NDArray[Any], places: NDArray[np.int64]) -> NDArray[np.float32]:
    """`values[:, places]` as float32, without copying where all are taken in order."""
    if len(places) != values.shape[1] or (places != np.arange(len(places))).any():
        values = values[:, places]
    return values.astype(np.float32, copy=False)


def _scaled(values: NDArray[np.float32], factor: float) -> NDArray[np.float32]:
    return values if factor == 1 else values * np.float32(factor)
