"""How the runs cover the design space: a scatter matrix of the parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evaluation.drawing.style import Sheet, label_outer, look, readable, span
from evaluation.figures.kind import Columns, Kind

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation

_TRAIN, _TEST, _UNUSED = "#0072B2", "#D55E00", "#999999"


@dataclass(frozen=True)
class Coverage:
    """values (run, parameter); test and unused (run,) bool, all False for a dataset alone; all others are training runs."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    runs: tuple[str, ...]
    values: NDArray[np.float64]
    test: NDArray[np.bool_]
    unused: NDArray[np.bool_]

    @property
    def train(self) -> NDArray[np.bool_]:
        """(run,) bool"""
        return ~(self.test | self.unused)

    def numbers(self) -> Columns:
        columns: dict[str, list[object]] = {
            "run": list(self.runs),
            "role": [
                "test" if t else "not used" if u else "train" for t, u in zip(self.test, self.unused, strict=True)
            ],
        }
        for k, (name, unit) in enumerate(zip(self.names, self.units, strict=True)):
            columns[f"{name} ({unit})"] = list(self.values[:, k])
        return columns

    def draw(self, sheet: Sheet) -> Figure:
        from matplotlib.figure import Figure

        n = len(self.names)
        roles = [
            (chosen, label, colour, marker)
            for chosen, label, colour, marker in (
                (self.unused, "not used", _UNUSED, "."),
                (self.train, "train", _TRAIN, "o"),
                (self.test, "test", _TEST, "D"),
            )
            if chosen.any()
        ]
        columns, units = zip(*(readable(v, u) for v, u in zip(self.values.T, self.units, strict=True)), strict=True)
        labels = [span(name, unit) for name, unit in zip(self.names, units, strict=True)]
        if sheet.narrow:
            labels = [label.replace(" (", "\n(") for label in labels]
        side = min(sheet.width, 4.2 * n)
        with look():
            figure = Figure(figsize=(side / 2.54, side / 2.54), layout="constrained")
            grid = figure.subplots(n, n, squeeze=False)
        for i in range(n):
            for j in range(n):
                ax = grid[i, j]
                if i == j:
                    parts = [columns[i][chosen] for chosen, *_ in roles]
                    ax.hist(parts, bins=8, stacked=True, color=[colour for _, _, colour, _ in roles], rwidth=0.92)
                    ax.set_yticks([])
                    ax.grid(visible=False)
                elif j > i:
                    ax.remove()
                    continue
                else:
                    for chosen, _, colour, marker in roles:
                        ax.plot(
                            columns[j][chosen], columns[i][chosen], linestyle="none", marker=marker,
                            color=colour, markersize=3.2, markeredgewidth=0, alpha=0.8,
                        )  # fmt: skip
                    ax.margins(0.06)
                label_outer(ax, i, j, labels)
        if self.test.any():
            from matplotlib.lines import Line2D

            handles = [
                Line2D([], [], marker=marker, color=colour, linestyle="none", label=f"{label} ({int(chosen.sum())})")
                for chosen, label, colour, marker in roles
            ]
            figure.legend(handles=handles, loc="upper right", fontsize=8)
        return figure

    def caption(self) -> str:
        ranges = []
        for name, unit, column in zip(self.names, self.units, self.values.T, strict=True):
            values, shown = readable(column, unit)
            ranges.append(f"{span(name, '')} {values.min():.3g} to {values.max():.3g} {shown}".strip())
        outside = 0
        if self.test.any() and self.train.any():
            train = self.values[self.train]
            beyond = (self.values[self.test] < train.min(axis=0)) | (self.values[self.test] > train.max(axis=0))
            outside = int(beyond.any(axis=1).sum())
        note = (
            f" {outside} test runs lie outside the range of the training runs, where models extrapolate."
            if outside
            else (" No test run lies outside the ranges of the training runs." if self.test.any() else "")
        )
        return f"Where the runs lie in the design space: {'; '.join(ranges)}. There are no runs in the empty regions.{note}"


def select(evaluation: Evaluation) -> Coverage | None:
    reference = evaluation.reference
    if not reference.parameter_names:
        return None
    test, unused = np.zeros(len(reference.runs), bool), np.ones(len(reference.runs), bool)
    test[list(evaluation.split.test)] = True
    unused[[*evaluation.split.test, *evaluation.split.train]] = False
    return Coverage(
        reference.parameter_names, reference.parameter_units, reference.runs, reference.parameters, test, unused
    )


FIGURE = Kind("coverage", "How the runs cover the design space", select)
