"""Numbers by formula: predicted against true, with their bands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from evaluation.comparison.beside import SHARE, Beside
from evaluation.drawing.style import FAINT, Sheet, readable, span
from evaluation.figures.kind import Columns, Kind

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation

_SHOWN = 6


@dataclass(frozen=True)
class NumbersFigure:
    """The numbers of all test runs."""

    beside: Beside

    def numbers(self) -> Columns:
        columns: dict[str, list[object]] = {"run": list(self.beside.runs)}
        for number in self.beside.numbers:
            columns[f"{number.name} ({number.unit})"] = list(number.truth)
            for model, values in number.predictions.items():
                columns[f"{model} {number.name} ({number.unit})"] = list(values)
        return columns

    def draw(self, sheet: Sheet) -> Figure:
        from matplotlib.ticker import MaxNLocator

        shown = self.beside.numbers[:_SHOWN]
        figure, axes = sheet.panels(len(shown), height=5.8, columns=min(3, len(shown)))
        for ax, number in zip(axes, shown, strict=True):
            every = np.concatenate([number.truth, *number.predictions.values()])
            scaled, unit = readable(every, number.unit)
            largest = int(np.nanargmax(np.abs(every)))
            factor = float(scaled[largest] / every[largest]) if every[largest] else 1.0
            low, high = float(np.nanmin(scaled)), float(np.nanmax(scaled))
            ax.plot([low, high], [low, high], color=FAINT, linewidth=0.9)
            for model, values in number.predictions.items():
                style = sheet.style(model)
                width = number.half_width[model] * factor
                ax.errorbar(
                    number.truth * factor, values * factor, yerr=None if not np.isfinite(width) else width,
                    linestyle="none", marker=style.marker, color=style.colour, markersize=4.5, markeredgewidth=0,
                    elinewidth=0.7, alpha=0.85, label=model,
                )  # fmt: skip
            ax.xaxis.set_major_locator(MaxNLocator(4))
            ax.set_title(number.name.replace("_", " "))
            ax.set_xlabel(span("true", unit))
            ax.set_ylabel(span("predicted", unit))
        sheet.legend(figure, axes[0])
        return figure

    def caption(self) -> str:
        said = []
        for number in self.beside.numbers[:_SHOWN]:
            best = min(number.predictions, key=lambda m, n=number: float(np.nanmean(n.errors(m))))  # type: ignore[misc]
            (error,), unit = readable(np.array([float(np.nanmean(number.errors(best)))]), number.unit)
            covered = number.covered(best)
            band = "" if covered != covered else f", {100 * covered:.0f} % within the band"
            said.append(
                f"{span(number.name, '')} = {number.text}: {best} misses it by {error:.3g} {unit} on average{band}"
            )
        return (
            f"Numbers by formula of every test run, predicted against true. {'; '.join(said)}. Lines: the band that should hold "
            f"{100 * SHARE:.0f} % of the runs, from errors on runs left out in training."
        )


def select(evaluation: Evaluation) -> NumbersFigure | None:
    found = evaluation.beside
    return None if found is None or not found.numbers else NumbersFigure(found)


FIGURE = Kind("numbers", "Numbers by formula", select)
