"""The worst run of the best model, at its worst time: truth, prediction and error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evaluation.drawing.style import CM, MS, Sheet, called
from evaluation.figures.kind import Columns, Kind
from evaluation.measures.distance import masked_mean

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation

_LISTED = 100


@dataclass(frozen=True)
class WorstState:
    """truth, prediction (node, 3) m of one state; alive (face,) bool or None; node_id (node,), part (node,) names."""

    model: str
    run: str
    time: float
    position: NDArray[np.float64]
    faces: NDArray[np.integer]
    alive: NDArray[np.bool_] | None
    truth: NDArray[np.floating]
    prediction: NDArray[np.floating]
    node_id: NDArray[np.integer]

    def _error(self) -> NDArray[np.float64]:
        return np.asarray(np.linalg.norm(self.prediction - self.truth, axis=-1).astype(np.float64))

    def numbers(self) -> Columns:
        error = self._error()
        worst = np.argsort(-np.nan_to_num(error, nan=-1.0), kind="stable")[:_LISTED]
        return {
            "node": [int(n) for n in self.node_id[worst]],
            **{f"true_{axis}_cm": list(self.truth[worst, k] * CM) for k, axis in enumerate("xyz")},
            **{f"predicted_{axis}_cm": list(self.prediction[worst, k] * CM) for k, axis in enumerate("xyz")},
            "error_cm": list(error[worst] * CM),
        }

    def draw(self, sheet: Sheet) -> Figure:
        from evaluation.drawing.pictures import comparison_picture

        return comparison_picture(
            self.position, self.faces, self.truth, self.prediction, self.model, sheet, alive=self.alive
        )

    def caption(self) -> str:
        error = self._error()
        node = int(np.nanargmax(error))
        return (
            f"The worst that {self.model}, the most accurate model, does: {called(self.run)} at {self.time * MS:.1f} "
            f"ms, with the "
            f"mean node error {float(masked_mean(error)) * CM:.2f} cm. Truth and prediction share one scale, and the "
            f"grey shadow behind the prediction is the truth. The largest error, {error[node] * CM:.2f} cm, is at node "
            f"{int(self.node_id[node])}. The numbers list the {min(_LISTED, len(error))} worst nodes."
        )


def select(evaluation: Evaluation) -> WorstState | None:
    from evaluation.drawing.rendering import rendering_problem

    if rendering_problem() is not None:
        return None
    reference = evaluation.reference
    best = evaluation.ranked[0]
    scores = evaluation.scores[best.label]
    number = int(np.nanargmax(scores.of_runs))
    run = evaluation.split.test[number]
    state = int(np.nanargmax(scores.e2[0, number]))
    return WorstState(
        best.label,
        reference.runs[run],
        float(reference.time[state]),
        reference.position_of(run),
        reference.faces,
        None if reference.alive is None else reference.alive(run)[state],
        reference.displacement(run)[state],
        evaluation.lifted(best, run, [state])[0],
        reference.node_id,
    )


FIGURE = Kind("worst", "The worst run at its worst time", select, raster=True)
