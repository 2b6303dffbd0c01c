"""Time histories that were learnt: predicted against true in a typical run, with band and rating."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from evaluation.comparison.beside import SHARE, Beside, CurveCompared
from evaluation.drawing.style import INK, MS, Sheet, readable, span
from evaluation.figures.kind import Columns, Kind
from evaluation.measures.curves import grade

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation

_SHOWN = 6


@dataclass(frozen=True)
class HistoriesFigure:
    """The histories of all test runs."""

    beside: Beside

    def typical(self, curve: CurveCompared) -> int:
        """The run whose error of the first model is the median."""
        errors = curve.errors(next(iter(curve.predictions)))
        order = np.argsort(np.where(np.isfinite(errors), errors, np.inf), kind="stable")
        return int(order[int(np.isfinite(errors).sum()) // 2])

    def numbers(self) -> Columns:
        columns: dict[str, list[object]] = {
            name: [] for name in ("channel", "unit", "run", "model", "mean_error", "rating")
        }
        for curve in self.beside.curves:
            for model in curve.predictions:
                errors, ratings = curve.errors(model), self.beside.ratings(curve, model)
                for run, error, rating in zip(self.beside.runs, errors, ratings, strict=True):
                    row = (curve.name, curve.unit, run, model, float(error), float(rating))
                    for name, value in zip(columns, row, strict=True):
                        columns[name].append(value)
        return columns

    def draw(self, sheet: Sheet) -> Figure:
        shown = self.beside.curves[:_SHOWN]
        figure, axes = sheet.panels(len(shown), height=5.2, columns=min(2, len(shown)))
        for ax, curve in zip(axes, shown, strict=True):
            run = self.typical(curve)
            truth, unit = readable(curve.truth[run], curve.unit)
            largest = int(np.nanargmax(np.abs(curve.truth[run])))
            factor = float(truth[largest] / curve.truth[run][largest]) if truth[largest] else 1.0
            time = curve.time * MS
            ax.plot(time, truth, color=INK, linewidth=2.0, label="truth")
            for model, values in curve.predictions.items():
                style, width = sheet.style(model), curve.half_width[model][run] * factor
                if np.isfinite(width).all():
                    said = values[run] * factor
                    ax.fill_between(time, said - width, said + width, color=style.colour, alpha=0.18, linewidth=0)
                ax.plot(time, values[run] * factor, color=style.colour, linestyle=style.line, label=model)
            ax.set_title(f"{curve.name.replace('_', ' ')}, {self.beside.runs[run]}")
            ax.set_xlabel("time (ms)")
            ax.set_ylabel(unit)
            ax.margins(x=0)
        sheet.legend(figure, axes[0])
        return figure

    def caption(self) -> str:
        said = []
        for curve in self.beside.curves[:_SHOWN]:
            model = next(iter(curve.predictions))
            ratings, covered = self.beside.ratings(curve, model), curve.covered(model)
            mean = float(np.nanmean(ratings)) if np.isfinite(ratings).any() else float("nan")
            rated = f"rated {mean:.2f} ({grade(mean)}) by {model}" if mean == mean else "not rated"
            band = "" if covered != covered else f", {100 * covered:.0f} % of the samples within the band"
            said.append(f"{span(curve.name, '')} {rated}{band}")
        return (
            f"Time histories in the run with the median error. ISO/TS 18571, mean over all test runs: {'; '.join(said)}. Shaded: "
            f"the band that should hold {100 * SHARE:.0f} % of the samples."
        )


def select(evaluation: Evaluation) -> HistoriesFigure | None:
    found = evaluation.beside
    return None if found is None or not found.curves else HistoriesFigure(found)


FIGURE = Kind("histories", "Time histories", select)
