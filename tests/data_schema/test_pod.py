"""POD of fields that come run by run, against numpy's singular value decomposition of all of them."""

from __future__ import annotations

import numpy as np
import plate
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from data_schema.pod import StreamedPod, pod


def runs(count: int = 6, seed: int = 0) -> np.ndarray:
    """(run, 7, 20, 3) with a decaying spectrum."""
    draw = np.random.default_rng(seed)
    modes = np.linalg.qr(draw.standard_normal((60, 12)))[0]
    values = draw.standard_normal((count, 7, 12)) * 0.6 ** np.arange(12)
    return (values @ modes.T).reshape(count, 7, 20, 3).astype(np.float32)


def test_modes_and_singular_values_are_numpys() -> None:
    states = runs()
    found = pod(iter(states), 5)
    _, values, modes = np.linalg.svd(states.reshape(-1, 60).astype(np.float64), full_matrices=False)
    np.testing.assert_allclose(found.singular_values, values[:5], rtol=1e-5)
    np.testing.assert_allclose(np.abs(found.modes.T @ modes[:5].T), np.eye(5), atol=1e-4)


@given(st.integers(1, 30), st.integers(0, 100))
def test_modes_are_orthonormal_and_projection_never_lengthens(count: int, seed: int) -> None:
    states = runs(3, seed)
    found = pod(iter(states), count)
    np.testing.assert_allclose(found.modes.T @ found.modes, np.eye(found.modes.shape[1]), atol=1e-4)
    projected = found.coefficients(states[0])
    assert np.linalg.norm(projected) <= np.linalg.norm(states[0]) * (1 + 1e-5)


def test_states_that_span_few_directions_give_few_modes() -> None:
    states = runs(4)
    flat = states[:, :, :1] * np.ones((1, 1, 20, 1), np.float32)  # all nodes move alike: at most 3 directions
    found = pod(iter(flat), 9)
    assert found.modes.shape == (60, 3)


def test_a_campaign_without_movement_projects_to_zero() -> None:
    found = pod(iter(np.zeros((2, 7, 20, 3), np.float32)), 4)
    assert found.singular_values.tolist() == [0.0]
    assert not found.modes.any()


def test_cutting_off_between_runs_costs_little() -> None:
    """Far more runs than are kept at once: the leading singular values still agree."""
    states = plate.displacement(plate.parameters(40, seed=3))
    noisy = states + 1e-3 * np.random.default_rng(0).standard_normal(states.shape).astype(np.float32)
    found = pod(iter(noisy), 3)
    exact = np.linalg.svd(noisy.reshape(-1, 243).astype(np.float64), compute_uv=False)[:3]
    np.testing.assert_allclose(found.singular_values, exact, rtol=1e-3)


def test_no_runs_are_an_error() -> None:
    with pytest.raises(ValueError, match="no runs"):
        pod(iter(()), 3)


def _runs(seed: int, count: int, states: int = 4, nodes: int = 7) -> list[np.ndarray]:
    return [r.astype(np.float32) for r in np.random.default_rng(seed).normal(size=(count, states, nodes, 3))]


def _stacked(runs: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([r.reshape(len(r), -1) for r in runs]).astype(np.float64)


@settings(max_examples=20)
@given(st.integers(0, 10**6), st.integers(1, 5))
def test_streaming_gives_what_all_at_once_gives(seed, count):
    runs = _runs(seed, count)
    stream = StreamedPod(count=21)
    for run in runs:
        stream.add(run)
    found = stream.result()
    _, values, vt = np.linalg.svd(_stacked(runs), full_matrices=False)
    np.testing.assert_allclose(found.singular_values, values[: len(found.singular_values)], rtol=1e-4)
    # Modes are only fixed up to their sign (and rotation where values are close): compare what they span.
    span = found.modes.astype(np.float64)
    np.testing.assert_allclose(span @ span.T, vt.T @ vt, atol=2e-4)


@settings(max_examples=20)
@given(st.integers(0, 10**6), st.integers(2, 6))
def test_what_truncation_takes_away_is_bounded_by_the_defect(seed, keep):
    runs = _runs(seed, 6)
    stream = StreamedPod(count=2, keep=keep)
    for run in runs:
        stream.add(run)
    found = stream.result()
    exact = np.linalg.svd(_stacked(runs), compute_uv=False)[:2] ** 2
    assert (found.singular_values**2 <= exact * (1 + 1e-5)).all()
    assert (exact <= (found.singular_values**2 + found.defect) * (1 + 1e-5)).all()


def test_runs_on_different_meshes_are_an_error():
    stream = StreamedPod(2)
    stream.add(np.ones((2, 3, 3)))
    with pytest.raises(ValueError, match="run of 4 nodes follows runs of 3"):
        stream.add(np.ones((2, 4, 3)))


def test_no_mode_is_an_error() -> None:
    with pytest.raises(ValueError, match="0 modes"):
        StreamedPod(0)
