"""Where on the structure the models are wrong: mean error of every node over test runs and time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evaluation.drawing.style import CM, Sheet, look
from evaluation.figures.kind import Columns, Kind

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation

_LISTED = 100
_SHOWN = 4


@dataclass(frozen=True)
class ErrorMap:
    """errors: model -> (node,) m, NaN for a node that is never there; drawn on the undeformed mesh."""

    position: NDArray[np.float64]
    faces: NDArray[np.integer]
    node_id: NDArray[np.integer]
    errors: Mapping[str, NDArray[np.float64]]

    def numbers(self) -> Columns:
        first = np.nan_to_num(next(iter(self.errors.values())), nan=-1.0)
        worst = np.argsort(-first, kind="stable")[:_LISTED]
        columns: dict[str, list[object]] = {"node": [int(n) for n in self.node_id[worst]]}
        for axis, name in enumerate("xyz"):
            columns[f"{name}_m"] = list(self.position[worst, axis])
        for model, errors in self.errors.items():
            columns[f"{model} mean_error_cm"] = list(errors[worst] * CM)
        return columns

    def draw(self, sheet: Sheet) -> Figure:
        from evaluation.drawing.pictures import ERROR, PIXELS_PER_CM
        from evaluation.drawing.rendering import choose_view, render

        with look():
            columns = min(2, len(self.errors))
            figure, axes = sheet.panels(len(self.errors), height=5.2, columns=columns)
        width = round(sheet.width * PIXELS_PER_CM / (1 if sheet.narrow else columns))
        view = choose_view([self.position], self.faces)
        top = max(float(np.nanmax(e)) for e in self.errors.values()) * CM
        for ax, (model, errors) in zip(axes, self.errors.items(), strict=True):
            worst = int(np.nanargmax(errors))
            picture = render(
                self.position, self.faces, view, errors * CM, (0.0, top), ERROR, width, marked=np.array([worst]),
                marker_colour="#0072B2", marker_size=max(4.0, 16 * width / 760),
            )  # fmt: skip
            ax.imshow(picture, interpolation="antialiased")
            ax.set_axis_off()
            ax.set_title(f"{model}   worst node {int(self.node_id[worst])}: {errors[worst] * CM:.2f} cm", fontsize=8)
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        bar = figure.colorbar(
            ScalarMappable(Normalize(0, top), ERROR), ax=axes, orientation="horizontal", shrink=0.5, aspect=45, pad=0.02
        )
        bar.set_label("mean node error over test runs and time (cm)")
        bar.outline.set_visible(False)
        return figure

    def caption(self) -> str:
        model, errors = next(iter(self.errors.items()))
        worst, median = int(np.nanargmax(errors)), float(np.nanmedian(errors))
        return (
            f"Mean error of every node over all test runs and times, on the undeformed structure and in one "
            f"scale; the blue "
            f"dot is the worst node. With {model} that is node {int(self.node_id[worst])} with "
            f"{errors[worst] * CM:.2f} cm, "
            f"{errors[worst] / median if median > 0 else float('nan'):.1f} times the median of all nodes. Dark "
            f"places are "
            f"where a prediction should not be read off."
        )


def select(evaluation: Evaluation) -> ErrorMap | None:
    from evaluation.drawing.rendering import rendering_problem

    if rendering_problem() is not None:
        return None
    return ErrorMap(
        evaluation.reference.position,
        evaluation.reference.faces,
        evaluation.reference.node_id,
        {e.label: evaluation.scores[e.label].node_mean for e in evaluation.leaders[:_SHOWN]},
    )


FIGURE = Kind("map", "Where on the structure the models are wrong", select, raster=True)
