"""Error of each region of the structure: boxes along its two longest sides."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from evaluation.figures.kind import Kind
from evaluation.figures.parts import ErrorOfGroups, groups_of

if TYPE_CHECKING:
    from evaluation.comparison.result import Evaluation


def select(evaluation: Evaluation) -> ErrorOfGroups | None:
    found = groups_of(evaluation, "region")
    low, high = evaluation.reference.position.min(axis=0), evaluation.reference.position.max(axis=0)
    sides = ", ".join(f"{axis} from {a:.2f} to {b:.2f} m" for axis, a, b in zip("xyz", low, high, strict=True))
    about = f" Regions are boxes of equal size, counted from the lowest coordinate; the structure reaches over {sides}."
    return None if found is None else replace(found, about=about)


FIGURE = Kind("regions", "Error by region", select)
