"""How far the structure moves over time, run by run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evaluation.drawing.style import CM, MS, Sheet
from evaluation.figures.kind import Columns

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOUR, _ODD = "#0072B2", "#D55E00"


@dataclass(frozen=True)
class Envelopes:
    """time (state,) s; mean, largest (run, state) m: displacement over the nodes; odd (run,) bool: drawn apart."""

    time: NDArray[np.float64]
    runs: tuple[str, ...]
    mean: NDArray[np.float64]
    largest: NDArray[np.float64]
    odd: NDArray[np.bool_]

    def numbers(self) -> Columns:
        rows = [
            (run, t * MS, a * CM, b * CM)
            for run, mean, largest in zip(self.runs, self.mean, self.largest, strict=True)
            for t, a, b in zip(self.time, mean, largest, strict=True)
        ]
        names = ("run", "time_ms", "mean_displacement_cm", "largest_displacement_cm")
        return dict(zip(names, zip(*rows, strict=True), strict=True))

    def draw(self, sheet: Sheet) -> Figure:
        figure, axes = sheet.panels(2, height=6.2)
        for ax, values, title in zip(
            axes, (self.mean, self.largest), ("mean over the nodes", "largest node"), strict=True
        ):
            low, middle, high = np.nanquantile(values, (0.05, 0.5, 0.95), axis=0)
            ax.fill_between(self.time * MS, low * CM, high * CM, color=_COLOUR, alpha=0.14, linewidth=0)
            for row, odd in zip(values, self.odd, strict=True):
                ax.plot(
                    self.time * MS, row * CM, color=_ODD if odd else _COLOUR, alpha=0.9 if odd else 0.3,
                    linewidth=1.3 if odd else 0.6,
                )  # fmt: skip
            ax.plot(self.time * MS, middle * CM, color=_COLOUR, linewidth=2.2)
            ax.set_title(title)
            ax.set_xlabel("time (ms)")
            ax.margins(x=0)
            ax.set_ylim(bottom=0)
        axes[0].set_ylabel("displacement (cm)")
        return figure

    def caption(self) -> str:
        end = self.mean[:, -1] * CM
        most = int(np.nanargmax(self.largest.max(axis=1)))
        odd = " Orange: the runs named below as unusual." if self.odd.any() else ""
        return (
            f"Displacement of every run over time (thin), their median (thick) and the band of the middle 90 %. "
            f"At the end "
            f"the structure has moved by {np.nanmin(end):.1f} to {np.nanmax(end):.1f} cm on average; no node of "
            f"any run "
            f"moves further than {np.nanmax(self.largest) * CM:.1f} cm ({self.runs[most]}).{odd}"
        )
