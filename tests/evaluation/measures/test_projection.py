"""Projection on modes: its error, and what stands for nodes that are gone."""

from __future__ import annotations

import numpy as np
import pytest

from data_schema.pod import StreamedPod, pod
from evaluation.errors import EvaluationError
from evaluation.measures.projection import last_seen, moving, projection_error


def _runs(seed: int, count: int, states: int = 4, nodes: int = 7) -> list[np.ndarray]:
    return [r.astype(np.float32) for r in np.random.default_rng(seed).normal(size=(count, states, nodes, 3))]


def _stacked(runs: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([r.reshape(len(r), -1) for r in runs]).astype(np.float64)


def test_real_crashes_lose_nothing_worth_naming(reference):
    stream = StreamedPod(count=10, keep=40)
    for run in range(12):
        stream.add(reference.displacement(run))
    exact = np.linalg.svd(_stacked([reference.displacement(k) for k in range(12)]), compute_uv=False)[:10]
    np.testing.assert_allclose(stream.result().singular_values, exact, rtol=1e-4)


def test_projection_error_is_the_mean_distance_to_the_projection():
    run = _runs(3, 1)[0]
    modes = np.linalg.qr(np.random.default_rng(4).normal(size=(21, 3)))[0]
    errors = projection_error(run, modes)
    assert errors.shape == (3, 4)
    for r in range(3):
        v = modes[:, : r + 1]
        rest = (run.reshape(4, -1) - (run.reshape(4, -1) @ v) @ v.T).reshape(run.shape)
        np.testing.assert_allclose(errors[r], np.linalg.norm(rest, axis=-1).mean(axis=1), rtol=1e-4)


def test_all_modes_of_a_run_project_it_on_itself():
    run = _runs(5, 1)[0]
    stream = StreamedPod(count=4)
    stream.add(run)
    assert projection_error(run, stream.result().modes)[-1].max() < 1e-5 * np.abs(run).max()


def test_projecting_leaves_the_run_as_it_was():
    run = _runs(6, 1)[0]
    before = run.copy()
    projection_error(run, np.linalg.qr(np.ones((21, 1)))[0])
    np.testing.assert_array_equal(run, before)


def test_nodes_that_are_gone_stay_where_they_were_last_seen():
    u = np.arange(24, dtype=float).reshape(4, 2, 3)
    u[2:, 1] = np.nan
    filled = last_seen(u)
    np.testing.assert_array_equal(filled[2, 1], u[1, 1])
    np.testing.assert_array_equal(filled[3, 1], u[1, 1])
    np.testing.assert_array_equal(filled[:, 0], u[:, 0])


def test_gone_nodes_take_no_part_in_the_projection_error(eroded, reference):
    whole = projection_error(reference.displacement(0)[:, 50:], np.eye(3 * (reference.n_nodes - 50), 1))
    stream_modes = np.zeros((3 * reference.n_nodes, 1))
    stream_modes[150, 0] = 1.0
    masked = projection_error(eroded.displacement(0), stream_modes)
    np.testing.assert_allclose(masked[0, 2:], whole[0, 2:], rtol=1e-5)


def test_modes_of_another_mesh_are_an_error():
    with pytest.raises(EvaluationError, match="modes have 2 nodes and the run 3"):
        projection_error(np.ones((1, 3, 3)), np.ones((6, 1)))


def test_states_in_which_nothing_moves_are_an_error():
    still = pod([np.zeros((2, 3, 3))], 2)
    with pytest.raises(EvaluationError, match="nothing moves"):
        moving(still)
