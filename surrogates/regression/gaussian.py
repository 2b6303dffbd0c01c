"""Gaussian-process and radial-basis regression whose prediction is a weighted sum of the training outputs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from surrogates.errors import SurrogateError

if TYPE_CHECKING:
    from sklearn.gaussian_process.kernels import Kernel


# Samples that set the kernel's lengths; more only cost time.
_HYPER = 300


class Gaussian:
    """Gaussian-process regression with one Matern-3/2 kernel, a length for each input, shared by all outputs.

    Source: Rasmussen and Williams 2006, equations 2.25 and 5.8; a linear trend enters as a kernel of its own. With one
    kernel the prediction is a weighted sum of the training outputs, so the kernel's numbers and these are all it takes.
    """

    def __init__(self, x: NDArray[np.float64], theta: NDArray[np.float64] | None = None) -> None:
        self.x = x
        self.theta = theta

    def fit(self, y: NDArray[np.float64], seed: int) -> Gaussian:
        """Set the kernel by the likelihood of the outputs y (sample, output), in units of their spread."""
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.utils._testing import ignore_warnings

        if not self._informed:
            return self
        some = np.random.default_rng(seed).permutation(len(self.x))[:_HYPER]
        compact = _left_factor(y[some] - y.mean(axis=0))
        machine = GaussianProcessRegressor(_kernel(self.x.shape[1]), random_state=seed, n_restarts_optimizer=1)
        ignore_warnings(category=ConvergenceWarning)(machine.fit)(self.x[some], compact)
        self.theta = machine.kernel_.theta
        return self

    def weights(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(query, sample): how much each training output enters the prediction at x (query, input)."""
        from scipy.linalg import cho_factor, cho_solve

        if not self._informed:
            return np.zeros((len(x), len(self.x)))
        kernel = self.kernel()
        factor = cho_factor(kernel(self.x) + 1e-10 * np.eye(len(self.x)), lower=True)
        return cho_solve(factor, kernel(x, self.x).T).T

    def kernel(self) -> Kernel:
        """The fitted kernel, noise included."""
        return _kernel(self.x.shape[1]).clone_with_theta(self.theta)

    @property
    def _informed(self) -> bool:
        """Whether there is anything to tell samples apart by; else the mean is all there is to predict."""
        return len(self.x) > 1 and self.x.shape[1] > 0

    def numbers(self) -> dict[str, NDArray[np.float64]]:
        return {"theta": np.asarray(self.theta, np.float64) if self.theta is not None else np.zeros(0)}


class RadialBasis:
    """Thin-plate-spline interpolation with a linear trend (scipy's RBFInterpolator)."""

    def __init__(self, x: NDArray[np.float64]) -> None:
        self.x = x

    def fit(self, y: NDArray[np.float64], seed: int) -> RadialBasis:
        return self

    def weights(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        from scipy.interpolate import RBFInterpolator

        if len(self.x) == 1 or self.x.shape[1] == 0:
            return np.full((len(x), len(self.x)), 1 / len(self.x))
        degree = 1 if len(self.x) > self.x.shape[1] + 1 else 0
        kernel = "thin_plate_spline" if degree else "linear"
        try:
            machine = RBFInterpolator(self.x, np.eye(len(self.x)), kernel=kernel, degree=degree, smoothing=1e-9)
            return machine(x)
        except np.linalg.LinAlgError as error:
            raise SurrogateError(
                "radial basis functions need parameters that do not lie on a line or plane; use model pod-gpr"
            ) from error

    def numbers(self) -> dict[str, NDArray[np.float64]]:
        return {}


def _kernel(inputs: int) -> Kernel:
    from sklearn.gaussian_process.kernels import ConstantKernel, DotProduct, Matern, WhiteKernel

    return (
        ConstantKernel(1.0, (1e-3, 1e3)) * Matern(np.full(inputs, 2.0), (0.1, 50.0), nu=1.5)
        + ConstantKernel(1.0, (1e-3, 1e3)) * DotProduct(1.0, (1e-2, 1e2))
        + WhiteKernel(1e-3, (1e-7, 1.0))
    )


def _left_factor(y: NDArray[np.float64]) -> NDArray[np.float64]:
    """L (sample, output) with L L^T = y y^T up to a factor that makes its entries of order one: the same likelihood."""
    values, vectors = np.linalg.eigh(y @ y.T)
    values = values.clip(0)
    good = values > values[-1] * 1e-12
    if not good.any():
        return np.zeros((len(y), 1))
    return vectors[:, good] * np.sqrt(values[good] * len(y) * good.sum() / values.sum())
