"""ISO/TS 18571 ratings of the curves at the probes, over all test runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evaluation.drawing.style import FAINT, Sheet
from evaluation.figures.kind import Columns, Kind
from evaluation.measures.curves import grade
from evaluation.measures.distance import masked_mean
from evaluation.measures.probes import GRADES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation


@dataclass(frozen=True)
class RatingFigure:
    """ratings: model -> (run, probe, quantity), 0 to 1, NaN where a curve cannot be rated."""

    runs: tuple[str, ...]
    nodes: tuple[int, ...]
    quantities: tuple[str, ...]
    cfc: int | None
    ratings: Mapping[str, NDArray[np.float64]]

    def numbers(self) -> Columns:
        rows = [
            (model, run, node, quantity, float(values[r, p, q]))
            for model, values in self.ratings.items()
            for r, run in enumerate(self.runs)
            for p, node in enumerate(self.nodes)
            for q, quantity in enumerate(self.quantities)
        ]
        names = ("model", "run", "node", "quantity", "rating")
        return dict(zip(names, zip(*rows, strict=True), strict=True))

    def draw(self, sheet: Sheet) -> Figure:
        figure, axes = sheet.panels(len(self.quantities), height=2.2 + 0.75 * len(self.ratings), share_x=True)
        for q, (ax, quantity) in enumerate(zip(axes, self.quantities, strict=True)):
            for y, (model, values) in enumerate(reversed(list(self.ratings.items()))):
                every = values[..., q].ravel()
                every = every[np.isfinite(every)]
                colour = sheet.style(model).colour
                if every.size:
                    ax.plot(
                        every, np.full(every.size, y) + _jitter(every.size), ".", color=colour, alpha=0.3, markersize=3
                    )
                    ax.plot(
                        every.mean(), y, sheet.style(model).marker, color=colour, markersize=7, markeredgecolor="white"
                    )
            for bound, _ in GRADES:
                ax.axvline(bound, color=FAINT, linestyle=":", linewidth=0.9)
            ax.set_yticks(range(len(self.ratings)), list(reversed(list(self.ratings))))
            if q and not sheet.narrow:
                ax.tick_params(labelleft=False)
            ax.grid(axis="y", visible=False)
            ax.set_xlim(0, 1)
            ax.set_title(quantity)
            ax.set_xlabel("rating")
        return figure

    def caption(self) -> str:
        means = {m: masked_mean(v, axis=(0, 1)) for m, v in self.ratings.items()}
        said = []
        for q, quantity in enumerate(self.quantities):
            rated = [m for m in means if np.isfinite(means[m][q])]
            if rated:
                best = max(rated, key=lambda m, q=q: means[m][q])  # type: ignore[misc]
                said.append(f"{quantity} {best} with {means[best][q]:.2f} ({grade(means[best][q])})")
        return (
            f"ISO/TS 18571 rating of the resultant curves at {len(self.nodes)} probes in all test runs (dots) "
            f"and their mean "
            f"(marker); 1 is a perfect match. Dotted lines part poor, fair, good and excellent. Best mean: "
            f"{', '.join(said)}."
        )


def _jitter(count: int) -> NDArray[np.float64]:
    """Fixed small shifts, so that points do not hide each other."""
    shifts: NDArray[np.float64] = (np.arange(count, dtype=np.float64) * 0.618034 % 1 - 0.5) * 0.44
    return shifts


def select(evaluation: Evaluation) -> RatingFigure | None:
    found = evaluation.ratings
    if found is None or evaluation.sensors is None:
        return None
    nodes = tuple(int(n) for n in evaluation.reference.node_id[evaluation.sensors.probes])
    return RatingFigure(evaluation.test_names, nodes, found.quantities, found.cfc, found.models)


FIGURE = Kind("ratings", "Ratings of the curves", select)
