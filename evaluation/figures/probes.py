"""Histories at the probes: resultant displacement, velocity and acceleration of truth and models."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from evaluation.drawing.style import INK, MS, Sheet, called, leading
from evaluation.figures.kind import Columns, Kind
from evaluation.measures.curves import ProbeCurve, curves, shown, unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation

_SHOWN = 4


@dataclass(frozen=True)
class Probes:
    """One run: truth and predictions as resultant curves (state, probe); nodes (probe,) the solver's numbers; `shown`
    are drawn."""

    run: str
    nodes: tuple[int, ...]
    truth: ProbeCurve
    predictions: Mapping[str, ProbeCurve]
    shown: tuple[str, ...]

    def numbers(self) -> Columns:
        rows = []
        for q in self.truth.quantities:
            for name, curve in {"truth": self.truth, **self.predictions}.items():
                times, values = curve.of(q)
                values = shown(q, values)
                rows += [
                    (q, unit(q), name, node, t * MS, values[k, p])
                    for p, node in enumerate(self.nodes)
                    for k, t in enumerate(times)
                ]
        return dict(
            zip(("quantity", "unit", "curve", "node", "time_ms", "value"), zip(*rows, strict=True), strict=True)
        )

    def draw(self, sheet: Sheet) -> Figure:
        quantities = self.truth.quantities
        figure, axes = sheet.panels(len(quantities) * len(self.nodes), height=4.0, columns=len(quantities))
        for k, ax in enumerate(axes):
            p, q = divmod(k, len(quantities))
            quantity = quantities[q]
            times, values = self.truth.of(quantity)
            ax.plot(times * MS, shown(quantity, values[:, p]), color=INK, linewidth=2.2, label="truth")
            for model in self.shown:
                style = sheet.style(model)
                ax.plot(
                    times * MS, shown(quantity, self.predictions[model].of(quantity)[1][:, p]), color=style.colour,
                    linestyle=style.line, linewidth=1.2, label=model,
                )  # fmt: skip
            ax.set_ylabel(f"{quantity} ({unit(quantity)})")
            ax.set_title(f"node {self.nodes[p]}", fontsize=8)
            ax.margins(x=0)
            if p == len(self.nodes) - 1 or sheet.narrow:
                ax.set_xlabel("time (ms)")
        sheet.legend(figure, axes[0])
        return figure

    def caption(self) -> str:
        cfc = self.truth.cfc
        filtered = (
            f"Velocity and acceleration are differences of the states through the CFC {cfc} filter of SAE J211, the "
            f"highest class up to 180 that these states are dense enough for."
            if cfc
            else "The states are too far apart, or too uneven, for any filter class of SAE J211, so velocities are "
            "plain differences and accelerations are left out."
        )
        return (
            f"What sensors at {len(self.nodes)} nodes would have measured in {called(self.run)}, the median run of "
            f"the most "
            f"accurate model: resultant displacement, velocity and acceleration. {filtered} A surrogate that is "
            f"right in its "
            f"mean displacement may still be of no use for accelerations; here it shows."
            f"{leading(len(self.shown), len(self.predictions), _SHOWN)}"
        )


def select(evaluation: Evaluation) -> Probes | None:
    time = evaluation.reference.time
    if evaluation.sensors is None or len(time) < 4:
        return None
    errors = evaluation.scores[evaluation.ranked[0].label].of_runs
    run = int(np.argsort(errors, kind="stable")[(len(errors) - 1) // 2])
    watched = evaluation.runs[run].watched
    if watched is None:
        return None
    return Probes(
        evaluation.test_names[run],
        tuple(int(n) for n in evaluation.reference.node_id[evaluation.sensors.probes]),
        curves(time, watched.probes),
        {e.label: curves(time, evaluation.scores[e.label].probes[0, run]) for e in evaluation.ranked},
        tuple(e.label for e in evaluation.leaders[:_SHOWN]),
    )


FIGURE = Kind("probes", "Histories at probes", select)
