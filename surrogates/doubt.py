"""What a model may be wrong by, as draws: other models that would fit the training runs as well.

A Gaussian process over whole runs is drawn from its own posterior: one draw is one whole function of the parameters, so
that the errors of neighbouring runs belong together. The belief is scaled so that it matches the errors on runs that were
left out in training. Other models have no posterior; they are drawn from their band: all nodes of all runs off by the
same quantile of the left-out errors in one direction, which is the most that the band allows for.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from surrogates.data.inputs import over_range
from surrogates.models.pod_regression import PodRegression
from surrogates.regression.gaussian import Gaussian
from surrogates.surrogate import Surrogate
from surrogates.uncertainty import SHARES

Floats = NDArray[np.float64]

# Spread of the outputs that is kept when drawing, and directions at most.
_ENERGY, _MOST = 0.999, 48
# Mean length of a vector of normal numbers in three dimensions, over its root mean square.
_MEAN_LENGTH = 0.921


class Doubt(Protocol):
    """Draws of the error of a model at some runs.

    Attributes
    ----------
    told
        Where the draws come from, in words.
    """

    told: str

    def draw(self, which: int, rows: slice, nodes: NDArray[np.int64]) -> NDArray[np.float32]:
        """(run, state, some nodes, 3), m: what draw number `which` adds to the prediction of the runs `rows`."""
        ...


def doubt_of(surrogate: Surrogate, parameters: Floats, time: Floats, draws: int, seed: int, level: int) -> Doubt | None:
    """Draws of the error at runs with `parameters` (run, parameter), the same `draws` functions for all of them.

    None where the model knows nothing of its errors.
    """
    core = surrogate.core
    if isinstance(core, PodRegression) and isinstance(core.machine, Gaussian) and core.inputs == "trajectory":
        return ProcessDoubt(surrogate, core, parameters, time, draws, seed)
    if surrogate.has_band(level):
        return BandDoubt(surrogate, parameters, time, draws, seed, level)
    return None


class ProcessDoubt:
    """Draws from the posterior of a process over whole runs."""

    def __init__(
        self, surrogate: Surrogate, core: PodRegression, parameters: Floats, time: Floats, draws: int, seed: int
    ) -> None:
        assert isinstance(core.machine, Gaussian)
        self._core = core
        inputs = over_range(surrogate.registration.read(parameters), np.stack([core.low, core.high]))
        covariance = core.machine.covariance(inputs)
        jitter = 1e-9 * float(np.trace(covariance)) / len(covariance)
        self._root = np.linalg.cholesky(covariance + jitter * np.eye(len(covariance)))
        values = core.data.values.astype(np.float64)
        self._states, self._modes = values.shape[1:]
        spread = core.machine.whitened(values.reshape(len(values), -1))
        _, size, right = np.linalg.svd(spread, full_matrices=False)
        energy = np.cumsum(size**2)
        keep = min(_MOST, int(np.searchsorted(energy, _ENERGY * energy[-1])) + 1)
        by_state = np.square((size[:, None] * right).reshape(len(size), self._states, self._modes)).sum(axis=(0, 2))
        self.factor = _calibration(surrogate, by_state, len(core.modes) // 3)
        self._spread = self.factor * size[:keep, None] * right[:keep]
        rng = np.random.default_rng(seed)
        self._draws = rng.standard_normal((draws, len(parameters), keep)).astype(np.float32)
        # Straight lines between states are enough for an error, and the same for all draws.
        sizes = surrogate.registration.clock.size(parameters)
        whens = (surrogate.registration.clock.times(one, time) for one in parameters)
        between = (size * _between(core.data.time, when) for size, when in zip(sizes, whens, strict=True))
        self._between = np.stack(list(between)).astype(np.float32)
        self.told = (
            "the process's own posterior"
            if self.factor == 1
            else f"the process's own posterior, scaled by {self.factor:.2f} to match its errors on left-out runs"
        )

    def draw(self, which: int, rows: slice, nodes: NDArray[np.int64]) -> NDArray[np.float32]:
        """See `Doubt.draw`."""
        courses = (self._root[rows] @ self._draws[which]) @ self._spread
        courses = courses.reshape(-1, self._states, self._modes)
        return self._core.decoded(self._between[rows] @ courses.astype(np.float32), nodes)


class BandDoubt:
    """Draws from the band: one quantile and one direction for everything."""

    told = "its band: all nodes off by one quantile of the errors on left-out runs, in one direction"

    def __init__(
        self, surrogate: Surrogate, parameters: Floats, time: Floats, draws: int, seed: int, level: int
    ) -> None:
        band = surrogate.bands[level, level > 0]
        beliefs = surrogate.beliefs(parameters)
        self._run = band.of_runs(beliefs)
        self._state = np.interp(time, band.time, band.state)
        self._node = band.node
        rng = np.random.default_rng(seed)
        shares = np.concatenate([[0.0], SHARES])
        self._size = np.interp(rng.random(draws), shares, np.concatenate([[0.0], band.factor]))
        direction = rng.standard_normal((draws, 3))
        self._direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)

    def draw(self, which: int, rows: slice, nodes: NDArray[np.int64]) -> NDArray[np.float32]:
        """See `Doubt.draw`."""
        length = self._size[which] * np.einsum("r,s,n->rsn", self._run[rows], self._state, self._node[nodes])
        return np.asarray(length[..., None] * self._direction[which], np.float32)


def _between(trained: Floats, time: Floats) -> Floats:
    """(state, trained state): weights of straight lines between trained times; the ends are held."""
    if len(trained) == 1:
        return np.ones((len(time), 1))
    place = np.clip(np.searchsorted(trained, time, side="right") - 1, 0, len(trained) - 2)
    share = np.clip((time - trained[place]) / (trained[place + 1] - trained[place]), 0, 1)
    out = np.zeros((len(time), len(trained)))
    out[np.arange(len(time)), place] = 1 - share
    out[np.arange(len(time)), place + 1] += share
    return out


def _calibration(surrogate: Surrogate, by_state: Floats, nodes: int) -> float:
    """Errors on left-out runs over what the posterior expects of them; 1 where no run was left out.

    by_state  (state,) m²: variance of the coefficients for a deviation of one
    """
    record = surrogate.record
    if len(record.left_out) < 2:
        return 1.0
    places = [record.fitted_runs.index(name) for name in record.left_out]
    runs = np.array([record.parameters[n] for n in record.ranges.names], np.float64).T[places]
    errors, deviations = np.array(list(record.left_out.values()), np.float64).T
    typical = _MEAN_LENGTH * float(np.sqrt(by_state / nodes).mean())
    expected = deviations * surrogate.registration.clock.size(runs) * typical
    return float(errors.mean() / max(expected.mean(), 1e-30))
