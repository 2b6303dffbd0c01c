"""Elements that are dead in every state of a run: solvers keep them in their files, and no dataset needs them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crashkit.ingestion.structure import Structure
from crashkit.readers.base import Run, RunMesh
from crashkit.readers.checks import reading
from data_schema.blocks import split_states

Flags = NDArray[np.bool_]
Rows = NDArray[np.int64]


@dataclass(frozen=True)
class Dead:
    """Elements by (part number, element number), each (k, 2)."""

    faces: Rows
    cells: Rows

    def __bool__(self) -> bool:
        return bool(len(self.faces) or len(self.cells))

    def both(self, other: Dead) -> Dead:
        """The elements that are in both."""
        return Dead(self.faces[_among(self.faces, other.faces)], self.cells[_among(self.cells, other.cells)])

    def outside(self, structure: Structure) -> Dead:
        """The elements that are not in `structure`."""
        number = np.array([part.id for part in structure.parts], np.int64)
        faces = np.column_stack([number[structure.face_part], structure.face_id])
        cells = np.column_stack([number[structure.cell_part], structure.cell_id])
        return Dead(self.faces[~_among(self.faces, faces)], self.cells[~_among(self.cells, cells)])

    def of(self, mesh: RunMesh) -> tuple[Flags, Flags]:
        """Which faces and cells of `mesh` they are."""
        faces, cells = _rows(mesh)
        return _among(faces, self.faces), _among(cells, self.cells)


def never_alive(run: Run) -> Dead | None:
    """The elements of `run` that live in no state; None where all live in the first one, which is nearly always the case."""
    first = _alive(run, 0, 1)
    if all(flags is None or flags.all() for flags in first):
        return None
    ever = [None if flags is None else flags[0].copy() for flags in first]
    for begin, end in split_states(len(run.time), len(run.mesh.face_nodes) + len(run.mesh.cell_nodes)):
        for k, flags in enumerate(_alive(run, begin, end)):
            whole = ever[k]
            if whole is not None and flags is not None:
                whole |= flags.any(axis=0)
    faces, cells = _rows(run.mesh)
    return Dead(
        faces[:0] if ever[0] is None else faces[~ever[0]],
        cells[:0] if ever[1] is None else cells[~ever[1]],
    )


def lives_at_start(run: Run, structure: Structure) -> bool:
    """Whether anything of `structure` lives in the first state of the run it was made from."""
    shells, cells = _alive(run, 0, 1)
    source = structure.face_source
    return bool(
        (shells is None and (source >= 0).any())
        or (cells is None and (len(structure.cell_source) or (source < 0).any()))
        or (shells is not None and shells[0, source[source >= 0]].any())
        or (cells is not None and cells[0, structure.cell_source].any())
    )


def _alive(run: Run, first: int, last: int) -> tuple[Flags | None, Flags | None]:
    with reading(f"run {run.name}, life of elements in states {first} to {last - 1}"):
        return run.alive(first, last), run.alive_cells(first, last)


def _rows(mesh: RunMesh) -> tuple[Rows, Rows]:
    number = np.array([part.id for part in mesh.parts], np.int64)
    return (
        np.column_stack([number[mesh.face_part], mesh.face_id]).astype(np.int64),
        np.column_stack([number[mesh.cell_part], mesh.cell_id]).astype(np.int64),
    )


def _among(rows: Rows, others: Rows) -> Flags:
    """Which of `rows` (n, 2) stand in `others` (m, 2) as well."""
    if not len(rows) or not len(others):
        return np.zeros(len(rows), bool)
    _, inverse = np.unique(np.concatenate([rows, others]), axis=0, return_inverse=True)
    numbers = inverse.reshape(-1)
    return np.isin(numbers[: len(rows)], numbers[len(rows) :])
