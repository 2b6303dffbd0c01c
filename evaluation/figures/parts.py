"""Error of each group of nodes: parts of the model, regions of the mesh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from evaluation.drawing.style import CM, INK, Sheet
from evaluation.figures.kind import Columns, Kind
from evaluation.measures.distance import masked_mean

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation

_SHOWN = 16


@dataclass(frozen=True)
class ErrorOfGroups:
    """what is grouped ("part"), names (group,), size (group,) m, errors: model -> (group,) m."""

    what: str
    names: tuple[str, ...]
    size: NDArray[np.float64]
    errors: Mapping[str, NDArray[np.float64]]
    about: str = ""

    label: ClassVar[str] = "mean node error (cm)"
    verb: ClassVar[str] = "moves"
    columns: ClassVar[tuple[str, str]] = ("mean_displacement_cm", "mean_node_error_cm")

    def numbers(self) -> Columns:
        columns: dict[str, list[object]] = {self.what: list(self.names), self.columns[0]: list(self.size * CM)}
        for model, errors in self.errors.items():
            columns[f"{model} {self.columns[1]}"] = list(errors * CM)
        return columns

    def _order(self) -> NDArray[np.intp]:
        worst = np.nanmax(np.nan_to_num(np.array(list(self.errors.values())), nan=-1.0), axis=0)
        return np.argsort(-worst, kind="stable")[:_SHOWN]

    def draw(self, sheet: Sheet) -> Figure:
        order = self._order()
        figure, (ax,) = sheet.panels(1, height=2.4 + max(0.75, 0.12 * len(self.errors)) * len(order))
        at = np.arange(len(order))[::-1]
        for k, (model, errors) in enumerate(self.errors.items()):
            style = sheet.style(model)
            shift = (k - (len(self.errors) - 1) / 2) * -0.7 / max(1, len(self.errors))
            ax.plot(
                errors[order] * CM, at + shift, linestyle="none", marker=style.marker, color=style.colour, label=model,
                markersize=5.5, markeredgewidth=0,
            )  # fmt: skip
        for y in at[::2]:
            ax.axhspan(y - 0.5, y + 0.5, color="#f4f4f4", zorder=0)
        ax.set_yticks(at, [self.names[k] for k in order])
        ax.set_ylim(-0.6, len(order) - 0.4)
        ax.grid(axis="y", visible=False)
        ax.set_xlim(left=0)
        ax.set_xlabel(self.label)
        sheet.legend(figure, ax)
        for y, k in zip(at, order, strict=True):
            ax.text(
                1.01, y, f"{self.verb} {self.size[k] * CM:.1f} cm", transform=ax.get_yaxis_transform(), ha="left",
                va="center", fontsize=7, color=INK, alpha=0.65,
            )  # fmt: skip
        ax.margins(x=0.25)
        return figure

    def caption(self) -> str:
        best = min(self.errors, key=lambda m: float(np.nanmean(self.errors[m])))
        errors = self.errors[best]
        high = int(np.nanargmax(errors))
        shown = f" The {_SHOWN} worst of {len(self.names)} are shown." if len(self.names) > _SHOWN else ""
        return (
            f"Mean node error within each {self.what}, beside how far the {self.what} moves on average. With {best}, "
            f"{self.names[high]} is the worst with {errors[high] * CM:.2f} cm. A {self.what} whose error is near "
            f"its own motion "
            f"is not predicted at all, however small its share in the mean over all nodes.{shown}{self.about}"
        )


def groups_of(evaluation: Evaluation, what: str) -> ErrorOfGroups | None:
    """The errors of one grouping of `evaluation`; None where there are fewer than two groups."""
    names = evaluation.group_names.get(what, ())
    if len(names) < 2:
        return None
    return ErrorOfGroups(
        what,
        names,
        masked_mean(np.array([r.group_size[what] for r in evaluation.runs]), axis=0),
        {e.label: masked_mean(evaluation.scores[e.label].groups[what], axis=(0, 1)) for e in evaluation.entries},
    )


def select(evaluation: Evaluation) -> ErrorOfGroups | None:
    return groups_of(evaluation, "part")


FIGURE = Kind("parts", "Error by part", select)
