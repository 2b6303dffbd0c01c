"""One look for every figure: sizes in centimetres, a palette that the colour-blind can read, a style a model.

Colours are those of Okabe and Ito (2008), which stay apart in all common kinds of colour blindness; line style
and marker tell models apart once more, so that figures survive a black-and-white printer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CM = 100.0  # metres to centimetres
MS = 1000.0  # seconds to milliseconds
INK = "#222222"
FAINT = "#8a8a8a"
GRID = "#e4e4e4"

_FIXED = {
    "MH1": "#0072B2", "MH2": "#56B4E9", "MH3": "#009E73", "MH4": "#4B7A00",
    "PODNN": "#D55E00", "POD-GPR": "#E69F00", "POD-RBF": "#A0522D",
    "AENN": "#CC79A7", "GAENN": "#7A5BA6",
}  # fmt: skip
_OTHERS = ("#332288", "#882255", "#117733", "#AA4499", "#44AA99", "#999933", "#661100", "#6699CC", "#888888")
_LINES: tuple[Any, ...] = ("-", "--", "-.", (0, (1, 1.2)), (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)))
_MARKERS = "osD^vPX<>hp*"

_RC: Any = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "axes.labelcolor": INK,
    "axes.edgecolor": "#555555",
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "legend.fontsize": 8,
    "legend.frameon": False,
    "legend.handlelength": 2.2,
    "lines.linewidth": 1.6,
    "lines.markersize": 4,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "svg.hashsalt": "crashkit",  # the same figure gives the same file
    "svg.fonttype": "path",
}


@dataclass(frozen=True)
class Style:
    """How one model looks wherever it appears."""

    colour: str
    line: Any
    marker: str


def styles(labels: Sequence[str]) -> dict[str, Style]:
    """A style for each label: the fixed colour of a known kind of model, else the next free one."""
    out: dict[str, Style] = {}
    taken: set[str] = set()
    for k, label in enumerate(labels):
        fixed = _FIXED.get(label.split(" ")[0])
        free = [c for c in _OTHERS if c not in taken]
        colour = fixed if fixed and fixed not in taken else (free[0] if free else _OTHERS[k % len(_OTHERS)])
        taken.add(colour)
        out[label] = Style(colour, _LINES[k % len(_LINES)], _MARKERS[k % len(_MARKERS)])
    return out


@dataclass(frozen=True)
class Sheet:
    """The paper a figure is drawn on: 17 cm for a page, 9 cm for a phone, where panels stand below each other."""

    width: float = 17.0
    styles: Mapping[str, Style] = field(default_factory=dict)

    @property
    def narrow(self) -> bool:
        return self.width < 12

    def style(self, label: str) -> Style:
        """The style of `label`; a plain one for what is no model."""
        return self.styles.get(label, Style(INK, "-", "o"))

    def panels(
        self, count: int, height: float = 6.0, columns: int | None = None, share_y: bool = False, share_x: bool = False
    ) -> tuple[Figure, list[Axes]]:
        """A figure with `count` axes, each `height` cm high, side by side on a page and stacked on a phone."""
        from matplotlib.figure import Figure

        across = 1 if self.narrow else (columns or count)
        down = -(-count // across)
        with look():
            figure = Figure(figsize=(self.width / 2.54, height * down / 2.54), layout="constrained")
            grid = figure.subplots(down, across, squeeze=False, sharey=share_y, sharex=share_x)
        axes = list(grid.ravel())
        for extra in axes[count:]:
            extra.remove()
        return figure, axes[:count]

    def legend(self, figure: Figure, axes: Axes) -> None:
        """One legend for the whole figure, above its panels, in as many columns as its longest label leaves room for."""
        handles, labels = axes.get_legend_handles_labels()
        if handles:
            column = 1.5 + 0.17 * max(map(len, labels))  # cm: handle and gap, and eight points a letter
            figure.legend(handles, labels, loc="outside upper left", ncols=max(1, int(self.width / column)))


def look() -> Any:
    """The context in which figures are made and written."""
    import matplotlib as mpl

    return mpl.rc_context(_RC)


def smoothed(values: NDArray[np.float64], window: int | None = None) -> NDArray[np.float64]:
    """Running median over `window` epochs (default one fortieth of all, at least 3), as long as `values`."""
    size = window or max(3, len(values) // 40)
    half = size // 2
    return np.array([np.median(values[max(0, k - half) : k + half + 1]) for k in range(len(values))])


def readable(values: NDArray[np.float64], unit: str) -> tuple[NDArray[np.float64], str]:
    """`values` and their unit as people read them: MPa instead of millions of Pa, m/s, mm below a centimetre."""
    largest = float(np.abs(values).max(initial=0.0))
    if unit == "Pa" and largest >= 1e5:
        return values * 1e-6, "MPa"
    if unit in ("N", "J", "W") and largest >= 1e4:
        return values * 1e-3, f"k{unit}"
    if unit == "m" and 0 < largest < 0.02:
        return values * 1e3, "mm"
    return values, {"m s-1": "m/s", "degree": "°", "1": ""}.get(unit, unit)


def called(run: str) -> str:
    """A run's name within a sentence: `run 7`, but `run_07` as it is."""
    return run if run.lower().startswith("run") else f"run {run}"


def leading(drawn: int, rows: int, limit: int) -> str:
    """What a caption adds where at most `limit` models (Evaluation.leaders), here `drawn` of all `rows`, are drawn."""
    return "" if drawn == rows else f" Each model is drawn on its best level; at most {limit}, the most accurate, are."


def span(label: str, unit: str) -> str:
    """An axis label: what it is, and its unit where it has one."""
    return f"{label.replace('_', ' ')} ({unit})" if unit else label.replace("_", " ")


def short(value: float) -> str:
    """Two digits, for the end of a bar: 0.10, 3.1, 42, 310."""
    return f"{value:#.2g}".rstrip(".") if abs(value) < 99.5 else f"{value:.0f}"


def label_outer(ax: Any, row: int, column: int, labels: Sequence[str]) -> None:
    """Labels and ticks of one panel of a square of pairs: below the last row and left of the first column alone."""
    if row == len(labels) - 1:
        ax.set_xlabel(labels[column])
    else:
        ax.tick_params(labelbottom=False)
    if column == 0 and row > 0:
        ax.set_ylabel(labels[row])
    elif column > 0:
        ax.tick_params(labelleft=False)


def few_log_ticks(axis: Any) -> None:
    """Plain numbers at 1, 2 and 5 of each decade of a logarithmic axis, at decades alone where there are many."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    decades = np.log10(high / low) if low > 0 else 3.0
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if decades < 1.6 else (1.0,), numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
