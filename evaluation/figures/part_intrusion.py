"""Largest intrusion of each part: how far the models miss it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from evaluation.comparison.sensors import largest_of_parts
from evaluation.figures.kind import Kind
from evaluation.figures.parts import ErrorOfGroups
from evaluation.measures.distance import masked_mean

if TYPE_CHECKING:
    from evaluation.comparison.result import Evaluation


class IntrusionOfParts(ErrorOfGroups):
    """errors: mean over runs of the difference of the largest intrusion, predicted and true; size: the true one."""

    label = "error of the largest intrusion (cm)"
    verb = "comes in"
    columns = ("mean_largest_intrusion_cm", "mean_error_of_largest_intrusion_cm")

    def caption(self) -> str:
        best = min(self.errors, key=lambda m: float(np.nanmean(self.errors[m])))
        errors = self.errors[best]
        high = int(np.nanargmax(errors))
        return (
            f"Largest intrusion of any node of each part, predicted against true, mean of the difference over test runs "
            f"({self.about}). With {best}, {self.names[high]} is missed most, by {errors[high] * 100:.2f} cm of "
            f"{self.size[high] * 100:.1f} cm."
        )


def select(evaluation: Evaluation) -> IntrusionOfParts | None:
    names = evaluation.reference.part_names
    truth = [r.watched.parts for r in evaluation.runs if r.watched is not None]
    if evaluation.sensors is None or len(names) < 2 or not truth:
        return None
    largest = np.array([largest_of_parts(t) for t in truth])
    if not np.isfinite(largest).any():
        return None
    errors = {
        e.label: masked_mean(np.abs(evaluation.scores[e.label].part_intrusion - largest), axis=(0, 1))
        for e in evaluation.entries
    }
    return IntrusionOfParts("part", names, masked_mean(largest, axis=0), errors, evaluation.sensors.about)


FIGURE = Kind("part_intrusion", "Intrusion by part", select)
