"""Every measure against a plain formula, and what happens where nodes are gone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from evaluation.errors import EvaluationError
from evaluation.measures.distance import (
    group_error,
    largest_node_error,
    masked_mean,
    mean_node_error,
    node_distance,
    peak_error,
    quantile_node_error,
    relative_error,
)

fields = arrays(np.float32, (3, 4, 3), elements=st.floats(-5, 5, width=32))


@given(fields, fields)
def test_distance_and_mean_are_the_papers_formula(truth, prediction):
    expected = np.zeros((3, 4))
    for state in range(3):
        for node in range(4):
            d = truth[state, node].astype(float) - prediction[state, node].astype(float)
            expected[state, node] = (d[0] ** 2 + d[1] ** 2 + d[2] ** 2) ** 0.5
    distance = node_distance(truth, prediction)
    np.testing.assert_allclose(distance, expected, atol=1e-12)
    np.testing.assert_allclose(mean_node_error(distance), [row.sum() / 4 for row in expected], atol=1e-12)


@given(fields, fields, st.integers(0, 3), st.integers(0, 2))
def test_a_node_that_is_gone_changes_nothing_for_the_others(truth, prediction, node, state):
    truth, there = truth.copy(), np.ones(4, bool)
    truth[state:, node] = np.nan
    there[node] = False
    error = mean_node_error(node_distance(truth, prediction))
    without = mean_node_error(node_distance(truth[:, there], prediction[:, there]))
    np.testing.assert_allclose(error[state:], without[state:], atol=1e-12)


def test_a_state_without_nodes_gives_nan_and_not_zero():
    truth = np.zeros((2, 3, 3), np.float32)
    truth[1] = np.nan
    distance = node_distance(truth, np.ones_like(truth))
    assert mean_node_error(distance)[0] == pytest.approx(3**0.5)
    assert np.isnan(mean_node_error(distance)[1])
    assert np.isnan(largest_node_error(distance)[1])
    assert np.isnan(quantile_node_error(distance, 0.9)[1])


def test_sums_run_in_double_precision():
    truth = np.zeros((1, 200_000, 3), np.float32)
    prediction = np.zeros_like(truth)
    prediction[..., 0] = np.float32(0.1)
    # In single precision a running sum of this many values is off in its fourth digit.
    assert mean_node_error(node_distance(truth, prediction))[0] == pytest.approx(float(np.float32(0.1)), rel=1e-12)


def test_a_prediction_that_is_not_finite_is_an_error_that_names_the_place():
    truth = np.zeros((2, 3, 3), np.float32)
    prediction = truth.copy()
    prediction[1, 2, 0] = np.inf
    with pytest.raises(EvaluationError, match="not finite in state 1 at node 2"):
        node_distance(truth, prediction)


def test_different_shapes_are_an_error_that_names_both():
    with pytest.raises(EvaluationError, match=r"\(2, 3, 3\).*\(2, 4, 3\)"):
        node_distance(np.zeros((2, 3, 3)), np.zeros((2, 4, 3)))


@given(fields, fields)
def test_relative_error_is_a_quotient_of_norms_of_displacements(truth, prediction):
    size = np.linalg.norm(truth.astype(float))
    relative = relative_error(truth, node_distance(truth, prediction))
    if size == 0:
        assert np.isnan(relative)
    else:
        assert relative == pytest.approx(np.linalg.norm(truth.astype(float) - prediction) / size, rel=1e-6)


def test_predicting_no_motion_has_a_relative_error_of_one():
    truth = np.random.default_rng(0).normal(size=(4, 5, 3)).astype(np.float32)
    assert relative_error(truth, node_distance(truth, np.zeros_like(truth))) == pytest.approx(1.0)


@given(arrays(np.float64, (3, 6), elements=st.floats(0, 9)), st.floats(0, 1))
def test_quantile_largest_and_peak_agree_with_numpy(distance, q):
    distance[1, 2] = np.nan
    np.testing.assert_allclose(quantile_node_error(distance, q), np.nanquantile(distance, q, axis=1), atol=1e-12)
    np.testing.assert_array_equal(largest_node_error(distance), np.nanmax(distance, axis=1))
    peak = peak_error(distance)
    assert peak.value == np.nanmax(distance) == distance[peak.state, peak.node]


def test_peak_of_a_run_without_nodes_is_an_error():
    with pytest.raises(EvaluationError, match="gone in every state"):
        peak_error(np.full((2, 2), np.nan))


def test_group_error_counts_every_state_the_same():
    distance = np.array([[1.0, 3.0, 9.0], [np.nan, 5.0, 9.0]])
    assert group_error(distance, [np.array([0, 1]), np.array([2])]).tolist() == [(2.0 + 5.0) / 2, 9.0]
    assert np.isnan(group_error(distance, [np.array([], int)])).all()


def test_masked_mean_warns_of_nothing_and_knows_axes():
    values = np.array([[1.0, np.nan], [np.nan, np.nan]])
    np.testing.assert_array_equal(masked_mean(values, axis=1), [1.0, np.nan])
    assert masked_mean(values) == 1.0
