"""The share of test runs within a model's own band, beside its nominal value."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evaluation.comparison.result import compare
from evaluation.comparison.scoring import score_run
from evaluation.comparison.split import Split
from evaluation.report import tables


class WithBand:
    """A predictor and the band it claims, m: one number for every node and state."""

    def __init__(self, predictor, width):
        self.__dict__.update(vars(predictor))
        self._predictor, self._width = predictor, width

    def predict(self, parameters, time):
        return self._predictor.predict(parameters, time)

    def reconstruct(self, displacement):
        return self._predictor.reconstruct(displacement)

    def half_width(self, share, time, parameters):
        assert share == 0.9
        return None if self._width is None else np.full((len(time), 1), self._width, np.float32)


@pytest.mark.parametrize("quantile", [0.3, 0.9])
def test_the_share_is_that_of_nodes_and_states_nearer_than_the_band(reference, models, quantile):
    predictor = next(p for p in models[0].predictors if p.level == 1)
    coarse = predictor.predict(reference.parameters[9], reference.time)
    full = np.stack([reference.level(1).to_full @ state for state in coarse])
    distance = np.linalg.norm(reference.displacement(9) - full, axis=-1)
    banded = WithBand(predictor, np.quantile(distance, quantile))
    found = score_run(reference, {(0, 0): banded}, 9).scores[0, 0].covered
    assert found == pytest.approx(quantile, abs=2 / distance.size + 1e-3)


@pytest.mark.parametrize("wrap", [lambda p: p, lambda p: WithBand(p, None)], ids=["no band", "no validation runs"])
def test_without_a_band_there_is_no_share(reference, models, wrap):
    assert np.isnan(score_run(reference, {(0, 0): wrap(models[0].predictors[0])}, 9).scores[0, 0].covered)


def test_nodes_that_are_gone_do_not_count(reference, models):
    predictor = next(p for p in models[0].predictors if p.level == 1)
    truth = reference.displacement(9).copy()
    truth[:, 5:] = np.nan
    gone = replace(reference, displacement=lambda run: truth)
    assert score_run(gone, {(0, 0): WithBand(predictor, 1e6)}, 9).scores[0, 0].covered == 1.0


def test_the_performance_table_has_the_mean_over_test_runs(reference, models):
    banded = replace(models[0], predictors=tuple(WithBand(p, 0.02) for p in models[0].predictors))
    result = compare(reference, (banded,), Split(test=(9, 10, 11), train=tuple(range(9))))
    for row in tables.performance(result):
        scores = [r.scores for r in result.runs]
        key = next(e.keys[0] for e in result.entries if e.label == row.model)
        assert row.covered == pytest.approx(np.mean([s[key].covered for s in scores]))
        assert 0 < row.covered <= 1
