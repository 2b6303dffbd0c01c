"""What each level of a cascade adds to the coarser one, at t/3, 2t/3 and t (the paper's figure of levels)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evaluation.comparison.scoring import contributions
from evaluation.drawing.style import CM, MS, Sheet, called
from evaluation.figures.kind import Columns, Kind

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation
    from evaluation.comparison.split import Entry

SHARES = (1 / 3, 2 / 3, 1.0)


@dataclass(frozen=True)
class Contributions:
    """lifted: model -> (shown state, node, 3) m on the full mesh, coarsest level first; time (shown state,) s."""

    run: str
    position: NDArray[np.float64]
    faces: NDArray[np.integer]
    time: NDArray[np.float64]
    lifted: Mapping[str, NDArray[np.float32]]

    def _sizes(self) -> dict[str, NDArray[np.float64]]:
        """(shown state, node) m: how far each level moves the nodes beyond the coarser one."""
        return {m: np.linalg.norm(c, axis=-1).astype(np.float64) for m, c in contributions(self.lifted).items()}

    def numbers(self) -> Columns:
        rows = [
            (model, t * MS, float(row.mean()) * CM, float(row.max()) * CM)
            for model, sizes in self._sizes().items()
            for t, row in zip(self.time, sizes, strict=True)
        ]
        names = ("model", "time_ms", "mean_contribution_cm", "largest_contribution_cm")
        return dict(zip(names, zip(*rows, strict=True), strict=True))

    def draw(self, sheet: Sheet) -> Figure:
        from evaluation.drawing.pictures import Row, states_picture

        sizes = self._sizes()
        rows = [
            Row(
                model if k == 0 else f"{model} − {list(self.lifted)[k - 1]}",
                self.lifted[model],
                sizes[model] * CM,
                "contribution (cm)",
            )
            for k, model in enumerate(self.lifted)
        ]
        # The shown states are all there are: name each by its share of the last time.
        span = self.time[-1] - self.time[0]
        shares = [(t - self.time[0]) / span for t in self.time] if span > 0 else [1.0]
        if sheet.narrow and len(shares) > 2:  # three pictures side by side are too small on a phone
            shares = [shares[0], shares[-1]]
        return states_picture(self.position, self.faces, self.time, rows, shares, sheet)

    def caption(self) -> str:
        sizes = {model: float(s.mean()) for model, s in self._sizes().items()}
        names = list(sizes)
        said = ", ".join(f"{model} {size * CM:.2f} cm" for model, size in sizes.items())
        rest = sum(sizes[m] for m in names[1:])
        share = 100 * sizes[names[0]] / (sizes[names[0]] + rest) if sizes[names[0]] + rest > 0 else 0.0
        return (
            f"{called(self.run)}: at the top the prediction of the coarsest level, below it what each finer "
            f"level adds, "
            f"drawn on the "
            f"structure as that level predicts it; mind the colour bar of each row. Mean size over nodes and these "
            f"times: {said}; {share:.0f} % of the motion that is added up comes from the coarsest level."
        )


def cascade(evaluation: Evaluation) -> list[Entry]:
    """The rows of the first model with several levels, coarsest first; empty where there is none."""
    for m in range(len(evaluation.models)):
        rows = [e for e in evaluation.entries if e.keys[0][0] == m]
        if len(rows) > 1:
            return sorted(rows, key=lambda e: -e.level)
    return []


def select(evaluation: Evaluation) -> Contributions | None:
    from evaluation.drawing.pictures import states_at
    from evaluation.drawing.rendering import rendering_problem

    rows = cascade(evaluation)
    if not rows or rendering_problem() is not None:
        return None
    reference = evaluation.reference
    errors = evaluation.scores[rows[-1].label].of_runs
    typical = evaluation.split.test[int(np.argsort(errors, kind="stable")[(len(errors) - 1) // 2])]
    states = list(dict.fromkeys(states_at(reference.time, SHARES)))  # each once
    return Contributions(
        reference.runs[typical],
        reference.position_of(typical),
        reference.faces,
        reference.time[states],
        {e.label: evaluation.lifted(e, typical, states) for e in rows},
    )


FIGURE = Kind("contributions", "What each level contributes", select, raster=True)
