"""How wrong a process is over its whole box, judged by its training runs alone, with an interval.

Runs that were chosen for what they teach lie where the box is hard, so their left-out errors say too much. The process's
own deviation averaged over the box says where it is unsure, but not in metres. The product of that average with the
mean ratio of error to deviation at left-out runs has neither fault.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_RESAMPLES = 2000


@dataclass(frozen=True)
class Judgement:
    """The error over the box, m, and between which bounds it lies with the asked confidence.

    Attributes
    ----------
    error, low, high
        m.
    confidence
        Of the interval [low, high].
    runs
        left-out runs behind it.
    means
        (resample,) the error over the box in each resample of these runs, m.
    """

    error: float
    low: float
    high: float
    confidence: float
    runs: int
    means: NDArray[np.float64]

    def below(self, target: float) -> bool:
        """Whether the error is below `target`, m, with the asked confidence."""
        return bool(np.quantile(self.means, self.confidence) < target)


def judge(
    errors: NDArray[np.float64],
    deviations: NDArray[np.float64],
    over_box: NDArray[np.float64],
    confidence: float = 0.9,
    seed: int = 0,
) -> Judgement:
    """The error over the box.

    Parameters
    ----------
    errors, deviations
        (run,) error of each run when it is left out, m, and the process's deviation there without it.
    over_box
        (point,) the process's deviation at points that stand for the box, with all runs.

    Notes
    -----
    The interval is the bootstrap's, over runs, widened on the logarithmic scale by t against normal quantiles.
    """
    from scipy.stats import norm, t

    scale = float(over_box.mean())
    ratio = errors / np.maximum(deviations, 1e-12)
    draws = np.random.default_rng(seed).integers(0, len(errors), (_RESAMPLES, len(errors)))
    means = ratio[draws].mean(axis=1)
    tail = (1 - confidence) / 2
    error = float(ratio.mean()) * scale
    wider = float(t.ppf(1 - tail, max(len(errors) - 1, 1)) / norm.ppf(1 - tail))
    spread = error * (means * scale / error) ** wider
    low, high = np.quantile(spread, [tail, 1 - tail])
    return Judgement(error, float(low), float(high), confidence, len(errors), spread)
