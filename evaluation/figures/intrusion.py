"""Intrusion: the largest displacement along a direction, predicted against true."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evaluation.drawing.style import CM, FAINT, INK, MS, Sheet, leading
from evaluation.figures.kind import Columns, Kind
from evaluation.measures.distance import masked_mean

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation

_SHOWN = 6


@dataclass(frozen=True)
class IntrusionFigure:
    """truth (run, state) m and predictions: model -> (run, state) m, mean over seeds; about says of what; `shown` are drawn."""

    about: str
    runs: tuple[str, ...]
    time: NDArray[np.float64]
    truth: NDArray[np.float64]
    predictions: Mapping[str, NDArray[np.float64]]
    shown: tuple[str, ...]

    def _largest(self) -> dict[str, NDArray[np.float64]]:
        return {m: np.nanmax(p, axis=1) for m, p in self.predictions.items()}

    def _misses(self) -> dict[str, float]:
        true = np.nanmax(self.truth, axis=1)
        return {m: float(np.mean(np.abs(p - true))) for m, p in self._largest().items()}

    def numbers(self) -> Columns:
        columns: dict[str, list[object]] = {
            "run": list(self.runs),
            "true_largest_cm": list(np.nanmax(self.truth, axis=1) * CM),
        }
        for model, largest in self._largest().items():
            columns[f"{model} largest_cm"] = list(largest * CM)
        return columns

    def draw(self, sheet: Sheet) -> Figure:
        figure, (scatter, history) = sheet.panels(2, height=7.0)
        true = np.nanmax(self.truth, axis=1) * CM
        predicted = {m: largest * CM for m, largest in self._largest().items() if m in self.shown}
        top = 1.06 * max(float(true.max()), *(float(p.max()) for p in predicted.values()))
        scatter.plot([0, top], [0, top], color=FAINT, linewidth=0.9)
        for model, largest in predicted.items():
            style = sheet.style(model)
            scatter.plot(
                true, largest, linestyle="none", marker=style.marker, color=style.colour, markersize=4.5,
                alpha=0.85, markeredgewidth=0, label=model,
            )  # fmt: skip
        scatter.set_xlabel("true largest intrusion (cm)")
        scatter.set_ylabel("predicted (cm)")
        scatter.set_xlim(0, top)
        scatter.set_ylim(0, top)
        deepest = int(np.argmax(true))
        history.plot(self.time * MS, self.truth[deepest] * CM, color=INK, linewidth=2.2, label="truth")
        for model in self.shown:
            style = sheet.style(model)
            history.plot(
                self.time * MS, self.predictions[model][deepest] * CM, color=style.colour, linestyle=style.line
            )
        history.set_title(f"{self.runs[deepest]}, black: truth")
        history.set_xlabel("time (ms)")
        history.set_ylabel("intrusion (cm)")
        history.margins(x=0)
        sheet.legend(figure, scatter)
        return figure

    def caption(self) -> str:
        misses = self._misses()
        best, worst = min(misses, key=lambda m: misses[m]), max(misses, key=lambda m: misses[m])
        true = float(masked_mean(np.nanmax(self.truth, axis=1)))
        low = [m for m, p in self._largest().items() if (p < np.nanmax(self.truth, axis=1)).mean() > 0.75]
        said = f" Underestimated in more than three of four runs by {', '.join(low)}." if low else ""
        return (
            f"Largest intrusion of each test run ({self.about}), predicted against true; points below the line "
            f"are on the "
            f"unsafe side. Second: its history in the run with the deepest one. It is {true * CM:.1f} cm on average; "
            f"{best} misses it by {misses[best] * CM:.2f} cm, {worst} by {misses[worst] * CM:.2f} cm.{said}"
            f"{leading(len(self.shown), len(self.predictions), _SHOWN)}"
        )


def select(evaluation: Evaluation) -> IntrusionFigure | None:
    if evaluation.sensors is None:
        return None
    truth = np.array([r.watched.intrusion for r in evaluation.runs if r.watched is not None])
    if not np.isfinite(truth).any(axis=1).all():
        return None
    return IntrusionFigure(
        evaluation.sensors.about,
        evaluation.test_names,
        evaluation.reference.time,
        truth,
        {e.label: masked_mean(evaluation.scores[e.label].intrusion, axis=0) for e in evaluation.entries},
        tuple(e.label for e in evaluation.leaders[:_SHOWN]),
    )


FIGURE = Kind("intrusion", "Intrusion", select)
