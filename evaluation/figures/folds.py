"""Two training runs beside each other that differ by more than their distance in the design space explains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evaluation.drawing.style import CM, MS, Sheet, called
from evaluation.figures.kind import Columns, Kind
from evaluation.measures.distance import masked_mean

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.predictor import ComparedModel
    from evaluation.comparison.reference import Reference
    from evaluation.comparison.result import Evaluation

_LISTED = 20


@dataclass(frozen=True)
class Fold:
    """A run that was predicted badly when left out, and the nearest of the runs that trained, in their last state.

    Attributes
    ----------
    model
        Which said so.
    pair
        Names of the two runs; parameters of both in words.
    first, second
        (node, 3) displacements, m; position (node, 3), m; faces (face, corner).
    hard
        Run -> error when left out, m, and how many times the typical one it is.
    """

    model: str
    pair: tuple[str, str]
    told: tuple[str, str]
    time: float
    position: NDArray[np.float64]
    faces: NDArray[np.integer]
    alive: NDArray[np.bool_] | None
    first: NDArray[np.floating]
    second: NDArray[np.floating]
    hard: dict[str, tuple[float, float]]

    def numbers(self) -> Columns:
        shown = list(self.hard.items())[:_LISTED]
        return {
            "run": [name for name, _ in shown],
            "error_left_out_cm": [error * CM for _, (error, _) in shown],
            "times_typical": [times for _, (_, times) in shown],
        }

    def draw(self, sheet: Sheet) -> Figure:
        from evaluation.drawing.pictures import comparison_picture

        return comparison_picture(
            self.position, self.faces, self.first, self.second, sheet=sheet, alive=self.alive,
            titles=(called(self.pair[0]), called(self.pair[1]), "distance of the two"),
        )  # fmt: skip

    def caption(self) -> str:
        apart = float(masked_mean(np.linalg.norm(self.second - self.first, axis=-1))) * CM
        error, times = self.hard[self.pair[0]]
        return (
            f"{called(self.pair[0])} ({self.told[0]}) and the nearest training run, {called(self.pair[1])} "
            f"({self.told[1]}), at {self.time * MS:.1f} ms: {apart:.1f} cm apart on average. {self.model} was wrong about "
            f"the first by {error * CM:.2f} cm when it was left out, {times:.1f} times the typical error, and about runs "
            f"near it, too: here the structure may fold one way or another, or a run is faulty. {len(self.hard)} training "
            "runs lie at such places; predictions near them get a wider band and a warning."
        )


def pair(reference: Reference, models: Sequence[ComparedModel]) -> tuple[ComparedModel, int, int] | None:
    """A model, the worst of its runs that neighbours contradict, and the nearest training run; None without any."""
    model = next((m for m in models if m.hard), None)
    if model is None or len(model.fitted_runs) < 2:
        return None
    first = reference.index([next(iter(model.hard))])[0]
    others = [k for k in reference.index(model.fitted_runs) if k != first]
    span = np.ptp(reference.parameters[[first, *others]], axis=0)
    moves = span > 0
    away = (reference.parameters[others] - reference.parameters[first])[:, moves] / span[moves]
    return model, first, others[int(np.square(away).sum(axis=1).argmin())]


def select(evaluation: Evaluation) -> Fold | None:
    from evaluation.drawing.rendering import rendering_problem

    reference = evaluation.reference
    found = pair(reference, evaluation.models)
    if found is None or rendering_problem() is not None:
        return None
    model, first, second = found

    def at_the_end(run: int) -> NDArray[np.floating]:
        seen = evaluation.last_states.get(run)
        return reference.displacement(run)[-1] if seen is None else seen

    return Fold(
        model.name,
        (reference.runs[first], reference.runs[second]),
        (_told(evaluation, first), _told(evaluation, second)),
        float(reference.time[-1]),
        reference.position_of(first),
        reference.faces,
        None if reference.alive is None else reference.alive(first)[-1],
        at_the_end(first),
        at_the_end(second),
        dict(model.hard),
    )


def _told(evaluation: Evaluation, run: int) -> str:
    reference = evaluation.reference
    return ", ".join(
        f"{name.replace('_', ' ')} {value / factor:.4g}" + (f" {unit}" if unit != "1" else "")
        for name, value, (unit, factor) in zip(
            reference.parameter_names, reference.parameters[run], reference.written, strict=True
        )
    )


FIGURE = Kind("folds", "Where neighbouring runs go different ways", select, raster=True)
