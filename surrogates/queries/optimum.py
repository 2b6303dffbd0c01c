"""The smallest value of one number over a box while others keep their bounds, from several starts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Step of finite differences and distance between answers that are one, in widths of the box; the excess over a bound, in
# its spread over the box, that counts as none.
_STEP, _SAME, _KEPT = 1e-3, 0.02, 2e-3
_ITERATIONS = 60


@dataclass(frozen=True)
class Problem:
    """What is made small and what is kept.

    Attributes
    ----------
    values
        (point, parameter) -> (point, 1 + limit): the number to be made small, and the excess over each bound, at most 0
        where it is kept.
    low, high
        (parameter,) the box; a parameter with low == high is given.
    """

    values: Callable[[Floats], Floats]
    low: Floats
    high: Floats

    @property
    def free(self) -> NDArray[np.bool_]:
        return np.asarray(self.high > self.low)

    def whole(self, unit: Floats) -> Floats:
        """(point, free parameter) in [0, 1] -> (point, parameter)."""
        out = np.repeat(self.low[None], len(unit), axis=0)
        out[:, self.free] += np.clip(unit, 0, 1) * (self.high - self.low)[self.free]
        return out

    def slopes(self, point: Floats) -> Floats:
        """(1 + limit, parameter): derivatives at (parameter,) by finite differences, 0 by given parameters."""
        step = _STEP * (self.high - self.low)
        step = np.where(point + step > self.high, -step, step)
        found = self.values(np.concatenate([point[None], point + np.diag(step)[self.free]]))
        out = np.zeros((found.shape[1], len(point)))
        out[:, self.free] = ((found[1:] - found[0]) / step[self.free, None]).T
        return out


@dataclass(frozen=True)
class LocalAnswer:
    """A local answer: parameters (parameter,), the number, the excess (limit,), and whether all bounds are kept."""

    parameters: Floats
    value: float
    excess: Floats
    kept: bool


@dataclass(frozen=True)
class Sampled:
    """The box as it was looked over before the search: points (point, parameter) and their values (point, 1 + limit)."""

    points: Floats
    values: Floats

    @property
    def scale(self) -> Floats:
        """(1 + limit,): spread of each number over the box."""
        spread = self.values.std(axis=0)
        return np.asarray(np.where(spread > 0, spread, np.maximum(np.abs(self.values).max(axis=0), 1e-12)))


def sampled(problem: Problem, count: int, seed: int, report: Callable[[int], None]) -> Sampled:
    """The box looked over at `count` points of a Sobol sequence, a few at a time."""
    from scipy.stats import qmc

    unit = qmc.Sobol(int(problem.free.sum()), seed=seed).random_base2(max(1, int(np.log2(count))))
    points = problem.whole(unit)
    found = []
    for k in range(0, len(points), 16):
        found.append(problem.values(points[k : k + 16]))
        report(min(k + 16, len(points)))
    return Sampled(points, np.concatenate(found))


def search(problem: Problem, known: Sampled, shift: Floats, starts: int, extra: list[Floats]) -> list[LocalAnswer]:
    """Local answers, the best first: those that keep all bounds by their value, then the others by their excess.

    Parameters
    ----------
    shift
        (limit,): by how much each bound is tightened.
    starts
        Points of `known` to start from.
    extra
        Further starts (parameter,).

    Notes
    -----
    Sequential least squares (scipy's SLSQP) with derivatives by finite differences, in units of the spread of each
    number over the box. Where it ends beyond a bound, the sum of squared excesses is made small instead.
    """
    scale = known.scale
    ends = [_descend(problem, scale, shift, start) for start in [*extra, *_starts(known, scale, shift, starts)]]
    span = np.where(problem.free, problem.high - problem.low, 1.0)
    ends.sort(key=lambda e: (not e.kept, e.value if e.kept else float(_beyond(e.excess + shift, scale).max())))
    out: list[LocalAnswer] = []
    for end in ends:
        if all(np.abs((end.parameters - o.parameters) / span).max() > _SAME for o in out):
            out.append(end)
    return out


def _starts(known: Sampled, scale: Floats, shift: Floats, count: int) -> list[Floats]:
    """The best point, then points of the best quarter, each as far as can be from those before."""
    merit = known.values[:, 0] / scale[0] + 10 * _beyond(known.values[:, 1:] + shift, scale).sum(axis=1)
    good = np.argsort(merit, kind="stable")[: max(count, len(merit) // 4)]
    spread = known.points.std(axis=0)
    places = known.points[good] / np.where(spread > 0, spread, 1.0)
    chosen = [0]
    while len(chosen) < min(count, len(good)):
        gap = np.linalg.norm(places[:, None] - places[chosen][None], axis=2).min(axis=1)
        chosen.append(int(gap.argmax()))
    return [known.points[good[k]] for k in chosen]


def _beyond(excess: Floats, scale: Floats) -> Floats:
    return np.asarray(np.maximum(excess, 0) / scale[1:])


def _descend(problem: Problem, scale: Floats, shift: Floats, start: Floats) -> LocalAnswer:
    from scipy.optimize import minimize

    free = problem.free
    span = (problem.high - problem.low)[free]
    first = np.clip((start - problem.low)[free] / span, 0, 1)
    kept: dict[bytes, tuple[Floats, Floats]] = {}

    def at(unit: Floats) -> tuple[Floats, Floats]:
        """Values (1 + limit,) and slopes (1 + limit, free parameter), scaled."""
        unit = np.clip(unit, 0, 1)
        key = unit.tobytes()
        if key not in kept:
            step = np.where(unit + _STEP > 1, -_STEP, _STEP)
            found = problem.values(problem.whole(np.concatenate([unit[None], unit + np.diag(step)])))
            found = (found + np.concatenate([[0.0], shift])) / scale
            kept[key] = found[0], ((found[1:] - found[0]) / step[:, None]).T
        values, slopes = kept[key]
        return values.copy(), slopes.copy()  # the optimiser writes into what it is given

    bounds = [(0.0, 1.0)] * len(first)
    limits = {"type": "ineq", "fun": lambda u: -at(u)[0][1:], "jac": lambda u: -at(u)[1][1:]}
    end = minimize(
        lambda u: at(u)[0][0], first, jac=lambda u: at(u)[1][0], bounds=bounds, method="SLSQP",
        constraints=[limits] if len(shift) else [], options={"maxiter": _ITERATIONS, "ftol": 1e-6},
    ).x  # fmt: skip
    if len(shift) and at(end)[0][1:].max() > _KEPT:
        again = minimize(
            lambda u: float(np.square(np.maximum(at(u)[0][1:], 0)).sum()), end,
            jac=lambda u: 2 * np.maximum(at(u)[0][1:], 0) @ at(u)[1][1:], bounds=bounds, method="L-BFGS-B",
            options={"maxiter": _ITERATIONS},
        ).x  # fmt: skip
        end = again if at(again)[0][1:].max() < at(end)[0][1:].max() else end
    found = at(end)[0] * scale - np.concatenate([[0.0], shift])
    return LocalAnswer(
        problem.whole(np.clip(end, 0, 1)[None])[0], float(found[0]), found[1:], bool((at(end)[0][1:] <= _KEPT).all())
    )
