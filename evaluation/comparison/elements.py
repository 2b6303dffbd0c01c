"""How well a model tells results on elements, and which elements are gone, of one test run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from evaluation.comparison.reference import Reference

# An element is called removed above this probability.
HALF = 0.5


@runtime_checkable
class OnElements(Protocol):
    """A predictor that also says something of elements, on the full mesh."""

    def element_fields(
        self, parameters: NDArray[np.float64], time: NDArray[np.float64]
    ) -> Mapping[str, NDArray[np.float32]]:
        """Results by name, (state, face); empty where none was learnt."""

    def removal(self, parameters: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float32] | None:
        """(state, face) probability that an element is gone; None where nothing is said."""


@dataclass(frozen=True)
class FieldScore:
    """One result on living elements of one run.

    Attributes
    ----------
    error, size
        (part,) mean absolute error, and mean absolute value of the truth, over elements and states.
    of_faces
        (face,) mean absolute error over the states in which the element is there; NaN where it never is.
    """

    unit: str
    error: NDArray[np.float64]
    size: NDArray[np.float64]
    of_faces: NDArray[np.float64]


@dataclass(frozen=True)
class RemovalScore:
    """Elements and states of one run: called removed and gone, called removed, gone; and the last state's counts.

    Attributes
    ----------
    expected, removed
        Elements gone at the end: the sum of the probabilities, and the true number.
    """

    right: int
    called: int
    gone: int
    expected: float
    removed: int


@dataclass(frozen=True)
class ElementScores:
    """What a predictor says of the elements of one run."""

    fields: Mapping[str, FieldScore]
    removal: RemovalScore | None = None


def score_elements(reference: Reference, predictor: object, run: int) -> ElementScores | None:
    """Scores of `predictor` on run number `run`; None where it says nothing of elements that the data know."""
    if not isinstance(predictor, OnElements):
        return None
    parameters, time = reference.parameters[run], reference.time
    alive = None if reference.alive is None else reference.alive(run)
    said = predictor.element_fields(parameters, time)
    known = reference.fields(run) if said and reference.fields is not None else {}
    fields = {
        name: _field(reference, values, known[name].values, known[name].unit, alive)
        for name, values in said.items()
        if name in known and known[name].values.shape == values.shape
    }
    probability = None if alive is None else predictor.removal(parameters, time)
    removal = None if alive is None or probability is None else _removal(probability, ~alive)
    return ElementScores(fields, removal) if fields or removal is not None else None


def _field(
    reference: Reference, said: NDArray[np.floating], truth: NDArray[np.floating], unit: str,
    alive: NDArray[np.bool_] | None,
) -> FieldScore:  # fmt: skip
    there = np.isfinite(truth) if alive is None else np.isfinite(truth) & alive
    off, size = (
        np.where(there, np.abs(v), 0.0).sum(axis=0) for v in (np.nan_to_num(said - truth), np.nan_to_num(truth))
    )
    count, part, parts = there.sum(axis=0), np.asarray(reference.face_part), len(reference.part_names)
    total = np.bincount(part, count, parts)

    def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        out = np.full(parts, np.nan)
        np.divide(np.bincount(part, values, parts), total, out=out, where=total > 0)
        return out

    of_faces = np.divide(off, count, out=np.full(len(off), np.nan), where=count > 0)
    return FieldScore(unit, mean(off), mean(size), of_faces)


def _removal(probability: NDArray[np.floating], gone: NDArray[np.bool_]) -> RemovalScore:
    called = probability > HALF
    return RemovalScore(
        int((called & gone).sum()),
        int(called.sum()),
        int(gone.sum()),
        float(probability[-1].sum()),
        int(gone[-1].sum()),
    )
