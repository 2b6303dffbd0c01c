"""Normalised singular values of the training runs, on the full mesh and on every coarse level."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evaluation.drawing.style import INK, Sheet
from evaluation.figures.kind import Columns, Kind

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation

_SHADES = (INK, "#0072B2", "#56B4E9", "#009E73", "#E69F00", "#CC79A7")


@dataclass(frozen=True)
class SingularValues:
    """values: number of nodes of a mesh -> (mode,) singular values, largest first, any unit; runs: of which runs."""

    values: Mapping[int, NDArray[np.float64]]
    runs: str = "runs"
    count: int = 50

    def numbers(self) -> Columns:
        length = max(min(len(v), self.count) for v in self.values.values())
        columns: dict[str, list[float]] = {"mode": list(range(1, length + 1))}
        for nodes, values in self.values.items():
            row = (values / values[0])[: self.count]
            columns[f"normalised_{nodes}_nodes"] = [*row, *[float("nan")] * (length - len(row))]
        return columns

    def draw(self, sheet: Sheet) -> Figure:
        figure, (ax,) = sheet.panels(1, height=6.5)
        for k, (nodes, values) in enumerate(self.values.items()):
            row = (values / values[0])[: self.count]
            ax.semilogy(
                np.arange(1, len(row) + 1), row, color=_SHADES[k % len(_SHADES)], marker="o", markersize=2.5,
                linewidth=0.9, label=f"{nodes} nodes",
            )  # fmt: skip
        ax.set_xlabel("mode")
        ax.set_ylabel("singular value / the first")
        ax.set_xlim(0, None)
        ax.legend()
        return figure

    def caption(self) -> str:
        full = next(iter(self.values.values()))
        row = full / full[0]
        below = np.flatnonzero(row < 0.01)
        reach = f"number {below[0] + 1} is the first below 1 %" if below.size else f"none of {len(row)} is below 1 %"
        fourth = f"The fourth is {row[3]:.3f} of the first; " if len(row) > 3 else ""
        coarse = (
            " Where the curve of a coarse mesh lies on that of the full mesh, it carries the same motion."
            if len(self.values) > 1
            else ""
        )
        return (
            f"Singular values of the displacements of all {self.runs}, divided by the first. {fourth}{reach}. "
            f"The slower "
            f"they fall, the more modes a linear reduction needs, and the more a nonlinear one may win.{coarse}"
        )


def select(evaluation: Evaluation) -> SingularValues:
    return SingularValues(
        {evaluation.reference.level_nodes(level): pod.singular_values for level, pod in evaluation.pods.items()},
        "training runs",
    )


FIGURE = Kind("singular_values", "Singular values of the data", select)
