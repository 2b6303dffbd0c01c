"""Tables against the scores they are made of."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest

from evaluation.errors import EvaluationError
from evaluation.figures.kind import to_csv
from evaluation.report import tables


def test_performance_has_a_row_for_each_level_and_baseline(evaluation):
    rows = tables.performance(evaluation)
    assert [r.model for r in rows] == ["MH1", "MH2", "MH3", "PODNN", "POD-GPR"]
    assert [r.nodes for r in rows] == [150, 50, 15, 2400, 2400]
    for row in rows:
        assert row.error_cm == pytest.approx(100 * evaluation.scores[row.model].mean)
        assert row.pod_floor_cm == pytest.approx(100 * evaluation.floor_at(row.latent))
        assert row.worst_run_cm == pytest.approx(100 * evaluation.scores[row.model].of_runs.max())
        assert row.peak_cm == pytest.approx(100 * evaluation.scores[row.model].peak_value.max())
        assert row.reduction_cm == pytest.approx(100 * evaluation.scores[row.model].reduction)
        assert row.prediction_ms > 0
    assert [r.lifting_cm > 0 for r in rows] == [True, True, True, False, False]


def test_the_worst_places_are_where_the_error_is_largest(reference, models, evaluation):
    table = tables.worst_places(evaluation)
    row = table["model"].index("PODNN")
    predictor = models[1].predictors[0]
    distance = {
        run: np.linalg.norm(
            reference.displacement(run) - predictor.predict(reference.parameters[run], reference.time), axis=-1
        )
        for run in (9, 10, 11)
    }
    run = max(distance, key=lambda r: distance[r].max())
    state, node = np.unravel_index(distance[run].argmax(), distance[run].shape)
    assert table["peak_run"][row] == reference.runs[run]
    assert table["peak_node"][row] == reference.node_id[node]
    assert table["peak_time_ms"][row] == pytest.approx(1000 * reference.time[state])
    assert table["peak_cm"][row] == pytest.approx(100 * distance[run].max(), rel=1e-5)
    assert table["worst_run"][row] == reference.runs[max(distance, key=lambda r: distance[r].mean())]
    assert table["peak_part"][row] in ("rear", "front")


def test_the_split_says_what_each_run_was_for(evaluation):
    roles = dict(zip(*tables.split(evaluation).values(), strict=True))
    assert roles == {
        **{f"run_{k:02d}": "training" for k in range(8)},
        "run_08": "validation",
        **{f"run_{k:02d}": "test" for k in range(9, 12)},
    }


def test_runs_carry_their_parameters_and_errors(reference, evaluation):
    table = tables.of_runs(evaluation)
    assert table["impact_speed (m s-1)"] == list(reference.parameters[9:, 0])
    np.testing.assert_allclose(table["MH1 (cm)"], 100 * evaluation.scores["MH1"].of_runs)


def test_csv_leaves_missing_numbers_empty():
    text = to_csv({"a": [1.0, float("nan")], "b, c": ["x", None]})
    assert list(csv.reader(io.StringIO(text))) == [["a", "b, c"], ["1", "x"], ["", ""]]


def test_columns_of_different_length_are_an_error():
    with pytest.raises(EvaluationError, match="different length"):
        to_csv({"a": [1], "b": [1, 2]})
