"""A surrogate asked at a few points of the mesh: thousands of parameters in the time of a few full predictions."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from surrogates.models.pod_regression import PodRegression
from surrogates.regression.gaussian import Gaussian
from surrogates.uncertainty import Band, Beliefs

if TYPE_CHECKING:
    from torch import Tensor

    from surrogates.surrogate import Surrogate

# Runs that are predicted at once.
_CHUNK = 2048
# Variance of the constant that stands for the unknown mean of a process.
_MEAN = 100.0
# What a band's quantiles do not say: the smallest ratios are taken to rise evenly from zero.
_INNER = np.linspace(0.0, 0.5, 51)


class AtPoints:
    """A surrogate at some points and times.

    Parameters
    ----------
    surrogate
        Any fitted surrogate.
    where
        (point, node of the full mesh): weights of the nodes that stand for each point; one row of the identity for a
        node.
    time
        (state,) s.
    level
        Mesh level whose prediction is interpolated; default: the finest one.
    """

    def __init__(
        self, surrogate: Surrogate, where: sparse.spmatrix, time: NDArray[np.float64], level: int | None = None
    ) -> None:
        self.surrogate, self.time = surrogate, np.atleast_1d(np.asarray(time, np.float64))
        self.level = surrogate.number(level)
        self.where = sparse.csr_matrix(where, dtype=np.float64)
        core = surrogate.core
        if isinstance(core, PodRegression):
            self._ask = self._by_process(core)
        else:
            self._ask = self._by_network()

    def __call__(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """(run, parameter) in the model's units -> displacements (run, state, point, 3), m."""
        values, _ = self.surrogate.checked(parameters, self.time)
        return np.concatenate([self._ask(values[k : k + _CHUNK]) for k in range(0, len(values), _CHUNK)])

    def deviation(self) -> NDArray[np.float64] | None:
        """(state, point): root mean square error of one component of a typical run, m, as the band tells; None without.

        The band says how far the true node is from the predicted one; a component has a third of its square.
        """
        band = self._band()
        if band is None:
            return None
        from surrogates.uncertainty import SHARES

        quantiles = np.concatenate([_INNER[:-1] / 0.5 * band.factor[0], band.factor, band.factor[-1:]])
        shares = np.concatenate([_INNER[:-1], SHARES, [1.0]])
        square = float(np.trapezoid(np.square(quantiles), shares))
        state = np.interp(self.time, band.time, band.state)
        return np.asarray(np.sqrt(square / 3) * state[:, None] * (self.where @ band.node.astype(np.float64))[None])

    def spread(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """(run,): the error of a run against that of a typical one, as far as the model tells beforehand."""
        band = self._band()
        if band is None:
            return np.ones(len(parameters))
        return band.of_runs(self.surrogate.beliefs(parameters))

    def spread_left_out(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """`spread` of the training runs, as the model tells it without each of them; (run, parameter) in their order.

        At a run that it knows, a process believes in next to no error. Where the record does not tell, as `spread`.
        """
        band, record = self._band(), self.surrogate.record
        names = record.fitted_runs
        if band is None or len(parameters) != len(names) or any(name not in record.left_out for name in names):
            return self.spread(parameters)
        deviation = np.array([record.left_out[name][1] for name in names])
        size = self.surrogate.registration.clock.size(parameters)
        beliefs = Beliefs(size, deviation, *self.surrogate.places(parameters))
        return np.asarray(beliefs.spread(band.spread, band.local, np.arange(len(names))) / band.unit)

    def left_out(self) -> NDArray[np.float64] | None:
        """(training run, state, point, 3), m: what a process over whole runs is off by where each run is left out of it.

        The run's image in a mirror is left out with it; modes and kernel are those of all runs. In the order of
        `record.parameters`; None for other models, and where a folder does not hold what this takes.
        """
        surrogate, core = self.surrogate, self.surrogate.core
        lists = [surrogate.record.parameters.get(n, []) for n in surrogate.record.ranges.names]
        if not isinstance(core, PodRegression) or not isinstance(core.machine, Gaussian) or core.inputs != "trajectory":
            return None
        if core.base is not None:
            return None
        runs, x = np.array(lists, np.float64).T, core.machine.x
        if len(runs) < 3 or not x.shape[1] or len(x) % len(runs):
            return None
        registration = surrogate.registration
        if not np.allclose(core.scaled(registration.read(runs)), x[: len(runs)], atol=1e-6):
            return None
        values = core.data.values.astype(np.float64).reshape(len(x), -1)
        kernel = core.machine.kernel
        inverse = np.linalg.inv(kernel(x, x) + _MEAN + (kernel.noise + 1e-10) * np.eye(len(x)))
        pulled = inverse @ values
        courses = []
        for k in range(len(runs)):
            own = np.arange(k, len(x), len(runs))
            courses.append(np.linalg.solve(inverse[np.ix_(own, own)], pulled[own])[0])
        known = np.array(courses).reshape(len(runs), len(core.data.time), -1)
        times = np.stack([registration.clock.times(one, self.time) for one in runs])
        every = np.eye(len(runs))
        out = (
            np.stack([between_courses(every, known, core.data.time, t) for t in times.T], axis=1)
            @ self._modes_here(core).T
        )
        out *= registration.clock.size(runs)[:, None, None]
        return np.asarray(out.reshape(len(runs), len(self.time), -1, 3))

    def _modes_here(self, core: PodRegression) -> NDArray[np.float64]:
        """(3 * point, mode)."""
        r = core.modes.shape[1]
        return np.asarray(self.where @ core.modes.reshape(-1, 3 * r).astype(np.float64)).reshape(-1, r)

    def _band(self) -> Band | None:
        return self.surrogate.bands.get((self.level, self.level > 0))

    def _by_process(self, core: PodRegression) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
        """The modes are read at the points once; what is left is the regression of few numbers."""
        here = self._modes_here(core)
        known, registration = core.courses.astype(np.float64), self.surrogate.registration
        trajectory = core.inputs == "trajectory"

        def courses(parameters: NDArray[np.float64]) -> NDArray[np.float64]:
            """(run, state, mode), each state at the run's own time on the reference's clock."""
            if not trajectory:
                return core.coefficients(registration.read(parameters), self.time)
            times = np.stack([registration.clock.times(one, self.time) for one in parameters])
            weights = core.weights(registration.read(parameters))
            return np.stack([between_courses(weights, known, core.data.time, t) for t in times.T], axis=1)

        def ask(parameters: NDArray[np.float64]) -> NDArray[np.float64]:
            out = courses(parameters) @ here.T
            out *= registration.clock.size(parameters)[:, None, None]
            return np.asarray(out.reshape(len(parameters), len(self.time), -1, 3))

        return ask

    def _by_network(self) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
        surrogate, level = self.surrogate, self.level
        down = self.where if level == 0 else sparse.csr_matrix(self.where @ surrogate.graphs.to_full(level))
        down = down.astype(np.float32)

        def end(states: Tensor) -> Tensor:
            import torch

            flat = states.numpy().reshape(states.shape[0], -1)
            return torch.from_numpy(np.asarray(down @ flat)).reshape(down.shape[0], -1, 3).transpose(0, 1)

        def ask(parameters: NDArray[np.float64]) -> NDArray[np.float64]:
            out = surrogate.registration.undo(
                lambda x, t: surrogate.by_network(x, t, level, end), parameters, self.time
            )
            return np.asarray(out, np.float64)

        return ask


def between_courses(
    weights: NDArray[np.float64], known: NDArray[np.float64], grid: NDArray[np.float64], time: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Weighted sums of courses, each at a time of its own, by the monotone cubic that predictions are interpolated with.

    weights (run, sample); known (sample, state, number) at `grid` (state,) s; time (run,) s -> (run, number)
    """
    from scipy.interpolate import PchipInterpolator

    count = known.shape[2]
    if len(grid) == 1:
        return np.asarray(weights @ known[:, 0])
    out = np.empty((len(weights), count))
    at = np.clip(time, grid[0], grid[-1])
    place = np.clip(np.searchsorted(grid, at), 1, len(grid) - 1)
    for j in np.unique(place):
        # The cubic between two states is set by them and their neighbours.
        rows, low, high = np.flatnonzero(place == j), max(j - 2, 0), min(j + 2, len(grid))
        course = (weights[rows] @ known[:, low:high].reshape(len(known), -1)).reshape(len(rows), high - low, count)
        cubic = PchipInterpolator(grid[low:high], course, axis=1).c[:, j - 1 - low]  # (4, run, number)
        step = (at[rows] - grid[j - 1])[:, None]
        out[rows] = ((cubic[0] * step + cubic[1]) * step + cubic[2]) * step + cubic[3]
    return out
