"""Bringing runs with unequal output times to one time, and saying what that costs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import DataError

# Times that differ by less than this fraction of the whole span are the same output state.
_SAME = 1e-9


def common_time(times: Sequence[NDArray[np.float64]], wanted: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """The time grid of the dataset: `wanted`, or that of the run with the fewest states, cut where the shortest ends.

    times   (state,) of each run, s

    Raises DataError where `wanted` goes beyond a run's own times: nothing is extrapolated.
    """
    begin, end = max(float(t[0]) for t in times), min(float(t[-1]) for t in times)
    slack = _SAME * max(abs(end), abs(begin))
    if wanted is not None:
        if wanted[0] < begin - slack or wanted[-1] > end + slack:
            raise DataError(
                f"times {wanted[0]:g} to {wanted[-1]:g} s were asked for, but all runs together cover only {begin:g} to "
                f"{end:g} s; ask for less, or leave out the short runs"
            )
        return np.asarray(wanted, np.float64)
    coarsest = min(times, key=lambda t: (len(t), -float(t[-1])))
    inside = coarsest[(coarsest >= begin - slack) & (coarsest <= end + slack)]
    if len(inside) == 0:
        raise DataError("the runs have no time in common; check their output times, or ingest them apart")
    return np.asarray(inside, np.float64)


def same_time(own: NDArray[np.float64], common: NDArray[np.float64]) -> bool:
    """Whether a run's own times are the common ones, so that nothing needs to be interpolated."""
    return len(own) == len(common) and bool(
        np.all(np.abs(own - common) <= _SAME * max(1e-300, float(np.abs(common).max())))
    )


def interpolate(values: NDArray, own: NDArray[np.float64], common: NDArray[np.float64]) -> tuple[NDArray, float]:
    """`values` (own state, ...) at the common times, linear in time, and an estimate of the largest error made.

    The error of linear interpolation at a fraction f of a step h is f (1 - f) h^2 / 2 times the second derivative,
    which is taken from the second differences of the neighbouring states (the larger of both sides). NaN (eroded
    nodes) stay NaN wherever they take part, and do not count in the estimate.
    """
    right = (
        np.clip(np.searchsorted(own, common, side="left"), 1, len(own) - 1)
        if len(own) > 1
        else np.zeros(len(common), int)
    )
    if len(own) == 1:
        return values[right], 0.0
    left = right - 1
    step = own[right] - own[left]
    fraction = np.clip((common - own[left]) / step, 0.0, 1.0)
    fraction[np.abs(fraction) < 1e-9] = 0.0
    fraction[np.abs(fraction - 1) < 1e-9] = 1.0
    shape = (-1,) + (1,) * (values.ndim - 1)
    f = fraction.reshape(shape).astype(values.dtype)
    out = np.where(f == 0, values[left], np.where(f == 1, values[right], values[left] * (1 - f) + values[right] * f))
    between = (fraction > 0) & (fraction < 1)
    if not between.any() or len(own) < 3:
        return out, 0.0
    bend = np.zeros(len(own))  # largest |second derivative| over everything but time, at the inner states
    for k in range(1, len(own) - 1):
        h0, h1 = own[k] - own[k - 1], own[k + 1] - own[k]
        second = 2 * ((values[k + 1] - values[k]) / h1 - (values[k] - values[k - 1]) / h0) / (h0 + h1)
        bend[k] = np.nanmax(np.abs(second)) if np.isfinite(second).any() else 0.0
    weight = fraction * (1 - fraction) * step**2 / 2
    return out, float((weight * np.maximum(bend[left], bend[right])).max())


def nearest(values: NDArray, own: NDArray[np.float64], common: NDArray[np.float64]) -> NDArray:
    """`values` (own state, ...) at the last own time not after each common time: for flags such as `alive`."""
    slack = _SAME * max(1e-300, float(np.abs(own).max()))
    return values[np.clip(np.searchsorted(own, common + slack, side="right") - 1, 0, len(own) - 1)]
