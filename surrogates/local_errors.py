"""Where in the box a model is wrong rather than far from its runs.

A stationary process, and a network no less, expects the same error wherever runs are equally dense. A structure may
fold to one side here and to the other a little further on, so that neighbouring runs differ by more than their distance
explains. Runs left out there were predicted worse than expected. The ratio of both, averaged over the runs near a
query, says how much wider its band should be, and which runs to look at.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Any query is near to one average run: far from all others the ratio goes to the mean.
# A run, or the surroundings of a query, is said to be hard from this many times the typical error on.
HARD = 2.0
# A run is near a query up to so many widths.
REACH = 2.0


@dataclass(frozen=True)
class LocalErrors:
    """Errors of left-out runs over what the model expected of them, and where the runs lie.

    Attributes
    ----------
    points
        (place, parameter) in [-1, 1] over the trained range; mirrored runs have a place of their own.
    ratio
        (place,) error over expected error; the median over runs is 1.
    run
        (place,) which run each is of; a run and its image, or a run that several folds left out, have the same.
    width
        How far a run speaks: the median distance from a run to the nearest other one.
    """

    points: NDArray[np.float64]
    ratio: NDArray[np.float64]
    run: NDArray[np.int64]
    width: float

    @classmethod
    def of(
        cls,
        points: NDArray[np.float64],
        errors: NDArray[np.float64],
        run: NDArray[np.int64],
        images: NDArray[np.float64] | None = None,
    ) -> LocalErrors:
        """From what happened to left-out runs.

        Parameters
        ----------
        points
            (k, parameter) in [-1, 1]; images: the same of the mirrored runs.
        errors
            (k,) error over expected error, in any unit.
        run
            (k,) which run each is of.
        """
        scale = float(np.median(errors))
        ratio = errors / scale if scale > 0 else np.ones(len(errors))
        if images is not None:
            points, ratio, run = np.concatenate([points, images]), np.tile(ratio, 2), np.tile(run, 2)
        apart = _distances(points, points)
        apart[run[:, None] == run] = np.inf
        nearest = apart.min(axis=1)
        known = nearest[np.isfinite(nearest)]
        width = float(np.median(known)) if len(known) else 1.0
        return cls(points, ratio, run, max(width, 1e-6))

    def at(self, points: NDArray[np.float64], run: NDArray[np.int64] | None = None) -> NDArray[np.float64]:
        """(query,): how many times the typical error to expect at points (query, parameter).

        run  (query,) the run each point is of: it and its image say nothing of themselves
        """
        weight = np.exp(-0.5 * np.square(_distances(points, self.points) / self.width))
        if run is not None:
            weight[run[:, None] == self.run] = 0.0
        return np.asarray((weight @ self.ratio + self.prior) / (weight.sum(axis=1) + 1))

    @property
    def prior(self) -> float:
        """What any query is told besides: one average run."""
        return float(self.ratio.mean())

    def hard_runs(self, point: NDArray[np.float64]) -> NDArray[np.int64]:
        """Numbers of the runs near a point (parameter,) that were predicted far worse than expected, the worst first."""
        near = _distances(point[None], self.points)[0] <= REACH * self.width
        places = np.flatnonzero(near & (self.ratio > HARD))
        found = self.run[places[np.argsort(-self.ratio[places], kind="stable")]]
        return found[np.sort(np.unique(found, return_index=True)[1])]


def _distances(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """(i, j) between points (i, parameter) and (j, parameter); scipy's takes half a second to import."""
    out = np.zeros((len(a), len(b)))
    for k in range(a.shape[1]):
        out += np.square(a[:, k, None] - b[None, :, k])
    return np.sqrt(out, out=out)
