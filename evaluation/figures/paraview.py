"""A state of the files written for ParaView, read back through VTK: proof that they hold what they should."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from evaluation.drawing.style import Sheet
from evaluation.figures.kind import Columns, Kind

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation


@dataclass(frozen=True)
class FromFile:
    """path of a .pvd or .vtkhdf file with the arrays displacement and predicted_NAME, the model, and that name."""

    path: Path
    model: str
    array: str

    def numbers(self) -> Columns:
        from crashkit.writers.paraview import read_state

        time, mesh = read_state(self.path)
        arrays = {name: np.asarray(mesh.point_data[name]) for name in mesh.point_data}
        return {
            "array": list(arrays),
            "components": [1 if a.ndim == 1 else a.shape[1] for a in arrays.values()],
            "smallest": [float(np.nanmin(a)) for a in arrays.values()],
            "largest": [float(np.nanmax(a)) for a in arrays.values()],
            "time_s": [time] * len(arrays),
        }

    def draw(self, sheet: Sheet) -> Figure:
        from evaluation.drawing.pictures import file_picture

        return file_picture(self.path, name=self.model, sheet=sheet, prediction=f"predicted_{self.array}")

    def caption(self) -> str:
        arrays = self.numbers()["array"]
        return (
            f"The last state of {self.path.name}, read back from the file: truth, prediction of {self.model} and "
            f"error. In ParaView, open the file and warp by displacement or predicted_{self.array}. Arrays: "
            f"{', '.join(arrays)}; lengths in metres."
        )


def select(evaluation: Evaluation) -> FromFile | None:
    from crashkit.output import file_name
    from evaluation.comparison.predictor import array_names
    from evaluation.drawing.rendering import rendering_problem

    best = evaluation.model(evaluation.ranked[0])
    runs = {file_name(name) for name in evaluation.test_names}
    found = [p for p in evaluation.files if p.suffix in (".pvd", ".vtkhdf") and p.stem in runs]
    if not found or rendering_problem() is not None:
        return None
    finest = best.predictors[0].name
    # Where the best model is a further seed, the file holds the first seed of its row.
    first = next(m for m in evaluation.first_seeds if m.kind == best.kind)
    return FromFile(found[0], finest, array_names(evaluation.first_seeds)[first.name, finest])


FIGURE = Kind("paraview", "The files for ParaView", select, raster=True)
