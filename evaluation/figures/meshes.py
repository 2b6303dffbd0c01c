"""The mesh hierarchy: kept nodes and the coarse mesh of every level, with what lifting from it costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from data_schema.levels import Level
from evaluation.drawing.style import CM, Sheet
from evaluation.figures.kind import Columns, Kind

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation


@dataclass(frozen=True)
class Meshes:
    """position (node, 3) m and faces of the full mesh, its levels, and level -> error of lifting the truth, m."""

    position: NDArray[np.float64]
    faces: NDArray[np.integer]
    levels: tuple[Level, ...]
    lifting: Mapping[int, float]

    def numbers(self) -> Columns:
        return {
            "level": [level.index for level in self.levels],
            "nodes": [level.n_nodes for level in self.levels],
            "faces": [len(level.faces) for level in self.levels],
            "distance_to_surface_cm": [
                np.nan if level.distance is None else float(np.mean(level.distance)) * CM for level in self.levels
            ],
            "lifting_error_cm": [self.lifting[level.index] * CM for level in self.levels],
        }

    def draw(self, sheet: Sheet) -> Figure:
        from evaluation.drawing.pictures import KeptNodes, kept_nodes_picture

        rows = [KeptNodes(f"level {level.index}", level.kept, level.faces, level.edges) for level in self.levels]
        return kept_nodes_picture(self.position, self.faces, rows, sheet)

    def caption(self) -> str:
        said = ", ".join(f"{self.lifting[level.index] * CM:.2f} cm from level {level.index}" for level in self.levels)
        return (
            f"Kept nodes on the full mesh, and the coarse mesh between them. Kept nodes do not move. Error of interpolating "
            f"the true motion of the test runs from them to all nodes: {said}, whatever the model."
        )


def select(evaluation: Evaluation) -> Meshes | None:
    from evaluation.drawing.rendering import rendering_problem

    reference = evaluation.reference
    if not reference.levels or rendering_problem() is not None:
        return None
    return Meshes(
        reference.position,
        reference.faces,
        reference.levels,
        {level.index: evaluation.lifting(level.index) for level in reference.levels},
    )


FIGURE = Kind("meshes", "The coarse meshes", select, raster=True)
