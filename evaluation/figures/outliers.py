"""Runs that do not behave as their neighbours in the design space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evaluation.drawing.style import CM, FAINT, INK, Sheet
from evaluation.figures.kind import Columns

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOUR, _ODD = "#0072B2", "#D55E00"


@dataclass(frozen=True)
class Outliers:
    """surprise (run,) m: distance of a run from what the others suggest; score (run,) the same in robust standard
    deviations; limit: score above which a run is named; speed (run,) m/s: fastest node between two states."""

    runs: tuple[str, ...]
    surprise: NDArray[np.float64]
    score: NDArray[np.float64]
    limit: float
    speed: NDArray[np.float64]

    def numbers(self) -> Columns:
        return {
            "run": list(self.runs),
            "surprise_cm": list(self.surprise * CM),
            "score": list(self.score),
            "unusual": ["yes" if s > self.limit else "no" for s in self.score],
            "fastest_node_m_per_s": list(self.speed),
        }

    def draw(self, sheet: Sheet) -> Figure:
        figure, (ax,) = sheet.panels(1, height=6)
        at = np.arange(len(self.runs))
        odd = self.score > self.limit
        ax.vlines(at, 0, self.surprise * CM, color=[_ODD if o else _COLOUR for o in odd], linewidth=1)
        ax.plot(at[~odd], self.surprise[~odd] * CM, "o", color=_COLOUR, markersize=3.5)
        ax.plot(at[odd], self.surprise[odd] * CM, "D", color=_ODD, markersize=5)
        for k in np.flatnonzero(odd):
            ax.annotate(
                self.runs[k],
                (k, self.surprise[k] * CM),
                xytext=(4, 3),
                textcoords="offset points",
                fontsize=7.5,
                color=INK,
            )
        middle, width = _centre(self.surprise)
        ax.axhline((middle + self.limit * width) * CM, color=FAINT, linestyle=":", linewidth=1)
        ax.set_xlabel("run, in the order of the dataset")
        ax.set_ylabel("distance from expectation (cm)")
        ax.set_ylim(bottom=0)
        ax.margins(x=0.03)
        return figure

    def caption(self) -> str:
        odd = [self.runs[k] for k in np.argsort(-self.score) if self.score[k] > self.limit]
        said = f"Unusual: {', '.join(odd)}." if odd else "No run stands out."
        return (
            f"How far each run is from what a quadratic fit through all other runs expects at its parameters, as "
            f"the mean "
            f"distance of sample nodes over time. Above the dotted line ({self.limit:g} robust standard "
            f"deviations over the "
            f"median) a run deserves a look: wrong parameters, a failed computation, or a bifurcation the surrogates "
            f"will not follow. {said}"
        )


def _centre(values: NDArray[np.float64]) -> tuple[float, float]:
    """Median, and the median absolute deviation as a standard deviation."""
    middle = float(np.median(values))
    return middle, 1.4826 * float(np.median(np.abs(values - middle)))


def robust_score(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """(run,) how many robust standard deviations each value lies above the median; 0 where all are alike."""
    middle, width = _centre(values)
    return (values - middle) / width if width > 0 else np.zeros(len(values))
