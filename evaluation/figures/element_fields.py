"""Results on elements, such as plastic strain: truth, prediction and error at the end of a run, and the error by part."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evaluation.comparison.elements import OnElements
from evaluation.drawing.style import Sheet
from evaluation.figures.kind import Columns, Kind

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation


@dataclass(frozen=True)
class ElementResults:
    """One result on elements.

    Attributes
    ----------
    parts
        (part,) names; `size` (part,) the mean absolute truth, `errors` model -> (part,) mean absolute error.
    run
        The run that is drawn: its position (node, 3), m, and at the end truth, prediction (face,), and what lives.
    mean
        Model -> mean absolute error over elements that live, states and test runs; `mean_size` that of the truth.
    """

    name: str
    unit: str
    parts: tuple[str, ...]
    size: NDArray[np.float64]
    errors: Mapping[str, NDArray[np.float64]]
    mean: Mapping[str, float]
    run: str
    model: str
    position: NDArray[np.float64]
    faces: NDArray[np.integer]
    alive: NDArray[np.bool_] | None
    truth: NDArray[np.floating]
    prediction: NDArray[np.floating]

    def _unit(self) -> str:
        return "" if self.unit in ("", "1") else f" {self.unit}"

    def numbers(self) -> Columns:
        columns: dict[str, list[object]] = {"part": list(self.parts), f"mean_{self.name}": list(self.size)}
        for model, errors in self.errors.items():
            columns[f"{model} mean_absolute_error"] = list(errors)
        return columns

    def draw(self, sheet: Sheet) -> Figure:
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        from evaluation.drawing.pictures import DISPLACEMENT, ERROR, PIXELS_PER_CM
        from evaluation.drawing.rendering import choose_view, render

        figure, axes = sheet.panels(3, height=5.2)
        width = round(sheet.width * PIXELS_PER_CM / (1 if sheet.narrow else 3))
        view = choose_view([self.position], self.faces)
        top = float(np.nanquantile(np.abs(self.truth), 0.995)) or 1.0
        off = np.abs(self.prediction - self.truth)
        shown = (
            (self.truth, "truth", DISPLACEMENT),
            (self.prediction, self.model, DISPLACEMENT),
            (off, "error", ERROR),
        )
        for ax, (values, title, colours) in zip(axes, shown, strict=True):
            picture = render(self.position, self.faces, view, values, (0.0, top), colours, width, alive=self.alive)
            ax.imshow(picture, interpolation="antialiased")
            ax.set_axis_off()
            ax.set_title(title, fontsize=8)
            bar = figure.colorbar(
                ScalarMappable(Normalize(0, top), colours), ax=ax, orientation="horizontal", shrink=0.7, pad=0.02
            )
            bar.outline.set_visible(False)
        return figure

    def caption(self) -> str:
        known = {model: errors for model, errors in self.errors.items() if np.isfinite(errors).any()}
        told = "; ".join(f"{model} {error:.3g}{self._unit()}" for model, error in self.mean.items())
        model, errors = next(iter(known.items()))
        worst = int(np.nanargmax(errors))
        return (
            f"{self.name.replace('_', ' ').capitalize()} at the end of {self.run}, a test run in the middle by its error: "
            f"truth, prediction and their difference in one scale, on the undeformed structure without what is gone. Mean "
            f"absolute error over living elements, states and test runs: {told}. By part, {model} is worst in "
            f"{self.parts[worst]}: {errors[worst]:.3g}{self._unit()}, where the truth is {self.size[worst]:.3g} on average."
        )


def select(evaluation: Evaluation) -> ElementResults | None:
    from evaluation.drawing.rendering import rendering_problem

    reference = evaluation.reference
    if reference.fields is None or rendering_problem() is not None:
        return None
    found = {
        e.label: [r.elements[e.keys[0]].fields for r in evaluation.runs if e.keys[0] in r.elements]
        for e in evaluation.leaders
    }
    names = [name for fields in found.values() for of_run in fields for name in of_run]
    if not names:
        return None
    name = names[0]
    scores = {
        label: [f[name] for f in fields]
        for label, fields in found.items()
        if len(fields) == len(evaluation.runs) and all(name in f for f in fields)
    }
    if not scores:
        return None
    entry = next(e for e in evaluation.leaders if e.label in scores)
    of_runs = {label: np.array([np.nanmean(s.of_faces) for s in known]) for label, known in scores.items()}
    place = int(np.argsort(of_runs[entry.label])[len(evaluation.runs) // 2])
    run, predictor = evaluation.split.test[place], evaluation.predictor(entry)
    if not isinstance(predictor, OnElements):
        return None
    said = predictor.element_fields(reference.parameters[run], reference.time)[name][-1]
    first = scores[entry.label]
    return ElementResults(
        name, first[0].unit, reference.part_names, np.nanmean([s.size for s in first], axis=0),
        {label: np.nanmean([s.error for s in known], axis=0) for label, known in scores.items()},
        {label: float(values.mean()) for label, values in of_runs.items()},
        reference.runs[run], entry.label, reference.position_of(run), reference.faces,
        None if reference.alive is None else reference.alive(run)[-1],
        reference.fields(run)[name].values[-1], said,
    )  # fmt: skip


FIGURE = Kind("element_fields", "Results on elements", select, raster=True)
