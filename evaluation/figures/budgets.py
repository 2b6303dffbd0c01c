"""What the models cost: seconds an epoch, milliseconds a prediction with and without lifting, error against cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from evaluation.drawing.style import CM, INK, Sheet, few_log_ticks, short
from evaluation.figures.kind import Columns, Kind

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation


@dataclass(frozen=True)
class Budget:
    """seconds_per_epoch and training_seconds s (NaN where it makes no sense), own and lifted ms a state, error m."""

    seconds_per_epoch: float
    training_seconds: float
    own: float
    lifted: float
    parameters: int
    error: float


@dataclass(frozen=True)
class Budgets:
    """budgets: model -> its costs."""

    budgets: Mapping[str, Budget]

    def numbers(self) -> Columns:
        b = self.budgets.values()
        return {
            "model": list(self.budgets),
            "seconds_per_epoch": [x.seconds_per_epoch for x in b],
            "training_s": [x.training_seconds for x in b],
            "prediction_own_level_ms": [x.own for x in b],
            "prediction_full_mesh_ms": [x.lifted for x in b],
            "parameters": [x.parameters for x in b],
            "mean_node_error_cm": [x.error * CM for x in b],
        }

    def draw(self, sheet: Sheet) -> Figure:
        figure, (epoch, predict, trade) = sheet.panels(3, height=max(6.6, 2.6 + 0.7 * len(self.budgets)))
        trained = [m for m, b in self.budgets.items() if np.isfinite(b.seconds_per_epoch)]
        _bars(epoch, sheet, trained, [self.budgets[m].seconds_per_epoch for m in trained])
        epoch.set_title("training")
        epoch.set_xlabel("seconds an epoch")
        models = list(self.budgets)
        at = np.arange(len(models))[::-1]
        for y, m in zip(at, models, strict=True):
            colour, b = sheet.style(m).colour, self.budgets[m]
            predict.barh(y + 0.19, b.own, 0.36, color=colour)
            predict.barh(y - 0.19, b.lifted, 0.36, color=colour, alpha=0.4)
            predict.text(b.lifted, y - 0.19, f" {short(b.lifted)}", va="center", fontsize=7, color=INK)
        predict.set_yticks(at, models)
        predict.set_xscale("log")
        predict.set_xlim(
            min(b.own for b in self.budgets.values()) / 2, 3 * max(b.lifted for b in self.budgets.values())
        )
        few_log_ticks(predict.xaxis)
        predict.set_xlabel("ms per state, light: lifted")
        predict.set_title("prediction")
        predict.grid(axis="y", visible=False)
        for m, b in self.budgets.items():
            style = sheet.style(m)
            trade.plot(
                b.lifted, b.error * CM, marker=style.marker, color=style.colour, markersize=6.5, linestyle="none",
                label=m,
            )  # fmt: skip
        trade.set_xscale("log")
        trade.margins(x=0.35, y=0.14)
        few_log_ticks(trade.xaxis)
        trade.set_xlabel("ms per state, full mesh")
        trade.set_ylabel("mean node error (cm)")
        trade.set_title("error for its price")
        sheet.legend(figure, trade)
        return figure

    def caption(self) -> str:
        fastest = min(self.budgets, key=lambda m: self.budgets[m].lifted)
        best = min(self.budgets, key=lambda m: self.budgets[m].error)
        f, b = self.budgets[fastest], self.budgets[best]
        front = [
            m for m, x in self.budgets.items()
            if not any(y.lifted <= x.lifted and y.error < x.error for k, y in self.budgets.items() if k != m)
        ]  # fmt: skip
        return (
            f"First: seconds per epoch of the training (models without epochs have none). Second: milliseconds per state "
            f"for a whole run, dark: on the model's own mesh, light: with lifting to the full mesh. Third: error against "
            f"prediction time on the full mesh. Best trade-off (Pareto): {', '.join(front)}. Fastest: {fastest} "
            f"({f.lifted:.3g} ms, {f.error * CM:.2f} cm); most accurate: {best} ({b.lifted:.3g} ms, {b.error * CM:.2f} cm)."
        )


def _bars(ax: Axes, sheet: Sheet, models: list[str], values: list[float]) -> None:
    at = np.arange(len(models))[::-1]
    for y, m, value in zip(at, models, values, strict=True):
        ax.barh(y, value, 0.6, color=sheet.style(m).colour)
        ax.text(value, y, f" {short(value)}", va="center", fontsize=7.5, color=INK)
    ax.set_yticks(at, models)
    ax.grid(axis="y", visible=False)
    ax.margins(x=0.2)
    if values and max(values) > 30 * min(values):
        ax.set_xscale("log")
        ax.set_xlim(min(values) / 2, 4 * max(values))
        few_log_ticks(ax.xaxis)


def select(evaluation: Evaluation) -> Budgets | None:
    if not evaluation.timings:
        return None
    out = {}
    for e in evaluation.entries:
        predictor, timing = evaluation.predictor(e), evaluation.timings[e.label]
        out[e.label] = Budget(
            predictor.seconds_per_epoch, predictor.training_seconds, timing.own, timing.lifted,
            predictor.n_parameters, evaluation.scores[e.label].mean,
        )  # fmt: skip
    return Budgets(out)


FIGURE = Kind("budgets", "Training and prediction time", select)
