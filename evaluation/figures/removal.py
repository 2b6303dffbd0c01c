"""Which elements are gone: predicted probability beside the truth, and how often it is right."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evaluation.comparison.elements import HALF, OnElements, RemovalScore
from evaluation.drawing.style import Sheet
from evaluation.figures.kind import Columns, Kind

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation


@dataclass(frozen=True)
class RemovedElements:
    """scores: model -> one a run; of the run `drawn`: position (node, 3), m, gone (face,), probability (face,) at the end."""

    runs: tuple[str, ...]
    scores: Mapping[str, tuple[RemovalScore, ...]]
    drawn: str
    model: str
    position: NDArray[np.float64]
    faces: NDArray[np.integer]
    gone: NDArray[np.bool_]
    probability: NDArray[np.floating]

    def numbers(self) -> Columns:
        columns: dict[str, list[object]] = {
            "run": list(self.runs), "removed_at_the_end": [s.removed for s in next(iter(self.scores.values()))],
        }  # fmt: skip
        for model, scores in self.scores.items():
            columns[f"{model} expected_at_the_end"] = [s.expected for s in scores]
            columns[f"{model} precision"] = [s.right / s.called if s.called else None for s in scores]
            columns[f"{model} recall"] = [s.right / s.gone if s.gone else None for s in scores]
        return columns

    def draw(self, sheet: Sheet) -> Figure:
        from evaluation.drawing.pictures import PIXELS_PER_CM
        from evaluation.drawing.rendering import choose_view, render

        figure, axes = sheet.panels(2, height=5.6)
        width = round(sheet.width * PIXELS_PER_CM / (1 if sheet.narrow else 2))
        view = choose_view([self.position], self.faces)
        for ax, values, title in zip(
            axes,
            (self.gone.astype(float), self.probability),
            (f"{self.drawn}: removed at the end", f"{self.model}: probability"),
            strict=True,
        ):
            ax.imshow(render(self.position, self.faces, view, values, (0.0, 1.0), "inferno_r", width))
            ax.set_axis_off()
            ax.set_title(title, fontsize=8)
        return figure

    def caption(self) -> str:
        told = []
        for model, scores in self.scores.items():
            right, called, gone = (sum(getattr(s, n) for s in scores) for n in ("right", "called", "gone"))
            precision = f"{right / called:.2f}" if called else "not defined, since none is called removed"
            told.append(
                f"{model}: precision {precision}, recall {right / gone:.2f}" if gone else f"{model}: none is gone"
            )
        return (
            f"Elements that are gone, in the test run that loses most, on the undeformed structure, and the probability "
            f"predicted for them. Over elements and states of all test runs, with {HALF:g} as the limit: {'; '.join(told)}. "
            f"Precision is the share of those called removed that are, recall the share of those removed that are called so."
        )


def select(evaluation: Evaluation) -> RemovedElements | None:
    from evaluation.drawing.rendering import rendering_problem

    reference = evaluation.reference
    if reference.alive is None or rendering_problem() is not None:
        return None
    scores = {}
    for entry in evaluation.leaders:
        found = [r.elements[entry.keys[0]] for r in evaluation.runs if entry.keys[0] in r.elements]
        removal = tuple(f.removal for f in found if f.removal is not None)
        if removal and len(removal) == len(evaluation.runs):
            scores[entry.label] = removal
    if not scores:
        return None
    entry = next(e for e in evaluation.leaders if e.label in scores)
    place = int(np.argmax([s.removed for s in scores[entry.label]]))
    run, predictor = evaluation.split.test[place], evaluation.predictor(entry)
    if not isinstance(predictor, OnElements):
        return None
    probability = predictor.removal(reference.parameters[run], reference.time)
    if probability is None:
        return None
    return RemovedElements(
        evaluation.test_names, scores, reference.runs[run], entry.label, reference.position_of(run), reference.faces,
        ~reference.alive(run)[-1], probability[-1],
    )  # fmt: skip


FIGURE = Kind("removal", "Elements that are gone", select, raster=True)
