"""How parameters scatter, and draws of them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from evaluation.errors import EvaluationError

Floats = NDArray[np.float64]
Shape = Literal["normal", "uniform"]
Plan = Literal["latin", "sobol"]


@dataclass(frozen=True)
class Scatter:
    """One parameter that scatters about its nominal value.

    Attributes
    ----------
    name, unit
        Of the parameter.
    nominal
        Its value in the middle, in `unit`.
    width
        Standard deviation of a normal scatter, half the range of a uniform one; in `unit`.
    shape
        Normal or uniform.
    """

    name: str
    unit: str
    nominal: float
    width: float
    shape: Shape = "normal"

    def __post_init__(self) -> None:
        if not np.isfinite([self.nominal, self.width]).all() or self.width <= 0:
            raise EvaluationError(f"{self.name} scatters by {self.width:g} {self.unit}; expected a width above zero")

    @property
    def distribution(self) -> Any:
        """The frozen distribution of scipy.stats."""
        from scipy import stats

        if self.shape == "normal":
            return stats.norm(self.nominal, self.width)
        return stats.uniform(self.nominal - self.width, 2 * self.width)


def draw(scatter: Sequence[Scatter], count: int, seed: int, plan: Plan = "latin") -> Floats:
    """Draws (draw, parameter) that fill the scatter evenly.

    A Latin hypercube has one draw in each of `count` layers of every parameter (McKay, Beckman, Conover 1979); a Sobol
    sequence is even in all parameters together, best for a power of two.

    Raises
    ------
    EvaluationError
        For no draw, or nothing that scatters.
    """
    from scipy.stats import qmc

    if count < 2:
        raise EvaluationError(f"{count} draws asked for; expected at least two")
    if not scatter:
        raise EvaluationError("nothing scatters; expected at least one parameter, such as yield_stress=5%")
    if plan == "latin":
        unit = qmc.LatinHypercube(len(scatter), seed=seed).random(count)
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that a power of two would be more even
            unit = qmc.Sobol(len(scatter), seed=seed).random(count)
    unit = np.clip(unit, 1e-12, 1 - 1e-12)
    return np.stack([one.distribution.ppf(unit[:, k]) for k, one in enumerate(scatter)], axis=1)


@dataclass(frozen=True)
class Indices:
    """Sobol indices of numbers: which parameter's scatter makes theirs.

    Attributes
    ----------
    first, total
        (number, parameter): share of the variance by the parameter alone, and with all it does together with others.
    first_interval, total_interval
        (number, parameter, 2): bootstrap intervals.
    runs
        Predictions they were computed from.
    """

    first: Floats
    total: Floats
    first_interval: Floats
    total_interval: Floats
    runs: int


def sobol(scatter: Sequence[Scatter], numbers: Any, count: int, seed: int, confidence: float = 0.9) -> Indices:
    """First and total Sobol indices after Saltelli et al. 2010 (`scipy.stats.sobol_indices`).

    Parameters
    ----------
    numbers
        Called with draws (draw, parameter); gives (number, draw). Numbers that never change have indices of zero.
    count
        Predictions that may be asked for, about.
    """
    from scipy.stats import sobol_indices

    p = len(scatter)
    if p == 1:  # all the variance is its own
        found = np.atleast_2d(numbers(draw(scatter, 64, seed)))
        share = (np.ptp(found, axis=1) > 1e-12 * np.abs(found).max(axis=1))[:, None].astype(np.float64)
        ends = np.repeat(share[..., None], 2, axis=-1)
        return Indices(share, share, ends, ends, 64)
    base = int(2 ** max(6, np.floor(np.log2(max(count, 2) / (p + 2)))))
    still: list[NDArray[np.bool_]] = []

    def asked(x: Floats) -> Floats:
        found = np.atleast_2d(numbers(x.T))
        if not still:
            still.append(np.ptp(found, axis=1) <= 1e-12 * np.maximum(np.abs(found).max(axis=1), 1e-300))
        # A number that never changes has no variance to share out; any will do in its place.
        return np.where(still[0][:, None], x[:1], found)

    dists = [one.distribution for one in scatter]
    shares = sobol_indices(func=asked, n=base, dists=dists, random_state=np.random.default_rng(seed))
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")  # of numbers that never change, whose intervals are none
        spread = shares.bootstrap(confidence_level=confidence, n_resamples=199)
    moves = ~still[0][:, None]

    def tidy(values: Any) -> Floats:
        array = np.asarray(values, np.float64).reshape(len(still[0]), p)
        return np.where(moves, array, 0.0)

    intervals = [
        np.stack([tidy(i.confidence_interval.low), tidy(i.confidence_interval.high)], axis=-1)
        for i in (spread.first_order, spread.total_order)
    ]
    return Indices(tidy(shares.first_order), tidy(shares.total_order), intervals[0], intervals[1], base * (p + 2))
