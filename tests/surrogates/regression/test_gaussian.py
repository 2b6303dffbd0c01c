"""The Gaussian process with a matrix of lengths, against scikit-learn and its own definition."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import check_grad
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, DotProduct, Matern, WhiteKernel

from surrogates.regression import gaussian
from surrogates.regression.gaussian import Gaussian, Kernel

DRAW = np.random.default_rng(0)
X, QUERY = DRAW.uniform(-1, 1, (15, 2)), DRAW.uniform(-1, 1, (6, 2))
Y = np.sin(2 * X @ DRAW.standard_normal((2, 4))) + 0.05 * DRAW.standard_normal((15, 4)) + 3.0


def test_it_predicts_as_scikit_learn_does_with_a_constant_of_large_variance() -> None:
    ours = Gaussian(X).fit(Y, seed=0)
    variance, slope, noise = ours.kernel.numbers
    kernel = (
        ConstantKernel(variance) * Matern(1 / np.diag(ours.kernel.mix), nu=1.5)
        + ConstantKernel(slope) * DotProduct(1e-6)
        + ConstantKernel(1e5)
        + WhiteKernel(noise)
    )
    theirs = GaussianProcessRegressor(kernel, optimizer=None).fit(X, Y)
    np.testing.assert_allclose(ours.weights(QUERY) @ Y, theirs.predict(QUERY), rtol=1e-4)
    believed = theirs.predict(QUERY, return_std=True)[1][:, 0]
    np.testing.assert_allclose(ours.deviation(QUERY), believed, rtol=1e-3)


@pytest.mark.parametrize("mixed", [(), (0, 2, 3)])
def test_the_gradient_of_the_likelihood_is_its_gradient(mixed: tuple[int, ...]) -> None:
    draw = np.random.default_rng(1)
    x = draw.uniform(-1, 1, (12, 4))
    y = draw.standard_normal((12, 3))
    gram = y @ y.T
    beside = [(i, j) for k, i in enumerate(mixed) for j in mixed[:k]]
    theta = draw.normal(0, 0.3, 3 + 4 + len(beside))
    wrong = check_grad(
        lambda t: gaussian._unlikely(t, x, gram, beside)[0], lambda t: gaussian._unlikely(t, x, gram, beside)[1], theta
    )
    assert wrong < 1e-5


def test_weights_sum_to_one_so_that_what_all_outputs_share_is_kept() -> None:
    machine = Gaussian(X).fit(Y, seed=0)
    np.testing.assert_allclose(machine.weights(10 * QUERY).sum(axis=1), 1.0, atol=1e-9)


def test_a_full_matrix_finds_the_direction_that_counts() -> None:
    draw = np.random.default_rng(2)
    x, query = draw.uniform(-1, 1, (50, 3)), draw.uniform(-1, 1, (200, 3))

    def truth(at: np.ndarray) -> np.ndarray:
        along = at[:, :2] @ [2.0, -1.0]
        return np.stack([np.sin(2 * along), np.cos(1.5 * along)], axis=1)

    def error(mixed: tuple[int, ...]) -> float:
        return float(np.abs(Gaussian(x, mixed=mixed).fit(truth(x), 0).weights(query) @ truth(x) - truth(query)).mean())

    assert error((0, 1)) < 0.7 * error(())


def test_what_is_stored_gives_the_same_weights() -> None:
    machine = Gaussian(X, mixed=(0, 1)).fit(Y, seed=0)
    again = Gaussian.load(X, machine.numbers())
    np.testing.assert_array_equal(again.weights(QUERY), machine.weights(QUERY))


@pytest.mark.parametrize("x", [np.zeros((1, 2)), np.zeros((4, 0))])
def test_without_anything_to_tell_samples_apart_the_mean_is_predicted(x: np.ndarray) -> None:
    weights = Gaussian(x).fit(np.ones((len(x), 2)), 0).weights(np.zeros((3, x.shape[1])))
    np.testing.assert_allclose(weights, 1 / len(x))


def test_outputs_that_do_not_move_leave_the_kernel_alone() -> None:
    machine = Gaussian(X).fit(np.ones((15, 2)), seed=0)
    assert isinstance(machine.kernel, Kernel)
    np.testing.assert_allclose(machine.weights(QUERY) @ np.ones((15, 2)), 1.0)
