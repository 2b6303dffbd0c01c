"""The figures: one file each, put in order here.

A figure file has a frozen dataclass of plain arrays with `numbers()`, `draw(sheet)` and `caption()`, and at its
foot `FIGURE = Kind(name, title, select)`, where `select` takes the arrays out of an Evaluation, or returns None
where the figure has nothing to show. A new figure is one file and one name in `ORDER`; one of another package is
given to `register`, or named under the entry points `crashkit.figures`.
"""

from __future__ import annotations

import functools
import importlib
import logging
from collections.abc import Iterator, Sequence
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from evaluation.drawing.style import Sheet, styles
from evaluation.errors import EvaluationError
from evaluation.figures.kind import Drawing, Kind

if TYPE_CHECKING:
    from evaluation.comparison.result import Evaluation

# The order in which a reader wants them: how good, where not, why, at what price, on which data.
ORDER = (
    "error_over_time",
    "floors",
    "worst",
    "map",
    "parameters",
    "folds",
    "parts",
    "regions",
    "rigid",
    "intrusion",
    "part_intrusion",
    "removal",
    "element_fields",
    "numbers",
    "histories",
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

ENTRY_POINT_GROUP = "crashkit.figures"

__all__ = ["ENTRY_POINT_GROUP", "ORDER", "Drawing", "Kind", "Sheet", "drawings", "kinds", "register", "styles"]

_log = logging.getLogger(__name__)
_FURTHER: dict[str, Kind] = {}


def register(kind: Kind) -> None:
    """Show `kind` in every report after the figures of `ORDER`; a later one replaces an earlier one of the same name.

    Raises
    ------
    EvaluationError
        Where a figure of `ORDER` has this name.
    """
    if kind.name in ORDER:
        raise EvaluationError(f"the report has a figure {kind.name!r} already; give yours another name")
    _FURTHER[kind.name] = kind


@functools.cache
def _load_entry_points() -> None:
    """Register the figures of other packages, once a process."""
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        try:
            register(entry.load())
        except Exception as error:  # whatever it is, our own figures can be drawn without it
            _log.warning("figure %s (%s) cannot be loaded: %s", entry.name, entry.value, error)


def kinds(names: Sequence[str] | None = None) -> list[Kind]:
    """The figures called `names`; default: those of `ORDER`, then the registered ones."""
    _load_entry_points()
    return [
        _FURTHER[name] if name in _FURTHER else importlib.import_module(f"evaluation.figures.{name}").FIGURE
        for name in ((*ORDER, *_FURTHER) if names is None else names)
    ]


def drawings(evaluation: Evaluation, names: Sequence[str] | None = None) -> Iterator[tuple[Kind, Drawing]]:
    """Every figure, or those called `names`, that has something to show of `evaluation`."""
    for kind in kinds(names):
        drawing = kind.select(evaluation)
        if drawing is not None:
            yield kind, drawing


def sheet_of(evaluation: Evaluation, width: float = 17.0) -> Sheet:
    """A sheet on which every model of `evaluation` has its own style."""
    return Sheet(width, styles([entry.label for entry in evaluation.entries]))
