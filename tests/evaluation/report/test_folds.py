"""The pair of runs that is drawn where neighbouring runs go different ways."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evaluation.comparison.result import Evaluation
from evaluation.figures.folds import select


def test_the_worst_run_stands_beside_the_nearest_that_trained(evaluation: Evaluation) -> None:
    found = select(evaluation)
    assert found is not None
    reference = evaluation.reference
    assert found.pair[0] == "run_03"
    x = reference.parameters / np.ptp(reference.parameters[:8], axis=0)
    others = [k for k in range(8) if k != 3]
    nearest = others[int(np.linalg.norm(x[others] - x[3], axis=1).argmin())]
    assert found.pair[1] == reference.runs[nearest]
    np.testing.assert_array_equal(found.second, reference.displacement(nearest)[-1])
    apart = 100 * np.linalg.norm(reference.displacement(nearest)[-1] - reference.displacement(3)[-1], axis=-1).mean()
    assert f"{apart:.1f} cm apart on average" in found.caption()
    assert "3.10 cm when it was left out, 4.2 times the typical error" in found.caption()
    assert f"impact speed {reference.parameters[3, 0]:.4g} m s-1" in found.caption()


def test_without_such_runs_there_is_no_figure(evaluation: Evaluation) -> None:
    models = tuple(replace(model, hard={}) for model in evaluation.models)
    assert select(replace(evaluation, models=models)) is None
