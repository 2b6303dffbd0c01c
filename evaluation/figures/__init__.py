"""The figures: one file each, put in order here.

A figure file has a frozen dataclass of plain arrays with `numbers()`, `draw(sheet)` and `caption()`, and at its
foot `FIGURE = Kind(name, title, select)`, where `select` takes the arrays out of an Evaluation, or returns None
where the figure has nothing to show. A new figure is one file and one name in `ORDER`.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from evaluation.figures.kind import Drawing, Kind
from evaluation.figures.style import Sheet, styles

if TYPE_CHECKING:
    from evaluation.result import Evaluation

# The order in which a reader wants them: how good, where not, why, at what price, on which data.
ORDER = (
    "error_over_time",
    "floors",
    "worst",
    "map",
    "parameters",
    "parts",
    "regions",
    "rigid",
    "intrusion",
    "probes",
    "ratings",
    "levels",
    "contributions",
    "history",
    "budgets",
    "singular_values",
    "coverage",
    "meshes",
    "paraview",
)

__all__ = ["ORDER", "Drawing", "Kind", "Sheet", "drawings", "kinds", "styles"]


def kinds(names: Sequence[str] = ORDER) -> list[Kind]:
    """The registered figures."""
    return [importlib.import_module(f"evaluation.figures.{name}").FIGURE for name in names]


def drawings(evaluation: Evaluation, names: Sequence[str] = ORDER) -> Iterator[tuple[Kind, Drawing]]:
    """Every figure that has something to show of `evaluation`."""
    for kind in kinds(names):
        drawing = kind.select(evaluation)
        if drawing is not None:
            yield kind, drawing


def sheet_of(evaluation: Evaluation, width: float = 17.0) -> Sheet:
    """A sheet on which every model of `evaluation` has its own style."""
    return Sheet(width, styles([entry.label for entry in evaluation.entries]))
