"""Which parameters are likely: each alone, and each pair, as a triangle of panels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evaluation.drawing.style import FAINT, INK, Sheet, label_outer, look, readable, span

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BLUE, _RED = "#0072B2", "#D55E00"
# Samples are drawn on this many squares along each axis of a panel.
_BINS = 48


def pairs_figure(
    names: Sequence[str],
    units: Sequence[str],
    samples: NDArray[np.float64],
    best: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    others: NDArray[np.float64] | None = None,
    sheet: Sheet | None = None,
) -> Figure:
    """Distributions of parameters over their box.

    Parameters
    ----------
    samples
        (sample, parameter), all of one weight.
    best
        (parameter,): a cross in each panel; `others` (optimum, parameter) are smaller ones.
    low, high
        (parameter,) the box; where the axes, which span the samples, reach it, a grey line is its edge.
    """
    from matplotlib.figure import Figure

    sheet = sheet or Sheet()
    n = len(names)
    more = np.empty((0, n)) if others is None else np.asarray(others).reshape(-1, n)
    stacked = np.concatenate([low[None], high[None], best[None], more, samples])
    shown, told = zip(*(readable(v, u) for v, u in zip(stacked.T, units, strict=True)), strict=True)
    labels = [span(name, unit) for name, unit in zip(names, told, strict=True)]
    first = 3 + len(more)
    side = min(sheet.width, 2 + 4.8 * n)
    with look():
        figure = Figure(figsize=(side / 2.54, side / 2.54), layout="constrained")
        grid = figure.subplots(n, n, squeeze=False)
        for i in range(n):
            for j in range(n):
                ax = grid[i, j]
                if j > i:
                    ax.remove()
                    continue
                x, y = shown[j], shown[i]
                (left, right), (bottom, top) = _reach(x, x[first:]), _reach(y, y[first:])
                ax.grid(visible=False)
                for edge in x[:2]:
                    ax.axvline(edge, color=FAINT, linewidth=1.5)
                ax.set_xlim(left, right)
                if i == j:
                    ax.hist(x[first:], bins=_BINS, range=(left, right), color=_BLUE, alpha=0.6)
                    ax.axvspan(*np.quantile(x[first:], [0.05, 0.95]), color=_BLUE, alpha=0.12, linewidth=0)
                    ax.axvline(x[2], color=_RED, linewidth=1.2)
                    ax.set_yticks([])
                else:
                    for edge in y[:2]:
                        ax.axhline(edge, color=FAINT, linewidth=1.5)
                    ax.set_ylim(bottom, top)
                    box = [[left, right], [bottom, top]]
                    ax.hist2d(x[first:], y[first:], bins=_BINS, range=box, cmap="Blues", cmin=1)
                    ax.plot(x[3:first], y[3:first], "x", color=INK, markersize=5)
                    ax.plot(x[2], y[2], "+", color=_RED, markersize=9, markeredgewidth=1.6)
                label_outer(ax, i, j, labels)
    return figure


def _reach(values: NDArray[np.float64], samples: NDArray[np.float64]) -> tuple[float, float]:
    """What an axis shows: the samples with some room, and of the box (values[0] to values[1]) no more than its edge."""
    room = 0.15 * max(float(np.ptp(samples)), 0.02 * float(values[1] - values[0]))
    beyond = 0.01 * float(np.ptp(samples))
    return max(samples.min() - room, values[0] - beyond), min(samples.max() + room, values[1] + beyond)
