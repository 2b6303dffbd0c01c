"""The probability that a limit is broken, and how sure that is: few draws, and a model that may be wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Draws by which both doubts are put together.
_MIXED = 4000


@dataclass(frozen=True)
class Probability:
    """Of breaking a limit.

    Attributes
    ----------
    value
        Share of the draws.
    sampling
        Interval for the number of draws alone (Clopper and Pearson 1934; an even plan of draws does better than that).
    model
        Interval by what the model may be wrong; None where it says nothing of its error.
    both
        The two together.
    confidence
        Of the intervals.
    draws, replicates
        How many draws, and how many times the model was drawn from its own uncertainty.
    """

    value: float
    sampling: tuple[float, float]
    model: tuple[float, float] | None
    both: tuple[float, float]
    confidence: float
    draws: int
    replicates: int


def probability(
    broken: NDArray[np.bool_],
    replicates: NDArray[np.bool_] | None,
    subset: NDArray[np.bool_] | None,
    confidence: float = 0.9,
    seed: int = 0,
) -> Probability:
    """The probability behind draws `broken` (draw,).

    Parameters
    ----------
    replicates
        (replicate, some draws): broken once more, each time with another model drawn from its own uncertainty.
    subset
        (some draws,): the same draws with the model as it is. The difference of the two is what the model may be wrong
        by; it is added to the value of all draws, so that the few draws of the replicates cost no accuracy.
    """
    from scipy.stats import beta, binomtest

    count, hits = len(broken), int(np.sum(broken))
    value = hits / count
    found = binomtest(hits, count).proportion_ci(confidence, method="exact")
    sampling = (float(found.low), float(found.high))
    if replicates is None or subset is None or not len(replicates):
        return Probability(value, sampling, None, sampling, confidence, count, 0)
    of_model = np.clip(value + replicates.mean(axis=1) - subset.mean(), 0, 1)
    tails = [(1 - confidence) / 2, (1 + confidence) / 2]
    low, high = np.quantile(of_model, tails)
    rng = np.random.default_rng(seed)
    picked = rng.choice(of_model, _MIXED)
    mixed = beta.rvs(picked * count + 0.5, (1 - picked) * count + 0.5, random_state=rng)
    ends = np.quantile(mixed, tails)
    both = (min(float(ends[0]), sampling[0]), max(float(ends[1]), sampling[1]))
    return Probability(value, sampling, (float(low), float(high)), both, confidence, count, len(replicates))
