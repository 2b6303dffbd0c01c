"""Gaussian-process and radial-basis regression whose prediction is a weighted sum of the training outputs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogates.errors import SurrogateError

# Samples that set the kernel's numbers; more only cost time.
_HYPER = 300
# Variance of the constant that stands for the unknown mean while the numbers are set.
_MEAN = 100.0
_JITTER = 1e-10
# Weight of the absolute values of the off-diagonal entries of A, for each sample's likelihood.
_SPARSE = 0.02
# Where the likelihood starts, and how far numbers may go: logarithms of variance, slope and noise, of lengths, and
# the entries of A beside its diagonal.
_START, _BOUNDS = (0.0, math.log(0.3), math.log(1e-2)), ((-7.0, 7.0), (-9.0, 7.0), (math.log(1e-7), 0.0))
_LENGTH, _LENGTHS = math.log(2.0), (math.log(0.1), math.log(50.0))
_BESIDE, _FURTHEST = 0.01, 10.0
_STEPS = 150


@dataclass(frozen=True)
class Kernel:
    """k(x, x') = c m(|A (x - x')|) + b x . x', with m(d) = (1 + sqrt(3) d) exp(-sqrt(3) d), and noise at a sample itself.

    Source: Rasmussen and Williams 2006, equations 4.17 (Matern 3/2) and 4.20 (a matrix of lengths).

    Attributes
    ----------
    variance, slope, noise
        C, b and the noise, in units of the outputs' spread.
    mix
        A (input, input), lower triangular: 1 / length on the diagonal.
    """

    variance: float
    slope: float
    noise: float
    mix: NDArray[np.float64]

    def __call__(self, a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
        """(a, b) of inputs (a, input) and (b, input), without the noise."""
        distance = math.sqrt(3.0) * np.sqrt(_squares(a @ self.mix.T, b @ self.mix.T))
        return self.variance * (1 + distance) * np.exp(-distance) + self.slope * (a @ b.T)

    def at(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(x,): each sample with itself, without the noise."""
        return np.asarray(self.variance + self.slope * np.square(x).sum(axis=1))

    @property
    def numbers(self) -> NDArray[np.float64]:
        """(3,): variance, slope, noise."""
        return np.array([self.variance, self.slope, self.noise])


class Gaussian:
    """Gaussian-process regression with one kernel, shared by all outputs, and an unknown mean.

    With one kernel the prediction is a weighted sum of the training outputs. The weights sum to one, so that whatever
    all training outputs share is kept exactly (ordinary kriging: Rasmussen and Williams 2006, section 2.7, with a
    constant as the only basis function of infinite variance). The kernel's numbers maximise the likelihood of the
    outputs (equation 5.8) along its gradient (equation 5.9).

    Attributes
    ----------
    x
        (sample, input), each column about [-1, 1].
    mixed
        Columns whose lengths form a full lower-triangular matrix; the others have a length of their own.
    """

    def __init__(self, x: NDArray[np.float64], kernel: Kernel | None = None, mixed: Sequence[int] = ()) -> None:
        self.x = np.asarray(x, np.float64)
        self.kernel = kernel or Kernel(1.0, 0.3, 1e-2, np.eye(self.x.shape[1]) / 2)
        self.mixed = tuple(mixed)
        self.likelihood = -np.inf
        self._factored: tuple[Kernel, tuple[NDArray[np.float64], bool]] | None = None

    def fit(self, y: NDArray[np.float64], seed: int, start: Kernel | None = None) -> Gaussian:
        """Set the kernel by the likelihood of the outputs y (sample, output), in units of their spread.

        Parameters
        ----------
        start
            A kernel of the same inputs to begin from.
        """
        if not self._informed:
            return self
        some = np.random.default_rng(seed).permutation(len(self.x))[:_HYPER]
        moved = y[some] - y[some].mean(axis=0)
        gram = moved @ moved.T
        size = float(np.trace(gram))
        if size > 0:
            self.kernel, self.likelihood = _most_likely(self.x[some], gram * (len(some) / size), self.mixed, start)
        return self

    def weights(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(query, sample): how much each training output enters the prediction at x (query, input); rows sum to one."""
        if not self._informed:
            return np.full((len(x), len(self.x)), 1 / max(1, len(self.x)))
        solved, ones = self._solved(x)
        return np.asarray(solved + (1 - solved.sum(axis=1))[:, None] * ones / ones.sum())

    def expanded(self, y: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mean (output,) and what stands by k(x) (sample, output), so that the prediction at x is mean + k(x) . pull."""
        from scipy.linalg import cho_solve

        factor = self._factor()
        ones = cho_solve(factor, np.ones(len(self.x)))
        mean = ones @ y / ones.sum()
        return mean, cho_solve(factor, y - mean)

    def inverse(self) -> NDArray[np.float64]:
        """(sample, sample): inverse of the covariance of the samples, noise included."""
        from scipy.linalg import cho_solve

        return np.asarray(cho_solve(self._factor(), np.eye(len(self.x))))

    def deviation(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(query,): what the process believes its standard deviation to be, in units of the outputs' spread."""
        if not self._informed:
            return np.ones(len(x))
        solved, ones = self._solved(x)
        gain = (self.kernel(np.atleast_2d(x), self.x) * solved).sum(axis=1)
        unknown = (1 - solved.sum(axis=1)) ** 2 / ones.sum()
        return np.asarray(np.sqrt(np.maximum(self.kernel.at(x) - gain + unknown, 0) + self.kernel.noise))

    def covariance(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(query, query): what the process believes of its errors together, in units of the outputs' spread, squared.

        Source: Rasmussen and Williams 2006, equations 2.26 and 2.42; the noise of each run is on the diagonal.
        """
        if not self._informed:
            return np.eye(len(x))
        solved, ones = self._solved(x)
        unknown = 1 - solved.sum(axis=1)
        gain = solved @ self.kernel(np.atleast_2d(x), self.x).T
        out = self.kernel(x, x) - (gain + gain.T) / 2 + np.outer(unknown, unknown) / ones.sum()
        return np.asarray(out + self.kernel.noise * np.eye(len(x)))

    def whitened(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """(sample, output): outputs y whose columns the kernel explains as independent draws; their products are the outputs' spread.

        A draw from the belief at queries x is chol(covariance(x)) E W, with W this and E (query, sample) of standard
        normal numbers: all outputs share the kernel, and W'W is how they vary together.
        """
        from scipy.linalg import solve_triangular

        if not self._informed:
            return np.asarray((y - y.mean(axis=0)) / np.sqrt(max(1, len(y))))
        factor, _ = self._factor()
        mean, _ = self.expanded(y)
        return np.asarray(solve_triangular(factor, y - mean, lower=True) / np.sqrt(len(y)))

    def _solved(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(query, sample): K^-1 k of each query, and (sample,): K^-1 1."""
        from scipy.linalg import cho_solve

        factor = self._factor()
        solved = cho_solve(factor, self.kernel(x, self.x).T).T
        return solved, cho_solve(factor, np.ones(len(self.x)))

    def _factor(self) -> tuple[NDArray[np.float64], bool]:
        from scipy.linalg import cho_factor

        if self._factored is not None and self._factored[0] is self.kernel:
            return self._factored[1]
        noise = self.kernel.noise + _JITTER
        factor, lower = cho_factor(self.kernel(self.x, self.x) + noise * np.eye(len(self.x)), lower=True)
        self._factored = self.kernel, (np.asarray(factor), bool(lower))
        return self._factored[1]

    @property
    def _informed(self) -> bool:
        """Whether there is anything to tell samples apart by; else the mean is all there is to predict."""
        return len(self.x) > 1 and self.x.shape[1] > 0

    def numbers(self) -> dict[str, NDArray[np.float64]]:
        """What has to be kept beside the samples."""
        return {"kernel": self.kernel.numbers, "mix": self.kernel.mix}

    @classmethod
    def load(cls, x: NDArray[np.float64], arrays: Mapping[str, NDArray[Any]]) -> Gaussian:
        """From what `numbers` gave."""
        variance, slope, noise = (float(v) for v in arrays["kernel"])
        return cls(x, Kernel(variance, slope, noise, np.asarray(arrays["mix"], np.float64)))


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
            return np.asarray(machine(x))
        except np.linalg.LinAlgError as error:
            raise SurrogateError(
                "radial basis functions need parameters that do not lie on a line or plane; use model pod-gpr"
            ) from error

    def numbers(self) -> dict[str, NDArray[np.float64]]:
        return {}


def _most_likely(
    x: NDArray[np.float64], gram: NDArray[np.float64], mixed: Sequence[int], start: Kernel | None
) -> tuple[Kernel, float]:
    """The kernel of the largest likelihood, and that likelihood for each sample and output.

    Parameters
    ----------
    gram
        (sample, sample): products of the outputs, with a trace of as many as there are samples.
    """
    from scipy.optimize import minimize

    p = x.shape[1]
    beside = [(i, j) for k, i in enumerate(mixed) for j in mixed[:k]]
    low, high = -_LENGTHS[1], -_LENGTHS[0]
    bounds = [*_BOUNDS, *[(low, high)] * p, *[(-_FURTHEST, _FURTHEST)] * len(beside)]
    first = np.concatenate([_START, np.full(p, -_LENGTH), np.full(len(beside), _BESIDE)])
    if start is not None and len(start.mix) == p:  # a parameter that one run alone changes is constant without it
        entries = [start.mix[i, j] for i, j in beside]
        first = np.concatenate([np.log(np.maximum(start.numbers, 1e-12)), np.log(np.diag(start.mix)), entries])
        first = np.clip(first, [b[0] for b in bounds], [b[1] for b in bounds])
    found = minimize(
        _unlikely, first, args=(x, gram, beside), jac=True, method="L-BFGS-B", bounds=bounds,
        options={"maxiter": _STEPS},
    )  # fmt: skip
    return _kernel(found.x, p, beside), -float(found.fun)


def _kernel(theta: NDArray[np.float64], inputs: int, beside: Sequence[tuple[int, int]]) -> Kernel:
    mix = np.diag(np.exp(theta[3 : 3 + inputs]))
    for value, place in zip(theta[3 + inputs :], beside, strict=True):
        mix[place] = value
    variance, slope, noise = (float(v) for v in np.exp(theta[:3]))
    return Kernel(variance, slope, noise, mix)


def _unlikely(
    theta: NDArray[np.float64], x: NDArray[np.float64], gram: NDArray[np.float64], beside: Sequence[tuple[int, int]]
) -> tuple[float, NDArray[np.float64]]:
    """Minus the log likelihood for each sample and output, with the price of entries beside the diagonal; and gradient."""
    from scipy.linalg import cho_solve

    n, p = x.shape
    kernel = _kernel(theta, p, beside)
    z = x @ kernel.mix.T
    distance = math.sqrt(3.0) * np.sqrt(_squares(z, z))
    fall = np.exp(-distance)
    matern, linear = (1 + distance) * fall, x @ x.T
    covariance = kernel.variance * matern + kernel.slope * linear + _MEAN
    covariance[np.diag_indices(n)] += kernel.noise + _JITTER
    try:
        factor = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return 1e25, np.zeros_like(theta)
    inverse = cho_solve((factor, True), np.eye(n))
    explained = inverse @ gram
    value = float(np.log(np.diag(factor)).sum() + 0.5 * np.trace(explained))
    slope = 0.5 * (inverse - explained @ inverse)  # of the value by each entry of the covariance
    out = np.empty_like(theta)
    out[0] = kernel.variance * (slope * matern).sum()
    out[1] = kernel.slope * (slope * linear).sum()
    out[2] = kernel.noise * np.trace(slope)
    # By A through |A (x - x')|^2, along which the Matern kernel falls with -3/2 c exp(-sqrt(3) d).
    pull = slope * (-1.5 * kernel.variance * fall)
    spread = 2 * (x.T @ (pull.sum(axis=1)[:, None] * x) - x.T @ pull @ x)
    by_mix = 2 * kernel.mix @ spread
    out[3 : 3 + p] = np.diag(by_mix) * np.diag(kernel.mix)
    for k, place in enumerate(beside, 3 + p):
        size = math.sqrt(theta[k] ** 2 + 1e-8)
        value += _SPARSE * size
        out[k] = by_mix[place] + _SPARSE * theta[k] / size
    return value / n, out / n


def _squares(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """(a, b): squared distances."""
    return np.asarray(np.maximum(np.square(a).sum(axis=1)[:, None] + np.square(b).sum(axis=1) - 2 * a @ b.T, 0.0))
