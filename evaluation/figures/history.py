"""Training history: total, approximation and reconstruction loss, smoothed over raw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evaluation.drawing.style import Sheet, smoothed
from evaluation.figures.kind import Columns, Kind

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation

_LOSSES = ("total", "approximation", "reconstruction")


@dataclass(frozen=True)
class LossCurves:
    """curves: model -> name of a loss -> (epoch,) values of the scaled data, so without unit."""

    curves: Mapping[str, Mapping[str, NDArray[np.float64]]]

    def _losses(self) -> list[str]:
        return [name for name in _LOSSES if any(name in c for c in self.curves.values())]

    def numbers(self) -> Columns:
        rows = [
            (model, name, epoch, value, smooth)
            for model, curves in self.curves.items()
            for name in self._losses()
            if name in curves
            for epoch, (value, smooth) in enumerate(zip(curves[name], smoothed(curves[name]), strict=True), 1)
        ]
        names = ("model", "loss", "epoch", "value", "smoothed")
        return dict(zip(names, zip(*rows, strict=True), strict=True))

    def draw(self, sheet: Sheet) -> Figure:
        names = self._losses()
        figure, axes = sheet.panels(len(names), height=5.8, share_y=True)
        for ax, name in zip(axes, names, strict=True):
            for model, curves in self.curves.items():
                if name not in curves:
                    continue
                style = sheet.style(model)
                epochs = np.arange(1, len(curves[name]) + 1)
                ax.semilogy(epochs, curves[name], color=style.colour, alpha=0.22, linewidth=0.7)
                ax.semilogy(epochs, smoothed(curves[name]), color=style.colour, linestyle=style.line, label=model)
            ax.set_title(name)
            ax.set_xlabel("epoch")
            ax.margins(x=0)
        axes[0].set_ylabel("mean squared error, scaled")
        sheet.legend(figure, axes[0])
        return figure

    def caption(self) -> str:
        ends = {m: float(np.min(c["total"])) for m, c in self.curves.items() if "total" in c}
        order = sorted(ends, key=lambda m: ends[m])
        said = ", ".join(f"{m} {ends[m]:.2g}" for m in order)
        rising = [m for m in order if (total := self.curves[m]["total"]).size > 20 and _rises(total)]
        note = f" The total of {', '.join(rising)} rises again at its end." if rising else ""
        return (
            f"Losses over the epochs, light: raw, dark: running median. Lowest totals: {said}. Each level is scaled by its "
            f"own mean displacement, so compare heights only within the same loss. If a curve still falls at its right end, "
            f"more epochs would help.{note}"
        )


def _rises(total: NDArray[np.float64]) -> bool:
    smooth = smoothed(total)
    return bool(smooth[-1] > 1.1 * smooth.min())


def select(evaluation: Evaluation) -> LossCurves | None:
    curves = {
        e.label: {k: np.asarray(v, dtype=np.float64) for k, v in evaluation.predictor(e).history.items()}
        for e in evaluation.entries
        if evaluation.predictor(e).history
    }
    curves = {m: {k: v for k, v in c.items() if k in _LOSSES and v.size} for m, c in curves.items()}
    curves = {m: c for m, c in curves.items() if c}
    return LossCurves(curves) if curves else None


FIGURE = Kind("history", "Training history", select)
