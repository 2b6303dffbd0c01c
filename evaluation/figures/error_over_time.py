"""Mean node error over time: every test run faint, their mean opaque (the paper's figure of approximation quality)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evaluation.drawing.style import CM, MS, Sheet
from evaluation.figures.kind import Columns, Kind
from evaluation.measures.distance import masked_mean

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation


@dataclass(frozen=True)
class ErrorOverTime:
    """time (state,) s; errors: model -> (run, state) m, mean over seeds; size (state,) m mean displacement."""

    time: NDArray[np.float64]
    runs: tuple[str, ...]
    errors: Mapping[str, NDArray[np.float64]]
    size: NDArray[np.float64]

    def numbers(self) -> Columns:
        rows = [
            (model, run, t * MS, e * CM)
            for model, errors in self.errors.items()
            for run, row in zip((*self.runs, "mean"), (*errors, masked_mean(errors, axis=0)), strict=True)
            for t, e in zip(self.time, row, strict=True)
        ]
        return dict(zip(("model", "run", "time_ms", "mean_node_error_cm"), zip(*rows, strict=True), strict=True))

    def draw(self, sheet: Sheet) -> Figure:
        count = len(self.errors)
        columns = min(count, 3)
        figure, axes = sheet.panels(count, height=4.6 if not sheet.narrow else 5.2, columns=columns, share_y=True)
        means = {model: masked_mean(errors, axis=0) for model, errors in self.errors.items()}
        for k, (model, errors) in enumerate(self.errors.items()):
            ax, style = axes[k], sheet.style(model)
            for other, mean in means.items():
                if other != model:
                    ax.plot(self.time * MS, mean * CM, color="#c4c4c4", linewidth=0.8, zorder=1)
            for row in errors:
                ax.plot(self.time * MS, row * CM, color=style.colour, alpha=0.28, linewidth=0.8)
            ax.plot(self.time * MS, means[model] * CM, color=style.colour, linewidth=2.2)
            ax.set_title(f"{model}   {np.nanmean(means[model]) * CM:.2f} cm")
            ax.margins(x=0)
            if k % columns == 0 or sheet.narrow:
                ax.set_ylabel("mean node error (cm)")
            if k >= count - columns or sheet.narrow:
                ax.set_xlabel("time (ms)")
        axes[0].set_ylim(0, 1.04 * CM * max(float(np.nanmax(errors)) for errors in self.errors.values()))
        return figure

    def caption(self) -> str:
        means = {model: masked_mean(errors, axis=0) for model, errors in self.errors.items()}
        best = min(means, key=lambda m: float(np.nanmean(means[m])))
        last = int(np.nanargmax(means[best]))
        worst_run = int(np.nanargmax(masked_mean(self.errors[best], axis=1)))
        return (
            f"Mean node error on the full mesh over time. Thin lines are the {len(self.runs)} test runs one by "
            f"one, the "
            f"thick line is their mean, and grey lines repeat the means of the other models. Look for thin lines far "
            f"above the thick one: with the best model, {best}, the worst is {self.runs[worst_run]}. Its mean is "
            f"largest at {self.time[last] * MS:.1f} ms with {means[best][last] * CM:.2f} cm, when the structure "
            f"has moved by "
            f"{self.size[last] * CM:.1f} cm on average."
        )


def select(evaluation: Evaluation) -> ErrorOverTime:
    return ErrorOverTime(
        evaluation.reference.time,
        evaluation.test_names,
        {e.label: masked_mean(evaluation.scores[e.label].e2, axis=0) for e in evaluation.entries},
        masked_mean(np.array([r.size for r in evaluation.runs]), axis=0),
    )


FIGURE = Kind("error_over_time", "Error over time", select)
