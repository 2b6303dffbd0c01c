"""Mean node error on the nodes of each coarse level, reconstruction and approximation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evaluation.drawing.style import CM, INK, Sheet
from evaluation.figures.kind import Columns, Kind
from evaluation.measures.distance import masked_mean

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation


@dataclass(frozen=True)
class ErrorOnLevels:
    """nodes: level -> its number of nodes; approximation, reconstruction: model -> (level 0 .., ) m.

    `own` is the level a model predicts on: left of it (finer) its numbers include the static upsampling.
    `floor`: level -> error on its nodes of the POD with `modes` modes, fitted to that level alone.
    """

    nodes: Mapping[int, int]
    own: Mapping[str, int]
    approximation: Mapping[str, NDArray[np.float64]]
    reconstruction: Mapping[str, NDArray[np.float64]]
    floor: Mapping[int, float]
    modes: int

    def numbers(self) -> Columns:
        rows = [
            (model, level, n, _relation(level, self.own[model]),
             self.approximation[model][level] * CM, self.reconstruction[model][level] * CM)
            for model in self.approximation for level, n in self.nodes.items()
        ]  # fmt: skip
        rows += [
            (f"POD floor r={self.modes}", level, n, "own", None, self.floor.get(level, np.nan) * CM)
            for level, n in self.nodes.items()
        ]
        names = ("model", "level", "nodes", "prediction_is", "approximation_cm", "reconstruction_cm")
        return dict(zip(names, zip(*rows, strict=True), strict=True))

    def draw(self, sheet: Sheet) -> Figure:
        coarse = [level for level in self.nodes if level > 0]
        on = {level: [m for m, own in self.own.items() if own in (0, level)] for level in coarse}
        height = 2.4 + 0.8 * max(len(models) for models in on.values())
        figure, axes = sheet.panels(len(coarse), height=height, share_x=True)
        for ax, level in zip(axes, sorted(coarse, reverse=True), strict=True):
            at = np.arange(len(on[level]))[::-1]
            for y, model in zip(at, on[level], strict=True):
                colour = sheet.style(model).colour
                ends = [values[model][level] * CM for values in (self.reconstruction, self.approximation)]
                for shift, end, opacity in ((0.19, ends[0], 1.0), (-0.19, ends[1], 0.4)):
                    ax.barh(y + shift, end, 0.36, color=colour, alpha=opacity)
                    ax.text(end, y + shift, f" {end:.2f}", va="center", fontsize=7, color=INK)
            floor = self.floor.get(level)
            if floor is not None:
                ax.axvline(floor * CM, color=INK, linewidth=1, linestyle=":")
            ax.set_yticks(at, on[level])
            ax.set_title(f"level {level}: {self.nodes[level]} nodes")
            ax.set_xlabel("mean node error (cm)")
            ax.grid(axis="y", visible=False)
            ax.margins(x=0.2)
        return figure

    def caption(self) -> str:
        best = {}
        for level in sorted((k for k in self.nodes if k > 0), reverse=True):
            models = [m for m, own in self.own.items() if own in (0, level)]
            best[level] = min(models, key=lambda m: self.approximation[m][level])
        winners = ", ".join(
            f"{model} on level {level} ({self.approximation[model][level] * CM:.2f} cm)"
            for level, model in best.items()
        )
        return (
            f"Error on the nodes of each coarse mesh, so without upsampling. Dark: compression error (encode and decode the "
            f"true states); light: error of the prediction. Predictions of full-mesh models are taken at the same nodes. "
            f"Dotted line: best linear compression with {self.modes} modes on that level. Lowest prediction error: {winners}."
        )


def _relation(level: int, own: int) -> str:
    """How a model that predicts on level `own` gets its values on `level`."""
    return "own" if level == own else ("lifted" if level < own else "restricted")


def select(evaluation: Evaluation) -> ErrorOnLevels | None:
    reference = evaluation.reference
    if not reference.levels:
        return None
    nodes = {level: reference.level_nodes(level) for level in range(len(reference.levels) + 1)}
    modes = min(4, *(len(evaluation.floor(level)) for level in evaluation.pods)) if evaluation.pods else 0
    scores = evaluation.scores
    return ErrorOnLevels(
        nodes,
        {e.label: e.level for e in evaluation.entries},
        {e.label: masked_mean(scores[e.label].on_level, axis=(0, 1)) for e in evaluation.entries},
        {e.label: masked_mean(scores[e.label].on_level_reconstruction, axis=(0, 1)) for e in evaluation.entries},
        {level: float(evaluation.floor(level)[modes - 1]) for level in evaluation.pods},
        modes,
    )


FIGURE = Kind("levels", "Error on the coarse meshes", select)
