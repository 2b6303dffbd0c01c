"""Error of each region of the structure: boxes along its two longest sides."""

from __future__ import annotations

from typing import TYPE_CHECKING

from evaluation.figures.kind import Kind
from evaluation.figures.parts import ErrorOfGroups, groups_of

if TYPE_CHECKING:
    from evaluation.result import Evaluation


def select(evaluation: Evaluation) -> ErrorOfGroups | None:
    return groups_of(evaluation, "region")


FIGURE = Kind("regions", "Error by region", select)
