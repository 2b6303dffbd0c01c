"""Bringing runs with unequal output times to one time, and saying what that costs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from crashkit.errors import DataError

# Times that differ by less than this fraction of the latest are the same: solvers keep them in single precision.
_SAME = 1e-6
# A run's last state also stands for times behind it up to this fraction of its last step.
_END = 0.05


def common_time(times: Sequence[NDArray[np.float64]], wanted: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """The times (state,) of the dataset, s: `wanted`, or those of the run with the fewest states.

    Solvers write the first state after a time is reached, so runs end at slightly different times: without `wanted`,
    ends within half a step of each other are brought to the earliest. Nothing is extrapolated.

    Parameters
    ----------
    times
        (state,) of each run, s.

    Raises
    ------
    DataError
        Where `wanted` is not increasing or goes beyond the `reach` of a run, or where runs have no common span.
    """
    begin, end = max(float(t[0]) for t in times), min(float(t[-1]) for t in times)
    slack = _SAME * max(abs(end), abs(begin))
    if wanted is not None:
        last = min(reach(t) for t in times)
        grid = np.asarray(wanted, np.float64)
        if grid.ndim != 1 or not len(grid) or not np.isfinite(grid).all() or (np.diff(grid) <= 0).any():
            raise DataError("the times asked for are not increasing numbers; give them in seconds, the earliest first")
        if grid[0] < begin - slack or grid[-1] > last:
            raise DataError(
                f"times {grid[0]:g} to {grid[-1]:g} s were asked for, but all runs together cover {begin:g} to {end:g} s; "
                "ask for less, or leave out the short runs"
            )
        return grid
    coarsest = min(times, key=lambda t: (len(t), -float(t[-1])))
    if end < begin:
        raise DataError(f"the runs have no time in common (one begins at {begin:g} s, one ends at {end:g} s)")
    near = max(slack, 0.499 * float(np.median(np.diff(coarsest))) if len(coarsest) > 1 else 0.0)
    grid = coarsest[(coarsest >= begin - near) & (coarsest <= end + near)].copy()
    if len(grid) == 0:
        raise DataError(
            f"no output time of the coarsest run lies in what all runs cover, {begin:g} to {end:g} s; give --time"
        )
    if abs(grid[0] - begin) > slack:
        grid[0] = max(grid[0], begin)
    if abs(grid[-1] - end) > slack:
        grid[-1] = min(grid[-1], end)
    return grid


def reach(own: NDArray[np.float64]) -> float:
    """The latest time, s, that the states at the times `own` (state,) stand for.

    Solvers write a state at the first time step behind its output time, so a run may end a hair before the others; its
    last state then stands for that hair, and `interpolation_error` counts it.
    """
    last = float(own[-1])
    return last + max(_SAME * abs(last), _END * (last - float(own[-2])) if len(own) > 1 else 0.0)


def same_time(own: NDArray[np.float64], common: NDArray[np.float64]) -> bool:
    """Whether a run's own times are the common ones, so that nothing needs to be interpolated."""
    return len(own) == len(common) and bool((np.abs(own - common) <= _SAME * np.abs(common).max(initial=0.0)).all())


def interpolate(
    values: NDArray[Any], own: NDArray[np.float64], common: NDArray[np.float64], *, cubic: bool = True
) -> NDArray[Any]:
    """`values` (own state, ...) at the `common` times; NaN behind what the last state stands for (`reach`).

    Cubic: Hermite polynomials whose slopes are those of the parabola through a state and its neighbours (Catmull-Rom
    where steps are even). On real crash runs their mean error is two thirds of that of straight lines. Straight
    lines, `cubic=False`, stay within the neighbours' values, as strains and the like need.
    """
    left, fraction = _places(own, common)
    out = np.empty((len(common), *values.shape[1:]), values.dtype)
    for k, (n, f) in enumerate(zip(left, fraction, strict=True)):
        if f == 0:
            out[k] = values[n]
        elif f == 1:
            out[k] = values[n + 1]
        elif cubic:
            out[k] = _hermite(values, own, n, f)
        else:
            out[k] = values[n] * (1 - f) + values[n + 1] * f
    beyond = common > reach(own)
    if beyond.any():
        out[beyond] = np.nan
    return out


def interpolation_error(values: NDArray[Any], own: NDArray[np.float64], common: NDArray[np.float64]) -> float:
    """Estimated largest error of the cubic interpolation, as length of a vector `values` (own state, ..., 3).

    Every own state is predicted from its neighbours alone, at twice the step, and compared; the larger miss at the
    ends of an interval counts with 4 f (1 - f) at the fraction f of it that is asked for. On real crash runs the
    estimate is about twice the true largest error. Where the last state stands for a later time, what the structure
    moves in between at its last speed is counted.
    """
    late = common[(common > own[-1] * (1 + _SAME)) & (common <= reach(own))]
    late_move = 0.0
    if len(late) and len(own) > 1:
        moved = np.sqrt(((values[-1] - values[-2]).astype(np.float64) ** 2).sum(axis=-1))
        late_move = float(np.nan_to_num(moved).max(initial=0.0) * (late[-1] - own[-1]) / (own[-1] - own[-2]))
    left, fraction = _places(own, common)
    weight = 4 * fraction * (1 - fraction)
    if not weight.any():
        return late_move
    needed = set(left[weight > 0]) | set(left[weight > 0] + 1)
    miss = np.zeros(len(own))
    for k in sorted(needed & set(range(1, len(own) - 1))):
        near = [n for n in (k - 2, k - 1, k + 1, k + 2) if 0 <= n < len(own)]
        place = near.index(k - 1)
        h = own[k + 1] - own[k - 1]
        predicted = _hermite(values[near], own[near], place, (own[k] - own[k - 1]) / h)
        apart = np.sqrt(((predicted - values[k]).astype(np.float64) ** 2).sum(axis=-1))
        miss[k] = np.nan_to_num(apart).max(initial=0.0)
    return max(late_move, float((weight * np.maximum(miss[left], miss[np.minimum(left + 1, len(own) - 1)])).max()))


def flags_at(flags: NDArray[np.bool_], own: NDArray[np.float64], common: NDArray[np.float64]) -> NDArray[np.bool_]:
    """`flags` (own state, ...) at the common times: True only where both neighbouring own states are."""
    left, fraction = _places(own, common)
    right = np.minimum(left + 1, len(own) - 1)
    shape = (-1,) + (1,) * (flags.ndim - 1)
    return np.asarray((flags[left] | (fraction == 1).reshape(shape)) & (flags[right] | (fraction == 0).reshape(shape)))


def _places(own: NDArray[np.float64], common: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """For each common time the own state before it, and the fraction of the step behind that, exactly 0 or 1 at states."""
    if len(own) == 1:
        return np.zeros(len(common), np.int64), np.zeros(len(common))
    left = np.clip(np.searchsorted(own, common, side="right") - 1, 0, len(own) - 2)
    fraction = np.clip((common - own[left]) / (own[left + 1] - own[left]), 0.0, 1.0)
    slack = _SAME * max(abs(float(own[-1])), abs(float(own[0])))
    fraction[np.abs(common - own[left]) <= slack] = 0.0
    fraction[np.abs(common - own[left + 1]) <= slack] = 1.0
    return left, fraction


def _hermite(values: NDArray[Any], own: NDArray[np.float64], n: int, f: float) -> NDArray[Any]:
    """Cubic Hermite polynomial between states n and n + 1 at the fraction f; a line where a neighbour is no number."""
    h = float(own[n + 1] - own[n])
    a, b = values[n], values[n + 1]
    straight = a * (1 - f) + b * f
    if len(own) < 3:
        return np.asarray(straight)
    slope_a, slope_b = _slope(values, own, n), _slope(values, own, n + 1)
    ends, slopes = np.stack([a, b]), np.stack([slope_a, slope_b])
    known = np.isfinite(ends).all(axis=0) & np.isfinite(slopes).all(axis=0)
    spline = CubicHermiteSpline([0.0, h], np.where(known, ends, 0.0), np.where(known, slopes, 0.0))
    return np.asarray(np.where(known, spline(f * h).astype(values.dtype), straight))


def _slope(values: NDArray[Any], own: NDArray[np.float64], n: int) -> NDArray[Any]:
    """Slope at state n of the parabola through it and its neighbours (the nearest three states at the ends)."""
    m = min(max(n, 1), len(own) - 2)
    before, after = float(own[m] - own[m - 1]), float(own[m + 1] - own[m])
    first, second = (values[m] - values[m - 1]) / before, (values[m + 1] - values[m]) / after
    bend = (second - first) / (before + after)
    slope: NDArray[Any] = first + bend * (before + 2 * float(own[n] - own[m]))
    return slope
