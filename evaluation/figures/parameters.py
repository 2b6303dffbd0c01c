"""Error of every test run against each design parameter: where in the design space a model fails."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evaluation.drawing.style import CM, FAINT, Sheet, leading, readable, span
from evaluation.figures.kind import Columns, Kind

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation

_SHOWN = 6


@dataclass(frozen=True)
class ErrorOverParameters:
    """values (run, parameter), errors: model -> (run,) m, ranges (parameter, 2) of the training runs; `shown` are drawn."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    runs: tuple[str, ...]
    values: NDArray[np.float64]
    ranges: NDArray[np.float64]
    errors: Mapping[str, NDArray[np.float64]]
    shown: tuple[str, ...]

    def numbers(self) -> Columns:
        columns: dict[str, list[object]] = {"run": list(self.runs)}
        for k, (name, unit) in enumerate(zip(self.names, self.units, strict=True)):
            columns[f"{name} ({unit})"] = list(self.values[:, k])
        for model, errors in self.errors.items():
            columns[f"{model} mean_node_error_cm"] = list(errors * CM)
        return columns

    def draw(self, sheet: Sheet) -> Figure:
        figure, axes = sheet.panels(len(self.names), height=5.8, columns=min(3, len(self.names)), share_y=True)
        for k, ax in enumerate(axes):
            values, unit = readable(self.values[:, k], self.units[k])
            ranges, _ = readable(np.append(self.ranges[k], np.abs(self.values[:, k]).max()), self.units[k])
            order = np.argsort(values)
            for model in self.shown:
                style = sheet.style(model)
                ax.plot(
                    values[order], self.errors[model][order] * CM, linestyle="none", marker=style.marker,
                    color=style.colour, markersize=4.5, alpha=0.85, label=model, markeredgewidth=0,
                )  # fmt: skip
            for edge in ranges[:2]:
                ax.axvline(edge, color=FAINT, linewidth=0.8, linestyle=":")
            ax.set_xlabel(span(self.names[k], unit))
            ax.set_ylim(bottom=0)
        axes[0].set_ylabel("mean node error (cm)")
        sheet.legend(figure, axes[0])
        return figure

    def caption(self) -> str:
        best = min(self.errors, key=lambda m: float(np.nanmean(self.errors[m])))
        trend, name = "", ""
        if len(self.runs) >= 5:
            ranks = _ranks(self.errors[best])
            links = [
                max((abs(_correlation(_ranks(v), ranks)), side) for side, v in (("", x), ("size of ", np.abs(x))))
                for x in self.values.T
            ]
            k = int(np.argmax([link[0] for link in links]))
            strength, side = links[k]
            name = self.names[k].replace("_", " ")
            trend = (
                f" The error of {best} follows the {side}{name} most closely (rank correlation {strength:.2f} in size)."
            )
        return (
            f"Every point is a test run. Points high above the others mark a corner of the design space where "
            f"the model is "
            f"not to be trusted; dotted lines are the range of the training runs, and outside it nothing is "
            f"known.{trend}{leading(len(self.shown), len(self.errors), _SHOWN)}"
        )


def _ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.argsort(np.argsort(values)).astype(np.float64)


def _correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.corrcoef(a, b)[0, 1]) if a.std() > 0 and b.std() > 0 else 0.0


def select(evaluation: Evaluation) -> ErrorOverParameters | None:
    reference = evaluation.reference
    if not reference.parameter_names:
        return None
    test, train = list(evaluation.split.test), list(evaluation.split.train)
    seen = reference.parameters[train] if train else reference.parameters
    return ErrorOverParameters(
        reference.parameter_names,
        reference.parameter_units,
        evaluation.test_names,
        reference.parameters[test],
        np.stack([seen.min(axis=0), seen.max(axis=0)], axis=1),
        {e.label: evaluation.scores[e.label].of_runs for e in evaluation.entries},
        tuple(e.label for e in evaluation.leaders[:_SHOWN]),
    )


FIGURE = Kind("parameters", "Where in the design space the models fail", select)
