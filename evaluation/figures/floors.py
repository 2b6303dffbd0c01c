"""What is reduction error and what is regression error: every model beside the POD projection floor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evaluation.drawing.style import CM, FAINT, INK, Sheet
from evaluation.figures.kind import Columns, Kind

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation


@dataclass(frozen=True)
class Point:
    """One model: numbers a state is reduced to, and its errors on the full mesh, m; seeds (seed,) the total of each."""

    latent: int
    total: float
    reduction: float
    lifting: float
    seeds: tuple[float, ...] = ()


@dataclass(frozen=True)
class Floors:
    """floor (mode,) m: error of projecting the test runs on 1, 2, ... modes of the training runs."""

    floor: NDArray[np.float64]
    points: Mapping[str, Point]

    def numbers(self) -> Columns:
        modes = list(range(1, len(self.floor) + 1))
        rows: list[tuple[Any, ...]] = [
            ("POD projection floor", r, e * CM, None, None) for r, e in zip(modes, self.floor, strict=True)
        ]
        rows += [(label, p.latent, p.total * CM, p.reduction * CM, p.lifting * CM) for label, p in self.points.items()]
        names = ("what", "latent_size", "mean_node_error_cm", "reduction_error_cm", "lifting_error_cm")
        return dict(zip(names, zip(*rows, strict=True), strict=True))

    def draw(self, sheet: Sheet) -> Figure:
        figure, (left, right) = sheet.panels(2, height=max(6.8, 2.6 + 0.62 * len(self.points)))
        modes = np.arange(1, len(self.floor) + 1)
        left.plot(modes, self.floor * CM, color=INK, linewidth=1.4, label="best linear compression (POD)")
        left.fill_between(modes, self.floor * CM, color="#eeeeee", zorder=0)
        for label, p in self.points.items():
            style = sheet.style(label)
            left.plot(
                p.latent, p.total * CM, linestyle="none", marker=style.marker, color=style.colour, markersize=6.5,
                label=label,
            )  # fmt: skip
        left.set_xscale("log")
        left.set_yscale("log")
        ticks = [t for t in (1, 2, 4, 8, 16, 32, 50) if t <= len(self.floor)]
        left.set_xticks(ticks, [str(t) for t in ticks])
        left.minorticks_off()
        values = np.concatenate([self.floor, [p.total for p in self.points.values()]]) * CM
        levels = [
            t for t in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50) if values.min() <= t <= values.max()
        ]
        left.set_yticks(levels, [f"{t:g}" for t in levels])
        left.set_xlabel("numbers a state is reduced to")
        left.set_ylabel("mean node error (cm)")
        self._bars(right, sheet)
        sheet.legend(figure, left)
        return figure

    def _bars(self, ax: Axes, sheet: Sheet) -> None:
        labels = list(self.points)
        at = np.arange(len(labels))[::-1]
        for y, label in zip(at, labels, strict=True):
            p = self.points[label]
            colour = sheet.style(label).colour
            ax.barh(y, p.total * CM, height=0.62, color=colour, alpha=0.35)
            ax.barh(y, p.reduction * CM, height=0.62, color=colour)
            if len(p.seeds) > 1:
                ends = (min(p.seeds) * CM, max(p.seeds) * CM)
                ax.plot(ends, [y, y], color=INK, linewidth=1.2, marker="|", markersize=7)
            if p.lifting:
                ax.plot([p.lifting * CM] * 2, [y - 0.36, y + 0.36], color="black", linewidth=1.4)
            ax.text(
                max(p.total, p.reduction, *p.seeds) * CM, y, f" {p.total * CM:.2f}", va="center", fontsize=8, color=INK
            )
        ax.set_yticks(at, labels)
        ax.grid(axis="y", visible=False)
        ax.set_xlabel("mean node error (cm)")
        ax.set_title(
            "light: total · dark: compression · line: interpolation error",
            color=FAINT,
            fontweight="normal",
            fontsize=8,
        )
        ax.margins(x=0.14)

    def caption(self) -> str:
        best = min(self.points, key=lambda label: self.points[label].total)
        p = self.points[best]
        need = np.flatnonzero(self.floor <= p.total)
        modes = (
            f"a projection on {need[0] + 1} mode{'s' if need[0] else ''} has the same error"
            if need.size
            else f"a projection on {len(self.floor)} modes still has a larger error"
        )
        seeds = "; thin lines span the seeds" if any(len(q.seeds) > 1 for q in self.points.values()) else ""
        share = 100 * min(1.0, p.reduction / p.total)
        return (
            f"First: the line is the best linear compression of the test runs (POD); for a model above it the rest is "
            f"regression, a model below it compresses better than POD with as many numbers. Second, light: total error, dark: "
            f"compression error, line: interpolation error from the coarse mesh{seeds}. For {best}, {modes}; its compression "
            f"error is {share:.0f} % of its total error."
        )


def select(evaluation: Evaluation) -> Floors | None:
    if not evaluation.pods:
        return None
    points = {
        e.label: Point(
            evaluation.predictor(e).n_latent,
            evaluation.scores[e.label].mean,
            evaluation.scores[e.label].reduction,
            evaluation.lifting_of(e),
            tuple(float(s) for s in evaluation.scores[e.label].of_seeds),
        )
        for e in evaluation.entries
    }
    return Floors(evaluation.floor(), points)


FIGURE = Kind("floors", "Compression or regression: where the error comes from", select)
