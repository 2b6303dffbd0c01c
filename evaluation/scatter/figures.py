"""The figures of a scatter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evaluation.drawing.style import CM, GRID, INK, MS, Sheet, readable, short, span
from evaluation.figures.kind import Columns, Drawing, Kind
from evaluation.scatter.result import LimitKept, Number, ScatterResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLUE, ORANGE = "#0072B2", "#D55E00"
_GROUPS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
# Numbers and parts shown in a figure, points of a cloud.
_NUMBERS, _PARTS, _POINTS = 6, 16, 3000


@dataclass(frozen=True)
class Distributions:
    """Histogram of each number, with its limits."""

    result: ScatterResult

    @property
    def shown(self) -> tuple[Number, ...]:
        return self.result.numbers[:_NUMBERS]

    def numbers(self) -> Columns:
        shares = np.round(np.linspace(0.01, 0.99, 99), 2)
        columns: dict[str, Any] = {"share": list(shares)}
        for number in self.result.numbers:
            columns[f"{number.name} ({number.unit})"] = list(number.quantiles(shares))
        return columns

    def draw(self, sheet: Sheet) -> Figure:
        from matplotlib.ticker import MaxNLocator

        figure, axes = sheet.panels(len(self.shown), height=5.4, columns=min(3, len(self.shown)))
        for ax, number in zip(axes, self.shown, strict=True):
            values, unit = readable(number.values[np.isfinite(number.values)], number.unit)
            factor = _factor(number, unit)
            ax.hist(values, bins=min(60, max(20, len(values) // 50)), color=BLUE, alpha=0.8)
            ax.axvline(number.nominal * factor, color=INK, linewidth=1.2)
            for limit in self._limits(number):
                ax.axvline(limit.bound * factor, color=ORANGE, linewidth=1.4, linestyle="--")
            ax.set_xlabel(span(number.name, unit))
            ax.xaxis.set_major_locator(MaxNLocator(4))
            ax.set_yticks([])
            ax.grid(axis="y", visible=False)
            ax.spines["left"].set_visible(False)
        return figure

    def _limits(self, number: Number) -> list[LimitKept]:
        return [limit for limit in self.result.limits if limit.number == number.name]

    def caption(self) -> str:
        said = []
        for number in self.shown:
            low, high = number.quantiles([0.05, 0.95])
            (a, b, nominal), unit = readable(np.array([low, high, number.nominal]), number.unit)
            said.append(
                f"{span(number.name, '')} {a:.4g} to {b:.4g} {unit} in 90 % of the draws, {nominal:.4g} without scatter"
            )
        lines = "Black line: without scatter." + (" Dashed: limit." if self.result.limits else "")
        return f"Numbers over {len(self.result.draws)} draws: {'; '.join(said)}. {lines}"


@dataclass(frozen=True)
class Chances:
    """The probability of breaking each limit, with both doubts."""

    limits: tuple[LimitKept, ...]

    def numbers(self) -> Columns:
        found = [limit.probability for limit in self.limits]
        return {
            "limit": [limit.text for limit in self.limits],
            "probability": [p.value for p in found],
            "sampling_low": [p.sampling[0] for p in found],
            "sampling_high": [p.sampling[1] for p in found],
            "model_low": [p.model[0] if p.model else np.nan for p in found],
            "model_high": [p.model[1] if p.model else np.nan for p in found],
            "both_low": [p.both[0] for p in found],
            "both_high": [p.both[1] for p in found],
            "outside_trained_range": [limit.outside for limit in self.limits],
        }

    def draw(self, sheet: Sheet) -> Figure:
        figure, (ax,) = sheet.panels(1, height=2.2 + 1.3 * len(self.limits))
        for y, limit in enumerate(reversed(self.limits)):
            p = limit.probability
            ax.plot([100 * v for v in p.both], [y, y], color=GRID, linewidth=9, solid_capstyle="butt")
            if p.model is not None:
                ax.plot([100 * v for v in p.model], [y + 0.16] * 2, color=ORANGE, linewidth=2.4)
            ax.plot([100 * v for v in p.sampling], [y - 0.16] * 2, color=BLUE, linewidth=2.4)
            ax.plot(100 * p.value, y, "o", color=INK, markersize=6)
        ax.set_yticks(range(len(self.limits)), [limit.text for limit in reversed(self.limits)])
        ax.set_ylim(-0.6, len(self.limits) - 0.4)
        ax.set_xlim(left=0)
        ax.grid(axis="y", visible=False)
        ax.set_xlabel("probability of breaking the limit (%)")
        return figure

    def caption(self) -> str:
        said = []
        for limit in self.limits:
            p = limit.probability
            low, high = (100 * v for v in p.both)
            said.append(f"{limit.text} is broken in {100 * p.value:.2f} % of the draws ({low:.2f} to {high:.2f} %)")
        first = self.limits[0].probability
        model = " orange: by what the model may be wrong;" if first.model is not None else ""
        return (
            f"{'; '.join(said)}. Intervals of {100 * first.confidence:.0f} %: blue: for the number of draws;{model} grey: "
            "both together."
        )


@dataclass(frozen=True)
class Influence:
    """Sobol indices of each number."""

    result: ScatterResult

    def numbers(self) -> Columns:
        found, names = self.result.indices, [s.name for s in self.result.scatter]
        rows = [
            (
                number.name, name, found.first[i, k], *found.first_interval[i, k], found.total[i, k],
                *found.total_interval[i, k],
            )
            for i, number in enumerate(self.result.numbers)
            for k, name in enumerate(names)
        ]  # fmt: skip
        heads = ("number", "parameter", "first", "first_low", "first_high", "total", "total_low", "total_high")
        return dict(zip(heads, zip(*rows, strict=True), strict=True))

    def draw(self, sheet: Sheet) -> Figure:
        shown, names = self.result.numbers[:_NUMBERS], [s.name.replace("_", " ") for s in self.result.scatter]
        across = min(3, len(shown))
        figure, axes = sheet.panels(len(shown), height=2.0 + 0.75 * len(names), columns=across, share_x=True)
        found, at = self.result.indices, np.arange(len(names))[::-1]
        for i, (ax, number) in enumerate(zip(axes, shown, strict=True)):
            for shift, values, interval, colour, label in (
                (0.18, found.total, found.total_interval, ORANGE, "total"),
                (-0.18, found.first, found.first_interval, BLUE, "alone"),
            ):
                ax.barh(at + shift, values[i], height=0.32, color=colour, label=label)
                ax.plot(interval[i].T, [at + shift] * 2, color=INK, linewidth=0.9)
            ax.set_yticks(at, names)
            if i % across and not sheet.narrow:
                ax.tick_params(labelleft=False)
            ax.set_xlim(0, 1.08)
            ax.grid(axis="y", visible=False)
            ax.set_title(number.name.replace("_", " "))
            ax.set_xlabel("share of the variance")
        sheet.legend(figure, axes[0])
        return figure

    def caption(self) -> str:
        found, names = self.result.indices, [s.name.replace("_", " ") for s in self.result.scatter]
        said = []
        for i, number in enumerate(self.result.numbers[:_NUMBERS]):
            k = int(np.argmax(found.total[i]))
            if found.total[i, k] > 0:
                said.append(f"{span(number.name, '')} by {names[k]} ({100 * found.total[i, k]:.0f} %)")
        what = f"Most of the scatter is made, of {', '.join(said)}. " if said else "No number changes. "
        return (
            f"{what}Alone: the share of a number's variance that a parameter's scatter makes by itself; total: with all it "
            f"does together with the others. Sobol indices from {found.runs} predictions, lines: 90 % bootstrap intervals."
        )


@dataclass(frozen=True)
class Beginnings:
    """Scatter by part and time, and where it is new."""

    result: ScatterResult

    def _order(self) -> NDArray[np.intp]:
        largest = self.result.differences.scatter.max(axis=1)
        return np.argsort(-largest, kind="stable")[:_PARTS]

    def numbers(self) -> Columns:
        d = self.result.differences
        parts, states = d.scatter.shape
        return {
            "part": [name for name in d.names for _ in range(states)],
            "time_ms": list(np.tile(d.time * MS, parts)),
            "scatter_cm": list(d.scatter.ravel() * CM),
            "new_cm": list(d.new.ravel() * CM),
        }

    def draw(self, sheet: Sheet) -> Figure:
        d, order = self.result.differences, self._order()
        figure, axes = sheet.panels(2, height=2.4 + 0.55 * len(order), share_y=not sheet.narrow)
        for ax, values, title, colours in (
            (axes[0], d.scatter, "scatter (cm)", "viridis"),
            (axes[1], d.new, "new scatter (cm)", "inferno_r"),
        ):
            self._map(ax, figure, values[order] * CM, title, colours)
            ax.set_yticks(range(len(order)), [d.names[k] for k in order])
        for y, k in enumerate(order):
            if np.isfinite(d.begin[k]):
                axes[0].plot(d.begin[k] * MS, y, "|", color="white", markersize=11, markeredgewidth=2.2)
        return figure

    def _map(self, ax: Axes, figure: Figure, values: NDArray[np.float64], title: str, colours: str) -> None:
        time = self.result.differences.time * MS
        edges = np.concatenate([[time[0]], (time[1:] + time[:-1]) / 2, [time[-1]]]) if len(time) > 1 else [0.0, 1.0]
        shown = ax.pcolormesh(edges, np.arange(len(values) + 1) - 0.5, values, cmap=colours, vmin=0, rasterized=True)
        ax.set_ylim(len(values) - 0.5, -0.5)
        ax.grid(visible=False)
        ax.set_xlabel("time (ms)")
        ax.set_title(title)
        bar = figure.colorbar(shown, ax=ax, pad=0.02, aspect=30)
        bar.outline.set_visible(False)

    def caption(self) -> str:
        d = self.result.differences
        part, state = d.source
        begun = [k for k in self._order() if np.isfinite(d.begin[k])]
        first = min(begun, key=lambda k: float(d.begin[k])) if begun else None
        start = (
            f"Runs begin to differ in {d.names[first]}, from {d.begin[first] * MS:.1f} ms on. "
            if first is not None
            else ""
        )
        return (
            f"{start}Most new scatter appears in {d.names[part]} at {d.time[state] * MS:.1f} ms. Left: root mean square "
            "distance of the draws from their mean, by part and time; white marks: where it exceeds 5 % of the largest. "
            "Right: what of it no scatter of any part a tenth of the time earlier explains: where something new happens."
        )


@dataclass(frozen=True)
class Folding:
    """Draws by their shape at the end."""

    result: ScatterResult

    def numbers(self) -> Columns:
        f = self.result.folding
        columns: dict[str, Any] = {"draw": list(range(len(f.group))), "group": [int(g) + 1 for g in f.group]}
        for k in range(min(3, f.scores.shape[1])):
            columns[f"component_{k + 1}_cm"] = list(f.scores[:, k] * CM)
        return columns

    def draw(self, sheet: Sheet) -> Figure:
        f = self.result.folding
        figure, axes = sheet.panels(2, height=6.4)
        some = np.random.default_rng(0).permutation(len(f.group))[:_POINTS]
        second = f.scores[:, 1] if f.scores.shape[1] > 1 else np.zeros(len(f.scores))
        strongest = int(np.argmax(self.result.indices.total.max(axis=0)))
        one = self.result.scatter[strongest]
        values, unit = readable(self.result.draws[:, strongest], one.unit)
        for group in range(f.count):
            mine = some[f.group[some] == group]
            style: dict[str, Any] = {
                "linestyle": "none",
                "marker": ".",
                "markersize": 3,
                "color": _GROUPS[group],
                "alpha": 0.5,
            }
            axes[0].plot(f.scores[mine, 0] * CM, second[mine] * CM, **style)
            axes[1].plot(values[mine], f.scores[mine, 0] * CM, **style)
            at = f.typical[group]
            if f.count > 1:
                axes[0].plot(
                    f.scores[at, 0] * CM, second[at] * CM, "o", color=_GROUPS[group], markersize=8,
                    markeredgecolor="white", label=f"mode {group + 1}",
                )  # fmt: skip
        axes[0].set_xlabel("first component of the shape (cm)")
        axes[0].set_ylabel("second component (cm)")
        axes[1].set_xlabel(span(one.name, unit))
        axes[1].set_ylabel("first component (cm)")
        if f.count > 1:
            sheet.legend(figure, axes[0])
        return figure

    def caption(self) -> str:
        f = self.result.folding
        if f.count == 1:
            return (
                "Every dot is a draw, by the shape in which it ends, without rigid motion. They form one group: no draw folds "
                "in another way than its neighbours, as far as this model knows."
            )
        shares = ", ".join(f"mode {k + 1} {100 * np.mean(f.group == k):.1f} %" for k in range(f.count))
        return (
            f"Every dot is a draw, by the shape in which it ends, without rigid motion. They form {f.count} groups: "
            f"{shares}. The large dots are typical draws; they stand beside this page as ParaView files."
        )


@dataclass(frozen=True)
class Inputs:
    """The draws against the trained ranges."""

    result: ScatterResult

    def numbers(self) -> Columns:
        rows = []
        for k, one in enumerate(self.result.scatter):
            low, high = self.result.ranges[one.name]
            beyond = float(np.mean((self.result.draws[:, k] < low) | (self.result.draws[:, k] > high)))
            rows.append((one.name, one.unit, one.shape, one.nominal, one.width, low, high, beyond))
        heads = ("parameter", "unit", "shape", "nominal", "width", "trained_low", "trained_high", "share_outside")
        return dict(zip(heads, zip(*rows, strict=True), strict=True))

    def draw(self, sheet: Sheet) -> Figure:
        shown = self.result.scatter
        figure, axes = sheet.panels(len(shown), height=4.2, columns=min(4, len(shown)))
        for k, (ax, one) in enumerate(zip(axes, shown, strict=True)):
            values, unit = readable(self.result.draws[:, k], one.unit)
            factor = float(values[0] / self.result.draws[0, k]) if self.result.draws[0, k] else 1.0
            low, high = (factor * v for v in self.result.ranges[one.name])
            ax.axvspan(low, high, color="#e8f1ea", zorder=0)
            ax.hist(values, bins=40, color=BLUE, alpha=0.8)
            ax.set_xlim(min(low, float(values.min())), max(high, float(values.max())))
            ax.set_xlabel(span(one.name, unit))
            ax.set_yticks([])
            ax.grid(visible=False)
        return figure

    def caption(self) -> str:
        inside = 100 * float(np.mean(self.result.inside))
        return f"What was drawn, and in green the trained range: {inside:.1f} % of the draws lie within it in all parameters."


@dataclass(frozen=True)
class Picture:
    """A field of the last state on the mean shape: values (node,) with their label; NaN is grey."""

    result: ScatterResult
    values: NDArray[np.floating]
    label: str
    about: str
    name: str

    def numbers(self) -> Columns:
        order = np.argsort(-np.nan_to_num(self.values, nan=-1.0), kind="stable")[:100]
        return {
            "node": [int(n) for n in order],
            **{f"{axis}_m": list(self.result.position[order, k]) for k, axis in enumerate("xyz")},
            self.name: [float(v) for v in self.values[order]],
        }

    def draw(self, sheet: Sheet) -> Figure:
        from evaluation.drawing.pictures import ERROR, field_picture

        result = self.result
        return field_picture(
            result.position,
            result.faces,
            result.mean[-1],
            self.values,
            self.label,
            sheet,
            colours=ERROR,
        )

    def caption(self) -> str:
        return self.about


def drawings(result: ScatterResult) -> list[tuple[Kind, Drawing]]:
    """The figures of a scatter, in their order."""
    out: list[tuple[str, str, Drawing, bool]] = [
        ("numbers", "Distribution of the numbers", Distributions(result), False)
    ]
    if result.limits:
        out.append(("limits", "Probability of the limits", Chances(result.limits), False))
    out.append(("influence", "Which parameter makes the scatter", Influence(result), False))
    out.append(("differences", "Where and when runs begin to differ", Beginnings(result), False))
    out.append(("folding", "Folding modes", Folding(result), False))
    widest = result.deviation[-1] * CM
    out.append(
        (
            "deviation",
            "Scatter of every node at the end",
            Picture(
                result, widest, "deviation (cm)",
                f"Standard deviation of every node over the draws at the last state, on the mean shape: up to "
                f"{short(float(np.nanmax(widest)))} cm.", "deviation_cm",
            ),
            True,
        )
    )  # fmt: skip
    for k, limit in enumerate(found for found in result.limits if found.ever is not None):
        assert limit.ever is not None
        about = f"Probability of every node to break {limit.text} at any time: up to {100 * float(np.nanmax(limit.ever)):.1f} %."
        out.append(
            (
                f"probability_{k + 1}",
                f"Where {limit.text} is broken",
                Picture(result, 100 * limit.ever, "probability (%)", about, "probability_percent"),
                True,
            )
        )
    out.append(("inputs", "What was drawn", Inputs(result), False))
    return [(Kind(name, title, lambda _, d=d: d, raster), d) for name, title, d, raster in out]  # type: ignore[misc]


def _factor(number: Number, unit: str) -> float:
    """What SI values are multiplied with to be in the unit in which the number is shown."""
    largest = float(np.nanmax(np.abs(number.values), initial=0.0))
    if not largest or unit == number.unit:
        return 1.0
    return float(readable(np.array([largest]), number.unit)[0][0] / largest)
