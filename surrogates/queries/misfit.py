"""How well parameters explain measured displacements: their likelihood, with the model's own error as noise.

A surrogate errs, and its errors at neighbouring points go together: twenty points that are all two centimetres off are
one piece of evidence, not sixty. So the noise of a measurement has two parts (Kennedy and O'Hagan 2001, doi
10.1111/1467-9868.00294): the measurement's own, independent, and the model's, whose size at each point and state is the
band's, and whose correlation is that of errors on runs left out: of the process's own, or, for networks, of a
regression of what they say of the training runs.

Such errors are not normally distributed: most runs are predicted far better than the band says, a few worse. So the
likelihood is raised to a power, chosen so that the region of 90 % would have held the parameters of nine in ten
training runs, each with the error it has when it is left out (a conformal choice, as the band's own). Two things make new
runs worse than that, and widen the region: left-out errors of a process keep to its modes, so what they lack in some direction
of the variance claimed for it is added; and the correlation is that of few runs (Hotelling's T squared of one more run: Mardia,
Kent, Bibby 1979, section 3.5).
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from surrogates.data.inputs import over_range
from surrogates.errors import SurrogateError
from surrogates.queries.points import AtPoints
from surrogates.regression.gaussian import Gaussian

if TYPE_CHECKING:
    from surrogates.surrogate import Surrogate

# The region whose coverage sets the power of the likelihood, and the step of derivatives in widths of the box.
_REGION, _STEP = 0.9, 1e-3
# Parts in which training runs are judged by the others.
_FOLDS = 8
# Variance of the constant that stands for the unknown mean of a process.
_MEAN = 100.0
# Parameters that stand for the box where the training runs' own are not stored.
_STAND_IN = 64
# Numbers held at once, (run, parameter, measurement).
_HELD = 4_000_000


@dataclass(frozen=True)
class Measured:
    """Displacements at points.

    Attributes
    ----------
    value, deviation
        (number,) m: one component each, and its standard deviation.
    state, point, component
        (number,) places in the (state, point, 3) that `AtPoints` gives.
    """

    value: NDArray[np.float64]
    deviation: NDArray[np.float64]
    state: NDArray[np.int64]
    point: NDArray[np.int64]
    component: NDArray[np.int64]


class Misfit:
    """Logarithm of the likelihood of parameters, up to a constant.

    Attributes
    ----------
    model_error
        (number,) m: standard deviation of the model's own error of a typical run at each measurement.
    banded
        Whether it is the band's; else the model had too few runs for one, and it is that of a regression of its runs.
    size
        Error of the measured run against that of a typical one, as far as the model tells; see `sized`.
    power
        What the likelihood is raised to.
    runs
        (run, parameter) of the training runs, or points that stand for them.
    """

    def __init__(self, points: AtPoints, measured: Measured, free: NDArray[np.bool_] | None = None) -> None:
        self.points, self.measured, self.size = points, measured, 1.0
        surrogate = points.surrogate
        ranges = surrogate.record.ranges
        self.free = ranges.high > ranges.low if free is None else free
        self.runs = runs = _training_parameters(surrogate)
        found = points.left_out()
        patterns = (
            error_patterns(self.predicted, surrogate, runs)
            if found is None
            else found[:, measured.state, measured.point, measured.component]
        )
        known = points.deviation()
        self.banded = known is not None
        size = np.sqrt(np.square(patterns).mean(axis=0))
        self.model_error = size if known is None else known[measured.state, measured.point]
        self._values, self._turn = self._whitening(patterns)
        self._left_out, drops = self._of_left_out(runs, patterns * (self.model_error / np.where(size > 0, size, 1)))
        self.power = _power(drops, int(self.free.sum()), len(runs))

    def predicted(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """(run, parameter) -> (run, number), m."""
        m = self.measured
        out: NDArray[np.float64] = self.points(parameters)[:, m.state, m.point, m.component]
        return out

    def sized(self, parameters: NDArray[np.float64]) -> Misfit:
        """The same with the size of error that the model expects of a run with `parameters` (parameter,)."""
        out = copy(self)
        out.size = float(self.points.spread(parameters[None])[0])
        return out

    def __call__(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """(run, parameter) -> (run,)."""
        return (
            -self.power
            / 2
            * np.concatenate(
                [
                    np.square(self._off(part)).sum(axis=1)
                    for part in np.array_split(parameters, self._pieces(parameters))
                ]
            )
        )

    def explored(
        self, parameters: NDArray[np.float64], reach: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Averages over boxes (run, parameter) +- reach, within which the model is taken as linear.

        Returns (run,) log likelihoods, and (run, parameter): by how many deviations of its noise the prediction changes
        between a box's middle and its face.
        """
        pieces = self._pieces(parameters)
        found = [
            self._explored(a, b)
            for a, b in zip(np.array_split(parameters, pieces), np.array_split(reach, pieces), strict=True)
        ]
        return np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])

    def _explored(
        self, parameters: NDArray[np.float64], reach: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        off = self._off(parameters)
        moved = np.flatnonzero(reach.any(axis=0))
        steps = [off - self._off(parameters + reach * (np.arange(reach.shape[1]) == k)) for k in moved]
        slopes = np.stack(steps, axis=-1) * np.sqrt(self.power)  # (run, number, parameter)
        off = off * np.sqrt(self.power)
        gram, along = slopes.transpose(0, 2, 1) @ slopes, np.einsum("nqk,nq->nk", slopes, off)
        inner = 3 * np.eye(len(moved)) + gram  # a face is sqrt(3) deviations of an even distribution away
        square = np.square(off).sum(axis=1) - (along * np.linalg.solve(inner, along[..., None])[..., 0]).sum(axis=1)
        change = np.zeros(parameters.shape)
        change[:, moved] = np.linalg.norm(slopes, axis=1)
        return -(square + np.linalg.slogdet(inner / 3)[1]) / 2, change

    def rarity(self, parameters: NDArray[np.float64]) -> float:
        """Share of training runs that are worse explained by their own parameters than the measurement by these."""
        square = float(np.square(self._off(parameters[None])).sum())
        return float((self._left_out >= square).mean())

    def _off(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """(run, number): what is left of the measurement, in deviations, free of correlation."""
        return np.asarray((self.measured.value - self.predicted(parameters)) @ self._turn / self._scale(self.size))

    def _scale(self, size: float) -> NDArray[np.float64]:
        return np.asarray(np.sqrt(np.square(size) * self._values + 1))

    def _whitening(self, errors: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Variances (number,) of the model's error against the measurement's, and the turn (number, number) to them."""
        scaled = self.model_error / self.measured.deviation
        values, vectors = np.linalg.eigh(_correlation(errors) * np.outer(scaled, scaled))
        return np.maximum(values, 0.0), vectors / self.measured.deviation[:, None]

    def _pieces(self, parameters: NDArray[np.float64]) -> int:
        return -(-len(parameters) * len(self.measured.value) * (1 + parameters.shape[1]) // _HELD) or 1

    def _of_left_out(
        self, runs: NDArray[np.float64], errors: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(run,): squared deviations of each training run from its own parameters, and the part that others take away.

        errors (run, number), m: what the model without the run is off by. No run is judged by a correlation that it
        was part of.
        """
        ranges = self.points.surrogate.record.ranges
        at, moved = self.predicted(runs), []
        for k in np.flatnonzero(self.free):
            step = np.zeros_like(runs)
            step[:, k] = _STEP * (ranges.high - ranges.low)[k] * np.where(runs[:, k] > ranges.low[k], -1, 1)
            moved.append(self.predicted(runs + step) - at)
        slopes, sizes = np.stack(moved, axis=-1), self.points.spread_left_out(runs)
        whole, explained = np.empty(len(runs)), np.empty(len(runs))
        turned, bases = np.empty((len(runs), errors.shape[1])), np.empty((len(runs), *slopes.shape[1:]))
        for held in np.array_split(np.random.default_rng(0).permutation(len(runs)), min(_FOLDS, len(runs))):
            values, turn = self._whitening(np.delete(errors, held, axis=0))
            for k in held:
                scale = np.sqrt(np.square(sizes[k]) * values + 1)
                turned[k] = errors[k] @ turn / scale
                basis = np.linalg.qr((turn.T @ slopes[k]) / scale[:, None])[0]
                bases[k, :, : basis.shape[1]], bases[k, :, basis.shape[1] :] = basis, 0.0
                whole[k], explained[k] = np.square(turned[k]).sum(), np.square(turned[k] @ basis).sum()
        lacking = np.maximum(0.0, 1 - np.square(turned).mean(axis=0))
        return whole, explained + np.einsum("rnk,n->r", np.square(bases), lacking)


def _power(drops: NDArray[np.float64], parameters: int, runs: int) -> float:
    """What to raise a likelihood to, so that _REGION of the `drops`, twice its log, lie below the quantile of chi squared.

    runs  behind the correlation; the fewer, the more a further run may be off
    """
    from scipy.stats import chi2, f

    place = min(len(drops) - 1, int(np.ceil((len(drops) + 1) * _REGION)) - 1)
    known = chi2.ppf(_REGION, parameters)
    rest = max(runs - parameters, 1)
    few = parameters * (runs - 1) * (runs + 1) / (runs * rest) * f.ppf(_REGION, parameters, rest) / known
    return float(known / max(float(np.sort(drops)[place]), 1e-12) / max(few, 1.0))


def error_patterns(
    predicted: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    surrogate: Surrogate,
    runs: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(run, number), m: errors of a process on each training run, left out of it.

    What it learns are the predictions `predicted` (run, parameter) -> (run, number) for the `runs` (run, parameter), so
    that no data is needed: what bends most is learnt worst.
    """
    x = over_range(surrogate.registration.read(runs), surrogate.registration.read(runs))
    y = predicted(runs)
    if len(runs) < 3 or not x.shape[1]:
        return np.asarray(y - y.mean(axis=0))
    kernel = Gaussian(x).fit(y, 0).kernel
    covariance = kernel(x, x) + _MEAN + (kernel.noise + 1e-8) * np.eye(len(x))
    inverse = np.linalg.inv(covariance)
    return np.asarray(inverse @ y / np.diag(inverse)[:, None])


def _training_parameters(surrogate: Surrogate) -> NDArray[np.float64]:
    record = surrogate.record
    ranges = record.ranges
    if all(len(record.parameters.get(n, ())) > 1 for n in ranges.names):
        return np.array([record.parameters[n] for n in ranges.names]).T
    from surrogates.design.space import fill

    if not (ranges.high > ranges.low).any():
        raise SurrogateError("no parameter of the model ever changed; there is nothing to find")
    return fill(ranges.low, ranges.high, _STAND_IN, sequence="sobol")


def _correlation(patterns: NDArray[np.float64]) -> NDArray[np.float64]:
    """(number, number), shrunk towards independence by as much as so few runs cannot tell (Ledoit and Wolf 2004)."""
    from sklearn.covariance import ledoit_wolf

    size = np.sqrt(np.square(patterns).mean(axis=0))
    out = np.asarray(ledoit_wolf(patterns / np.where(size > 0, size, 1.0), assume_centered=True)[0], np.float64)
    diagonal = np.sqrt(np.diag(out))
    out /= np.outer(np.where(diagonal > 0, diagonal, 1), np.where(diagonal > 0, diagonal, 1))
    np.fill_diagonal(out, 1.0)
    return out
