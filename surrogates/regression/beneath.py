"""Courses of coarse runs put beneath those of fine ones, chosen by folds over the fine runs.

What the coarse field says beyond the coarse fields at the fine runs' parameters is taken over with a slope for each mode,
from 0 to 1.2; one that few runs tell is drawn to that of all modes. The fine runs' weights have the lengths that these
suggest, or those of the differences of fine and coarse courses, which change more slowly with the parameters. A process
over the differences has all slopes one. With few runs folds cannot tell which of the three is best, and their mean is
better than each. A fold is judged with slopes that were fitted on the other folds, and by a coarse process without the
coarse runs of the parameters that are left out: a query has no coarse run of its own.

A course is one number after another of any linear encoding: coefficients of modes, or latent numbers of a level.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from surrogates.regression.gaussian import Gaussian, Kernel

_log = logging.getLogger(__name__)

ALONE, OWN = "fine runs alone", "slopes, lengths of the fine runs"
LENGTHS, DIFFERENCES, MEAN = "slopes, lengths of the differences", "process over the differences", "mean of the three"
EVERYWHERE, OF_QUERY = "with a coarse run of the query among them", "from a coarse run of the query"
# Largest slope, and how strongly slopes are drawn to that of all modes, as a share of the mean square over the modes.
_STEEPEST, _RIDGE = 1.2, 1.0
# Coarse runs are kept if they lower the error by this share, and by so many standard errors of the mean over runs.
WORTH_IT, _SURE = 0.01, 1.0
# How much a coarse run of the query counts beside the coarse process.
_SHARES = (1.0, 0.75, 0.5, 0.25)
# Its share where fewer fine runs than this have a coarse run by which it could be chosen.
_TWINS, _UNKNOWN = 6, 0.5
# Share of the range within which two parameters are the same.
_SAME = 1e-6
# Fewer fine runs choose no slopes.
_FEWEST = 4

# What folds compare with the fine runs alone.
WAYS = (OWN, LENGTHS, DIFFERENCES, MEAN)

Courses3 = NDArray[np.float32]
# Slopes (mode,) by kind of lengths.
Slopes = tuple[NDArray[np.float64], NDArray[np.float64]]
# Of each way its terms: kind of lengths (of the fine runs, of the differences), share, whether slopes are fitted.
_TERMS: dict[str, list[tuple[int, float, bool]]] = {
    OWN: [(0, 1.0, True)],
    LENGTHS: [(1, 1.0, True)],
    DIFFERENCES: [(1, 1.0, False)],
    MEAN: [(0, 1 / 3, True), (1, 1 / 3, True), (1, 1 / 3, False)],
}


@dataclass(frozen=True)
class FineRuns:
    """Fine runs as a regression sees them: runs as computed, then their images in the same order.

    Attributes
    ----------
    x
        (run and image, input) scaled.
    courses
        (run and image, state, mode): in one unit, since the squares of modes are compared.
    own
        How many runs were computed.
    folds
        Of each: places of the runs that train, and of those left out.
    mixed, seed
        Of the processes, see `gaussian.Gaussian`.
    likely
        From courses to what a process's likelihood counts of them, (run, number).
    weight
        From places of runs to (run, state): how much each state's error counts where slopes are fitted.
    errors
        From places of runs and what is said of them, (run, state, mode), to their errors (run,), m.
    """

    x: NDArray[np.float64]
    courses: Courses3
    own: int
    folds: Sequence[tuple[NDArray[np.int64], NDArray[np.int64]]]
    mixed: Sequence[int]
    seed: int
    likely: Callable[[NDArray[np.floating]], NDArray[np.float64]]
    weight: Callable[[NDArray[np.int64]], NDArray[np.float64]]
    errors: Callable[[NDArray[np.int64], Courses3], NDArray[np.float64]]

    def with_images(self, runs: NDArray[np.int64]) -> NDArray[np.int64]:
        """Places of the runs and their images."""
        return runs if len(self.x) == self.own else np.concatenate([runs, runs + self.own])

    def fitted(self, x: NDArray[np.float64], courses: NDArray[np.floating], start: Kernel | None = None) -> Gaussian:
        """A process of courses (run, state, mode) by scaled inputs."""
        return Gaussian(x, mixed=self.mixed).fit(self.likely(courses), self.seed, start)


@dataclass(frozen=True)
class RunsBelow:
    """Coarse runs, then their images: scaled inputs, courses (run and image, state, mode), and how many were computed.

    twin  (fine run,) the coarse run of the same parameters; -1 without one
    """

    x: NDArray[np.float64]
    courses: Courses3
    own: int
    twin: NDArray[np.int64]


@dataclass(frozen=True)
class Said:
    """What one fold says at some inputs, as courses (run, state, mode).

    alone, beneath  weighted sums of the fine courses, and of the coarse ones at their parameters, by each kind of lengths
    far, near       the coarse process without and with the coarse runs of the left-out parameters
    """

    alone: tuple[Courses3, Courses3]
    beneath: tuple[Courses3, Courses3]
    far: Courses3
    near: Courses3

    def over(self, way: str, slopes: Slopes, coarse: Courses3) -> Courses3:
        """The fine runs alone, and what the `coarse` field adds."""
        if way == ALONE:
            return self.alone[0]
        out = np.zeros_like(coarse)
        for kind, share, fitted in _TERMS[way]:
            taken = slopes[kind] if fitted else np.ones(coarse.shape[2])
            out += share * (self.alone[kind] + taken * (coarse - self.beneath[kind])).astype(np.float32)
        return out


@dataclass(frozen=True)
class Part:
    """The processes without the runs `held` of one fold, what they say of these, and slopes fitted without them."""

    held: NDArray[np.int64]
    said: Said
    deviation: NDArray[np.float64]
    at: Callable[[NDArray[np.float64]], Said]
    slopes: Slopes


@dataclass
class Beneath:
    """What folds said of coarse runs.

    Attributes
    ----------
    way
        What is kept: MEAN, OWN or ALONE, the first that folds do not reject.
    errors
        Errors, m, over left-out fine runs of each way, and of the best one where the coarse runs hold the query itself.
    runs, twins
        Coarse runs behind it, and fine runs whose parameters one of them has.
    own, beside, below
        Processes and their courses, whose sum is the prediction: with the lengths of the fine runs, of the differences
        (None where no term has them), and over the coarse runs. Empty where fine runs do better alone.
    slopes
        (mode,) how much of the coarse field is taken over: it is in the courses of `below` already.
    share
        How much a coarse run of the query counts beside the coarse process.
    parts
        The folds.
    at_fine
        (fine run and image, state, mode) of the coarse field at the fine runs' parameters.
    """

    way: str
    errors: dict[str, float]
    runs: int
    twins: int
    own: tuple[Gaussian, Courses3] | None = None
    beside: tuple[Gaussian, Courses3] | None = None
    below: tuple[Gaussian, Courses3] | None = None
    slopes: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    share: float = _UNKNOWN
    parts: list[Part] = field(default_factory=list)
    at_fine: Courses3 = field(default_factory=lambda: np.empty((0, 0, 0), np.float32))

    def far(self, part: Part) -> Courses3:
        """What is said of the runs that `part` leaves out, which have no coarse run of their own."""
        return part.said.over(self.way, part.slopes, part.said.far)

    def itself(self, part: Part) -> Courses3:
        """The same, from the coarse run of each."""
        return from_itself(self.way, self.share, self.at_fine)(part)


def put_beneath(fine: FineRuns, below: RunsBelow) -> Beneath:
    """The way that folds prefer, fitted to all runs."""
    return _Search(fine, below).best()


def twins(fine: NDArray[np.float64], coarse: NDArray[np.float64]) -> NDArray[np.int64]:
    """(fine run,): the coarse run of the same parameters; -1 without one."""
    span = np.maximum(np.ptp(np.concatenate([fine, coarse]), axis=0), 1e-300)
    apart = np.abs((fine[:, None] - coarse[None]) / span).max(axis=2, initial=0.0)
    return np.where(apart.min(axis=1) <= _SAME, apart.argmin(axis=1), -1)


def from_itself(way: str, share: float, at_fine: Courses3) -> Callable[[Part], Courses3]:
    """What is said from the coarse run of each left-out run, which counts by `share`, and the process by the rest."""

    def said(part: Part) -> Courses3:
        own = at_fine[part.held]
        coarse = np.float32(share) * own + np.float32(1 - share) * part.said.far
        return part.said.over(way, part.slopes, coarse)

    return said


class _Search:
    def __init__(self, fine: FineRuns, below: RunsBelow) -> None:
        self.fine, self.below = fine, below
        self.process = fine.fitted(below.x, below.courses)
        self.at_fine = self._at_fine()

    def best(self) -> Beneath:
        fine, below = self.fine, self.below
        count = int((below.twin >= 0).sum())
        judged = {int(run) for _, held in fine.folds for run in held}
        if len(judged) < _FEWEST:
            return Beneath(ALONE, {}, below.own, count)
        own = fine.fitted(fine.x, fine.courses)
        apart = fine.fitted(fine.x, fine.courses - self.at_fine, own.kernel)
        raw = list(self._parts(own.kernel, apart.kernel))
        sums = [self._sums(part) for part in raw]
        parts = list(_across(raw, sums))
        errors = {way: self._errors(parts, _farther(way)) for way in (ALONE, *_TERMS)}
        told = {name: float(np.nanmean(e)) for name, e in errors.items()}
        way = next((w for w in (MEAN, OWN) if _clearly(errors[ALONE], errors[w])), ALONE)
        _log.info("coarse runs: %s", way)
        if way == ALONE:
            return Beneath(ALONE, told, below.own, count)
        near = self._errors(parts, lambda part: part.said.over(way, part.slopes, part.said.near))
        told[EVERYWHERE] = float(np.nanmean(near))
        share = _UNKNOWN
        if count >= _TWINS:
            has = below.twin >= 0
            of_share = {
                s: float(np.nanmean(self._errors(parts, from_itself(way, s, self.at_fine))[has])) for s in _SHARES
            }
            share = min(of_share, key=lambda tried: of_share[tried])
            told[OF_QUERY] = of_share[share]
        out = Beneath(way, told, below.own, count, share=share, parts=parts, at_fine=self.at_fine)
        self._fit(out, own, apart, _both(_sum_of(sums)))
        return out

    def _fit(self, out: Beneath, own: Gaussian, apart: Gaussian, slopes: Slopes) -> None:
        """The processes of all runs, and the courses that each of them weighs."""
        fine = self.fine.courses
        left = [np.zeros_like(fine), np.zeros_like(fine)]
        total = np.zeros(fine.shape[2])
        for kind, part, fitted in _TERMS[out.way]:
            taken = slopes[kind] if fitted else np.ones(len(total))
            left[kind] += part * (fine - taken * self.at_fine).astype(np.float32)
            total += part * taken
        out.own = own, left[0]
        out.beside = (apart, left[1]) if any(kind for kind, _, _ in _TERMS[out.way]) else None
        out.below = self.process, (total * self.below.courses).astype(np.float32)
        out.slopes = total

    def _at_fine(self) -> Courses3:
        """(fine run and image, state, mode): the coarse run of the same parameters, else what the coarse process says there."""
        below = self.below
        out = _weighted(self.process.weights(self.fine.x), below.courses)
        runs = np.flatnonzero(below.twin >= 0)
        out[runs] = below.courses[below.twin[runs]]
        if len(self.fine.x) > self.fine.own:
            out[self.fine.own + runs] = below.courses[below.own + below.twin[runs]]
        return out

    def _parts(self, own: Kernel, apart: Kernel) -> Iterator[Part]:
        """What each fold says; the kernels of its processes start from those of all runs."""
        fine, below = self.fine, self.below
        for train, held in fine.folds:
            if not len(held):
                continue
            part = fine.with_images(train)
            courses, coarse = fine.courses[part], self.at_fine[part]
            machines = fine.fitted(fine.x[part], courses, own), fine.fitted(fine.x[part], courses - coarse, apart)
            gone = below.twin[held]
            gone = gone[gone >= 0]
            left = np.setdiff1d(np.arange(len(below.x)), np.concatenate([gone, gone + below.own]))
            left = left if len(left) else np.arange(len(below.x))  # a handful of coarse runs, all of this fold
            far = Gaussian(below.x[left], self.process.kernel)

            def at(
                x: NDArray[np.float64], machines: tuple[Gaussian, Gaussian] = machines, part: NDArray[np.int64] = part,
                far: Gaussian = far, left: NDArray[np.int64] = left,
            ) -> Said:  # fmt: skip
                weights = [machine.weights(x) for machine in machines]
                courses, coarse = fine.courses[part], self.at_fine[part]
                return Said(
                    (_weighted(weights[0], courses), _weighted(weights[1], courses)),
                    (_weighted(weights[0], coarse), _weighted(weights[1], coarse)),
                    _weighted(far.weights(x), below.courses[left]),
                    _weighted(self.process.weights(x), below.courses),
                )

            nothing = np.empty(0)
            yield Part(held, at(fine.x[held]), machines[0].deviation(fine.x[held]), at, (nothing, nothing))

    def _sums(self, part: Part) -> NDArray[np.float64]:
        """(kind of lengths, 2, mode): products of what fine runs miss and what the coarse field adds, and its squares."""
        weight = self.fine.weight(part.held)[:, :, None]
        out = []
        for alone, beneath in zip(part.said.alone, part.said.beneath, strict=True):
            missed = weight * (self.fine.courses[part.held] - alone)
            added = weight * (self.at_fine[part.held] - beneath)
            out.append([(missed * added).sum(axis=(0, 1)), (added * added).sum(axis=(0, 1))])
        return np.array(out)

    def _errors(self, parts: list[Part], said: Callable[[Part], Courses3]) -> NDArray[np.float64]:
        """(run,) m; NaN for runs that are never left out."""
        total, rounds = np.zeros(self.fine.own), np.zeros(self.fine.own)
        for part in parts:
            total[part.held] += self.fine.errors(part.held, said(part))
            rounds[part.held] += 1
        return np.where(rounds > 0, total / np.maximum(rounds, 1), np.nan)


def _farther(way: str) -> Callable[[Part], Courses3]:
    """What is said of runs without a coarse run of their own."""
    return lambda part: part.said.over(way, part.slopes, part.said.far)


def _across(parts: list[Part], sums: list[NDArray[np.float64]]) -> Iterator[Part]:
    """Each fold with slopes that were fitted without its runs."""
    for part in parts:
        others = [s for p, s in zip(parts, sums, strict=True) if not np.intersect1d(p.held, part.held).size]
        slopes = _both(_sum_of(others or sums))  # runs named for validation are one fold alone
        yield Part(part.held, part.said, part.deviation, part.at, slopes)


def _sum_of(sums: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """The sum over folds."""
    return np.asarray(np.sum(sums, axis=0))


def _both(sums: NDArray[np.float64]) -> Slopes:
    return _slopes(sums[0]), _slopes(sums[1])


def _slopes(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """(mode,) from products and squares (2, mode): least squares drawn to the slope of all modes, within bounds."""
    product, square = sums
    pull = _RIDGE * max(float(square.mean()), 1e-300)
    every = product.sum() / max(float(square.sum()), 1e-300)
    return np.asarray(np.clip((product + pull * every) / (square + pull), 0.0, _STEEPEST))


def _weighted(weights: NDArray[np.float64], values: Courses3) -> Courses3:
    flat = weights.astype(np.float32) @ values.reshape(len(values), -1)
    return np.asarray(flat.reshape(len(weights), *values.shape[1:]), np.float32)


def _clearly(alone: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Whether the error falls beyond what the runs that happen to be there would explain."""
    gain = (alone - other)[np.isfinite(alone)]
    needed = max(WORTH_IT * float(np.nanmean(alone)), _SURE * float(gain.std(ddof=1)) / np.sqrt(len(gain)))
    return bool(gain.mean() > needed)
