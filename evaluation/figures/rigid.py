"""Rigid motion apart from deformation: a good rigid motion must not hide a bad crush."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evaluation.drawing.style import CM, FAINT, INK, MS, Sheet
from evaluation.figures.kind import Columns, Kind
from evaluation.measures.distance import masked_mean

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation


@dataclass(frozen=True)
class RigidAndDeformation:
    """rigid, deformation: model -> (state,) m, mean over runs and seeds; true_* (state,) m the sizes of both."""

    time: NDArray[np.float64]
    rigid: Mapping[str, NDArray[np.float64]]
    deformation: Mapping[str, NDArray[np.float64]]
    true_rigid: NDArray[np.float64]
    true_deformation: NDArray[np.float64]

    def numbers(self) -> Columns:
        columns: dict[str, list[float]] = {
            "time_ms": list(self.time * MS),
            "true_rigid_cm": list(self.true_rigid * CM),
            "true_deformation_cm": list(self.true_deformation * CM),
        }
        for model in self.rigid:
            columns[f"{model} rigid_error_cm"] = list(self.rigid[model] * CM)
            columns[f"{model} deformation_error_cm"] = list(self.deformation[model] * CM)
        return columns

    def draw(self, sheet: Sheet) -> Figure:
        figure, (bars, over_time) = sheet.panels(2, height=max(6.4, 2.6 + 0.75 * len(self.rigid)))
        models = list(self.rigid)
        at = np.arange(len(models))[::-1]
        for y, model in zip(at, models, strict=True):
            colour = sheet.style(model).colour
            rigid, crush = (float(masked_mean(v[model])) * CM for v in (self.rigid, self.deformation))
            bars.barh(y + 0.19, rigid, 0.36, color=colour, alpha=0.4)
            bars.barh(y - 0.19, crush, 0.36, color=colour)
            bars.text(rigid, y + 0.19, f" {rigid:.2f}", va="center", fontsize=7.5, color=INK)
            bars.text(crush, y - 0.19, f" {crush:.2f}", va="center", fontsize=7.5, color=INK)
        bars.set_yticks(at, models)
        bars.grid(axis="y", visible=False)
        bars.set_xlabel("mean error (cm)")
        bars.set_title("light: rigid motion · dark: deformation", fontweight="normal", fontsize=8, color=FAINT)
        bars.margins(x=0.16)
        over_time.fill_between(
            self.time * MS, self.true_deformation * CM, color="#eeeeee", label="true deformation", linewidth=0
        )
        for model in models:
            style = sheet.style(model)
            over_time.plot(
                self.time * MS, self.deformation[model] * CM, color=style.colour, linestyle=style.line, label=model
            )
        over_time.set_xlabel("time (ms)")
        over_time.set_ylabel("deformation error (cm)")
        over_time.margins(x=0)
        over_time.set_ylim(bottom=0)
        sheet.legend(figure, over_time)
        return figure

    def caption(self) -> str:
        crush = {m: float(masked_mean(v)) for m, v in self.deformation.items()}
        best = min(crush, key=lambda m: crush[m])
        size, moved = float(masked_mean(self.true_deformation)), float(masked_mean(self.true_rigid))
        worse = [m for m, e in crush.items() if size > 0 and e >= size]
        warning = (
            f" {', '.join(worse)}: the error is not smaller than that of predicting no deformation." if worse else ""
        )
        return (
            f"Each state is split into the best-fitting rigid motion of the whole structure (mean {moved * CM:.1f} cm) and "
            f"the deformation (mean {size * CM:.1f} cm). First: the errors of both. Second: error of the deformation over "
            f"time; grey: size of the true deformation, which is also the error of predicting none. Lowest in deformation: "
            f"{best}, with an error of {100 * crush[best] / size if size > 0 else 0:.0f} % of the deformation.{warning}"
        )


def select(evaluation: Evaluation) -> RigidAndDeformation | None:
    if evaluation.reference.n_nodes < 3:
        return None
    first = evaluation.scores[evaluation.entries[0].label]
    return RigidAndDeformation(
        evaluation.reference.time,
        {e.label: masked_mean(evaluation.scores[e.label].rigid, axis=(0, 1)) for e in evaluation.entries},
        {e.label: masked_mean(evaluation.scores[e.label].deformation, axis=(0, 1)) for e in evaluation.entries},
        masked_mean(first.true_rigid, axis=0),
        masked_mean(first.true_deformation, axis=0),
    )


FIGURE = Kind("rigid", "Rigid motion and deformation", select)
