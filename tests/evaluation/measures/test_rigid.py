"""The split of rigid motion from deformation, against motions that are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from evaluation.errors import EvaluationError
from evaluation.measures.rigid import fit_rigid, split_error

coordinate = st.floats(-3, 3)
turn = st.tuples(*[st.floats(-170, 170)] * 3)
shift = st.tuples(*[coordinate] * 3)


def body(seed: int = 0, nodes: int = 40) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(nodes, 3)) * [2.0, 1.0, 0.4]


def moved(x: np.ndarray, turn: tuple[float, ...], shift: tuple[float, ...]) -> np.ndarray:
    """Displacements (1, n, 3) of a turn about the centroid and a shift."""
    centre = x.mean(axis=0)
    rotation = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    return ((x - centre) @ rotation.T + centre + np.array(shift) - x)[None]


@given(turn=turn, shift=shift, seed=st.integers(0, 20))
@settings(deadline=None)
def test_a_rigid_motion_is_found_whole_and_leaves_no_deformation(turn, shift, seed):
    x = body(seed)
    u = moved(x, turn, shift)
    fit = fit_rigid(x, u)
    np.testing.assert_allclose(fit.translation[0], shift, atol=1e-9)
    np.testing.assert_allclose(fit.rotation[0], Rotation.from_euler("xyz", turn, degrees=True).as_matrix(), atol=1e-9)
    np.testing.assert_allclose(fit.displacement(x), u, atol=1e-9)
    np.testing.assert_allclose(fit.deformation(x, u), 0, atol=1e-9)


@given(turn=turn, shift=shift)
@settings(deadline=None)
def test_the_fit_is_that_of_scipy(turn, shift):
    x = body()
    u = moved(x, turn, shift) + np.random.default_rng(1).normal(scale=0.1, size=(1, *x.shape))
    y = x + u[0]
    expected, _ = Rotation.align_vectors(y - y.mean(axis=0), x - x.mean(axis=0))
    np.testing.assert_allclose(fit_rigid(x, u).rotation[0], expected.as_matrix(), atol=1e-7)


@given(turn=turn, shift=shift)
@settings(deadline=None)
def test_errors_are_the_same_for_an_observer_who_turns_and_shifts_both_runs(turn, shift):
    x, noise = body(), np.random.default_rng(2).normal(scale=0.05, size=(2, 40, 3))
    u, p = noise[:1], noise[1:]
    rotation = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    seen = [(x + a) @ rotation.T + np.array(shift) - x for a in (u, p)]
    here, there = split_error(x, u, p), split_error(x, *seen)
    for name in ("translation", "rotation", "rigid", "deformation", "total"):
        np.testing.assert_allclose(getattr(there, name), getattr(here, name), rtol=1e-6, atol=1e-7)


def test_a_right_flight_does_not_hide_a_wrong_crush():
    x = body()
    flight = moved(x, (0, 0, 20), (5.0, 0, 0))
    crush = 0.1 * np.random.default_rng(3).normal(size=flight.shape)
    error = split_error(x, flight + crush, flight)
    assert error.total[0] / error.true_rigid[0] < 0.05
    assert error.deformation[0] == pytest.approx(error.true_deformation[0], rel=1e-6)
    assert error.translation[0] < 0.05


def test_a_wrong_flight_does_not_count_as_wrong_crush():
    x = body()
    crush = 0.05 * np.random.default_rng(4).normal(size=(1, 40, 3))
    truth = crush
    rotation = Rotation.from_euler("z", 10, degrees=True).as_matrix()
    prediction = (x + crush[0] - x.mean(axis=0)) @ rotation.T + x.mean(axis=0) + [1.0, 0, 0] - x
    error = split_error(x, truth, prediction[None])
    assert error.rotation[0] == pytest.approx(10, abs=1e-6)
    assert error.deformation[0] < 1e-9
    assert error.total[0] > 0.9


def test_tiny_rotations_are_not_rounded_away():
    x = body()
    assert fit_rigid(x, moved(x, (0, 0, 1e-6), (0, 0, 0))).angle[0] == pytest.approx(1e-6, rel=1e-4)


def test_a_mirrored_body_is_not_taken_for_a_rotation():
    x = body()
    fit = fit_rigid(x, (x * [1, 1, -1] - x)[None])
    assert np.linalg.det(fit.rotation[0]) == pytest.approx(1)


def test_nodes_that_are_gone_take_no_part():
    x = body()
    u = np.repeat(moved(x, (5, 0, 0), (0.3, 0, 0)), 3, axis=0)
    p = u + np.array([0.01, 0, 0])
    p[1, :5] = 99.0
    u[1, :5] = np.nan
    u[2] = np.nan
    error = split_error(x, u, p)
    assert error.total[1] == pytest.approx(0.01)
    assert error.translation[1] == pytest.approx(0.01)
    assert error.deformation[1] < 1e-9
    assert np.isnan([error.total[2], error.translation[2], error.rotation[2], error.deformation[2]]).all()


def test_the_motion_of_chosen_nodes_is_that_of_the_body():
    x = body()
    u = moved(x, (0, 30, 0), (1, 0, 0))
    u[:, 10:] += 0.3
    fit = fit_rigid(x, u, nodes=np.arange(10))
    np.testing.assert_allclose(fit.deformation(x, u)[:, :10], 0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(fit.deformation(x, u)[:, 10:], axis=-1), 0.3 * 3**0.5, atol=1e-9)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda x: fit_rigid(x[:2], np.zeros((1, 2, 3))), "of 2 nodes: expected at least three"),
        (lambda x: fit_rigid(x, np.zeros((40, 3))), r"displacements \(40, 3\): expected \(n, 3\) and \(t, n, 3\)"),
        (lambda x: split_error(x, np.zeros((1, 40, 3)), np.zeros((2, 40, 3))), "expected the same"),
        (
            lambda x: split_error(x, np.zeros((1, 40, 3)), np.full((1, 40, 3), np.nan)),
            "not finite in state 0 at node 0",
        ),
    ],
)
def test_arrays_that_do_not_fit_are_refused(call, message):
    with pytest.raises(EvaluationError, match=message):
        call(body())
