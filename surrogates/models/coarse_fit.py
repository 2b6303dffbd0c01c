"""How coarse runs are put beneath fine ones, chosen by folds over the fine training runs.

What the coarse field says beyond the coarse fields at the fine runs' parameters is taken over with a slope for each mode,
from 0 to 1.2; one that few runs tell is drawn to that of all modes. The fine runs' weights have the lengths that these
suggest, or those of the differences of fine and coarse courses, which change more slowly with the parameters. A process
over the differences has all slopes one. With few runs folds cannot tell which of the three is best, and their mean is
better than each. A fold is judged with slopes that were fitted on the other folds, and by a coarse process without the
coarse runs of the parameters that are left out: a query has no coarse run of its own.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from surrogates.data.campaign import CoarseRuns
from surrogates.data.inputs import over_range
from surrogates.data.samples import LevelRuns, Notes
from surrogates.errors import SurrogateError
from surrogates.models.coarse_base import CoarseBase, coarse_modes
from surrogates.physics.clock import between
from surrogates.physics.registration import Registration
from surrogates.physics.trials import Trials
from surrogates.regression.gaussian import Gaussian, Kernel
from surrogates.settings import Settings

_log = logging.getLogger(__name__)

ALONE, OWN = "fine runs alone", "slopes, lengths of the fine runs"
LENGTHS, DIFFERENCES, MEAN = "slopes, lengths of the differences", "process over the differences", "mean of the three"
EVERYWHERE, OF_QUERY = "with a coarse run of the query among them", "from a coarse run of the query"
# Largest slope, and how strongly slopes are drawn to that of all modes, as a share of the mean square over the modes.
_STEEPEST, _RIDGE = 1.2, 1.0
# Coarse runs are kept if they lower the error by this share, and by so many standard errors of the mean over runs.
_WORTH_IT, _SURE = 0.01, 1.0
# How much a coarse run of the query counts beside the coarse process.
_SHARES = (1.0, 0.75, 0.5, 0.25)
# Its share where fewer fine runs than this have a coarse run by which it could be chosen.
_TWINS, _UNKNOWN = 6, 0.5
# Share of the range within which two parameters are the same.
_SAME = 1e-6
# Fewer fine runs choose no slopes, fewer coarse ones give no process.
_FEWEST = 4

Courses3 = NDArray[np.float32]


@dataclass
class CoarseFit:
    """What folds said of coarse runs.

    Attributes
    ----------
    way
        What is kept: MEAN, OWN or ALONE, the first that folds do not reject.
    errors
        E2, m, over left-out fine runs of each way, and of the best one where the coarse runs hold the query itself.
    runs, twins
        Coarse runs behind it, and fine runs whose parameters one of them has.
    machine, values, base
        The fine process, its courses (run and image, state, mode), and the coarse base; None where fine runs do better alone.
    held
        Of each left-out fine run: place, course (state, mode) at its own times without coarse run of its own, the same
        that starts from its coarse run (None without one), and the deviation.
    """

    way: str
    errors: dict[str, float]
    runs: int
    twins: int
    machine: Gaussian | None = None
    values: Courses3 | None = None
    base: CoarseBase | None = None
    held: list[tuple[int, Courses3, Courses3 | None, float]] = field(default_factory=list)


@dataclass(frozen=True)
class _Fold:
    """What one fold says of its left-out runs, as registered courses (run, state, mode).

    alone, beneath  weighted sums of the fine courses, and of the coarse ones at their parameters, by each kind of lengths
    far, near       the coarse process without and with the coarse runs of the left-out parameters
    deviation       (run,) of the fine process
    """

    held: NDArray[np.int64]
    alone: tuple[Courses3, Courses3]
    beneath: tuple[Courses3, Courses3]
    far: Courses3
    near: Courses3
    deviation: NDArray[np.float64]

    def over(self, way: str, slopes: Slopes, coarse: Courses3) -> Courses3:
        """The fine runs alone, and what the `coarse` field adds."""
        out = np.zeros_like(coarse)
        for kind, share, fitted in _TERMS[way]:
            taken = slopes[kind] if fitted else np.ones(coarse.shape[2])
            out += share * (self.alone[kind] + taken * (coarse - self.beneath[kind])).astype(np.float32)
        return out


# Slopes (mode,) by kind of lengths.
Slopes = tuple[NDArray[np.float64], NDArray[np.float64]]
# Of each way its terms: kind of lengths (of the fine runs, of the differences), share, whether slopes are fitted.
_TERMS: dict[str, list[tuple[int, float, bool]]] = {
    OWN: [(0, 1.0, True)],
    LENGTHS: [(1, 1.0, True)],
    DIFFERENCES: [(1, 1.0, False)],
    MEAN: [(0, 1 / 3, True), (1, 1 / 3, True), (1, 1 / 3, False)],
}


def fit_coarse(
    coarse: CoarseRuns,
    trials: Trials,
    registration: Registration,
    plane: int,
    turn: NDArray[np.float32],
    count: int,
    settings: Settings,
    notes: Notes,
) -> CoarseFit:
    """Put `coarse` beneath the fine runs of `trials`, if folds show a gain.

    Parameters
    ----------
    registration, plane
        As chosen for the fine runs.
    turn
        (mode of the common basis, mode): all modes in the order of their size; `count` of them are kept.

    Raises
    ------
    SurrogateError
        For coarse runs too few to give a process.
    """
    search = _Search(coarse, trials, registration, plane, turn, settings, notes)
    return search.best(count)


class _Search:
    def __init__(
        self, coarse: CoarseRuns, trials: Trials, registration: Registration, plane: int, turn: NDArray[np.float32],
        settings: Settings, notes: Notes,
    ) -> None:  # fmt: skip
        self.coarse, self.trials, self.of, self.turn = coarse, trials, registration, turn
        self.plane, self.seed = plane, settings.seed
        self.inputs = trials.inputs(registration)
        self.fine = trials.values(registration, plane) @ turn
        own, images = _coefficients(coarse, trials, registration, turn, settings, notes)
        parameters = coarse.campaign.parameters
        mirrored = registration.symmetry.images(parameters, registration.inputs.names)
        with np.errstate(invalid="ignore", divide="ignore"):
            inputs = registration.read(parameters)
        keep = np.flatnonzero(np.isfinite(inputs).all(axis=1))
        if len(keep) < len(parameters):
            notes.add(
                f"{len(parameters) - len(keep)} coarse runs are left out: their parameters have no derived inputs"
            )
        if len(keep) < _FEWEST:
            raise SurrogateError(f"there are {len(keep)} coarse runs; expected at least {_FEWEST}")
        self.count, sets, courses = len(keep), [inputs[keep]], [self._registered(own, parameters, keep)]
        if images is not None:
            beside = registration.read(mirrored[keep])
            if registration.symmetry.flagged:
                beside[:, -1] = 1.0
            sets.append(beside)
            courses.append(self._registered(images, parameters, keep))
        self.below = np.concatenate(courses)
        self.x = self._scaled(np.concatenate(sets))
        self.process = self._fitted(self.x, self.below)
        self.twin = _twins(trials.parameters, parameters[keep])
        self.at_fine = self._at_fine()

    def best(self, count: int) -> CoarseFit:
        """The way that folds prefer, fitted to all runs."""
        twins = int((self.twin >= 0).sum())
        if len(self.trials.folds.judged) < _FEWEST:
            return CoarseFit(ALONE, {}, self.count, twins)
        own = self._fitted(self._scaled(self.inputs), self.fine)
        apart = self._fitted(own.x, self.fine - self.at_fine, own.kernel)
        folds = list(self._across(list(self._folds(own.kernel, apart.kernel))))
        errors = {ALONE: self._errors(folds, lambda fold, slopes: fold.alone[0])}
        for way in _TERMS:
            errors[way] = self._errors(folds, _farther(way))
        told = {name: float(np.nanmean(e)) for name, e in errors.items()}
        way = next((w for w in (MEAN, OWN) if _clearly(errors[ALONE], errors[w])), ALONE)
        _log.info("coarse runs: %s", way)
        if way == ALONE:
            return CoarseFit(ALONE, told, self.count, twins)
        told[EVERYWHERE] = float(
            np.nanmean(self._errors(folds, lambda fold, slopes: fold.over(way, slopes, fold.near)))
        )
        share = _UNKNOWN
        if twins >= _TWINS:
            has = self.twin >= 0
            of_share = {s: float(np.nanmean(self._errors(folds, self._from_itself(way, s))[has])) for s in _SHARES}
            share = min(of_share, key=lambda tried: of_share[tried])
            told[OF_QUERY] = of_share[share]
        slopes = _both(_sum_of([sums for _, sums, _ in folds]))
        base, values = self._base(way, slopes, apart, count, share)
        held = [one for fold, _, fitted in folds for one in self._held(fold, way, fitted, count, share)]
        return CoarseFit(way, told, self.count, twins, own, values, base, held)

    def _base(self, way: str, slopes: Slopes, apart: Gaussian, count: int, share: float) -> tuple[CoarseBase, Courses3]:
        """What coarse runs add, and the courses that they leave to the process with the lengths of the fine runs."""
        left = [np.zeros_like(self.fine), np.zeros_like(self.fine)]
        total = np.zeros(self.fine.shape[2])
        for kind, part, fitted in _TERMS[way]:
            taken = slopes[kind] if fitted else np.ones(len(total))
            left[kind] += part * (self.fine - taken * self.at_fine).astype(np.float32)
            total += part * taken
        kept = [np.ascontiguousarray(courses[..., :count]) for courses in left]
        beside = (apart, kept[1]) if any(kind for kind, _, _ in _TERMS[way]) else None
        below = np.ascontiguousarray((total * self.below)[..., :count], np.float32)
        slope, where = total[:count].copy(), _labelled(self.coarse)
        base = CoarseBase(self.process, below, slope, self.coarse.to_fine, *where, share, beside)
        return base, kept[0]

    def _registered(
        self, courses: list[Courses3], parameters: NDArray[np.float64], keep: NDArray[np.int64]
    ) -> Courses3:
        """(kept run, state of the grid, mode)"""
        time, of = self.coarse.campaign.time, self.of
        if of.clock.is_identity:
            return np.stack([between(courses[k], time, of.grid) for k in keep])
        return np.stack([of.clock.apply(courses[k], parameters[k], time, of.grid) for k in keep])

    def _scaled(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Over the range of the fine runs, without inputs that are constant there."""
        return over_range(inputs, self.inputs)

    def _fitted(self, x: NDArray[np.float64], values: Courses3, start: Kernel | None = None) -> Gaussian:
        """A process of courses (run, state, mode) by scaled inputs."""
        ranges = np.ptp(self.inputs, axis=0) > 0
        moves = np.flatnonzero(ranges).tolist()
        mixed = [moves.index(k) for k in self.of.inputs.mixed if k in moves]
        return Gaussian(x, mixed=mixed).fit(self.trials.likely(self.of, values), self.seed, start)

    def _at_fine(self) -> Courses3:
        """(fine run and image, state, mode): the coarse run of the same parameters, else what the coarse process says there."""
        out = _weighted(self.process.weights(self._scaled(self.inputs)), self.below)
        runs = np.flatnonzero(self.twin >= 0)
        out[runs] = self.below[self.twin[runs]]
        if len(self.inputs) > len(self.twin):
            out[len(self.twin) + runs] = self.below[self.count + self.twin[runs]]
        return out

    def _folds(self, own: Kernel, apart: Kernel) -> Iterator[_Fold]:
        """What each fold says; the kernels of its processes start from those of all runs."""
        inputs = self._scaled(self.inputs)
        for train, held in self.trials.folds:
            if not len(held):
                continue
            part = self.trials.with_images(self.of, train)
            fine, coarse = self.fine[part], self.at_fine[part]
            machines = self._fitted(inputs[part], fine, own), self._fitted(inputs[part], fine - coarse, apart)
            weights = [machine.weights(inputs[held]) for machine in machines]
            twins = self.twin[held]
            gone = twins[twins >= 0]
            left = np.setdiff1d(np.arange(len(self.x)), np.concatenate([gone, gone + self.count]))
            left = left if len(left) else np.arange(len(self.x))  # a handful of coarse runs, all of this fold
            far = Gaussian(self.x[left], self.process.kernel).weights(inputs[held])
            yield _Fold(
                held, (_weighted(weights[0], fine), _weighted(weights[1], fine)),
                (_weighted(weights[0], coarse), _weighted(weights[1], coarse)), _weighted(far, self.below[left]),
                _weighted(self.process.weights(inputs[held]), self.below), machines[0].deviation(inputs[held]),
            )  # fmt: skip

    def _sums(self, fold: _Fold) -> NDArray[np.float64]:
        """(kind of lengths, 2, mode): products of what fine runs miss and what the coarse field adds, and its squares."""
        parameters, time = self.trials.parameters[fold.held], self.trials.courses.time
        size = self.of.clock.size(parameters)[:, None, None]
        known = size * self.of.clock.known(parameters, time, self.of.grid)[:, :, None]
        out = []
        for alone, beneath in zip(fold.alone, fold.beneath, strict=True):
            missed, added = known * (self.fine[fold.held] - alone), known * (self.at_fine[fold.held] - beneath)
            out.append([(missed * added).sum(axis=(0, 1)), (added * added).sum(axis=(0, 1))])
        return np.array(out)

    def _across(self, folds: list[_Fold]) -> Iterator[_Judged]:
        """Each fold, its sums, and slopes that were fitted without its runs."""
        sums = [self._sums(fold) for fold in folds]
        for fold, own in zip(folds, sums, strict=True):
            others = [s for f, s in zip(folds, sums, strict=True) if not np.intersect1d(f.held, fold.held).size]
            yield fold, own, _both(_sum_of(others or sums))  # runs named for validation are one fold alone

    def _errors(self, folds: list[_Judged], said: Callable[[_Fold, Slopes], Courses3]) -> NDArray[np.float64]:
        """(run,) e2, m; NaN for runs that are never left out."""
        runs = len(self.trials.parameters)
        total, rounds = np.zeros(runs), np.zeros(runs)
        for fold, _, slopes in folds:
            courses = self._undone(said(fold, slopes), fold.held) @ self.turn.T
            total[fold.held] += self.trials.distances(fold.held, courses)
            rounds[fold.held] += 1
        return np.where(rounds > 0, total / np.maximum(rounds, 1), np.nan)

    def _from_itself(self, way: str, share: float) -> Callable[[_Fold, Slopes], Courses3]:
        """What is said from the coarse run of each left-out run, which counts by `share`, and the process by the rest."""

        def said(fold: _Fold, slopes: Slopes) -> Courses3:
            own = self.at_fine[fold.held]
            return fold.over(way, slopes, np.float32(share) * own + np.float32(1 - share) * fold.far)

        return said

    def _undone(self, courses: Courses3, runs: NDArray[np.int64]) -> Courses3:
        """Registered courses of fine runs at the runs' own times: (run, state, mode)."""
        out, parameters = [], self.trials.parameters[runs]
        for course, one, size in zip(courses, parameters, self.of.clock.size(parameters), strict=True):
            times = self.of.clock.times(one, self.trials.courses.time)
            out.append(between(course, self.of.grid, times) * np.float32(size))
        return np.stack(out)

    def _held(
        self, fold: _Fold, way: str, slopes: Slopes, count: int, share: float
    ) -> Iterator[tuple[int, Courses3, Courses3 | None, float]]:
        far = self._undone(fold.over(way, slopes, fold.far), fold.held)[..., :count]
        itself = self._undone(self._from_itself(way, share)(fold, slopes), fold.held)[..., :count]
        for k, run in enumerate(fold.held):
            yield int(run), far[k], itself[k] if self.twin[run] >= 0 else None, float(fold.deviation[k])


# A fold, its sums (kind of lengths, 2, mode), and slopes from the other folds.
_Judged = tuple[_Fold, NDArray[np.float64], Slopes]


def _farther(way: str) -> Callable[[_Fold, Slopes], Courses3]:
    """What is said of runs without a coarse run of their own."""
    return lambda fold, slopes: fold.over(way, slopes, fold.far)


def _coefficients(
    coarse: CoarseRuns, trials: Trials, registration: Registration, turn: NDArray[np.float32], settings: Settings,
    notes: Notes,
) -> tuple[list[Courses3], list[Courses3] | None]:  # fmt: skip
    """(state, mode) of each coarse run, and of its image where there are any: each run is read once, and none is lifted."""
    runs = LevelRuns(coarse.campaign, 0, settings, notes)
    modes = trials.courses.modes @ turn
    seen = [coarse_modes(coarse.to_fine, modes)]
    mirror = registration.symmetry.mirror
    if mirror is not None:
        turned = np.einsum("xy,nxr->nyr", mirror.reflection, modes.reshape(-1, 3, modes.shape[1]))
        flat = np.ascontiguousarray(turned.reshape(-1, modes.shape[1]), np.float32)
        seen.append(coarse_modes((mirror.to_image @ coarse.to_fine).tocsr(), flat))
    out: list[list[Courses3]] = [[] for _ in seen]
    for k in range(len(coarse.campaign.parameters)):
        _log.info("coefficients of coarse run %d of %d", k + 1, len(coarse.campaign.parameters))
        states = runs.read(k)
        for one, rows in zip(out, seen, strict=True):
            one.append(states.reshape(len(states), -1) @ rows)
    return out[0], out[1] if len(out) > 1 else None


def _labelled(coarse: CoarseRuns) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Where the coarse nodes are, and the solver's numbers on them; 1, 2, .. without."""
    campaign = coarse.campaign
    if campaign.points is None:
        raise SurrogateError("coarse runs need their mesh, to tell later whether a coarse run is on it")
    numbers = np.arange(1, campaign.n_nodes + 1) if campaign.labels is None else campaign.labels.node_id
    return campaign.points, numbers


def _twins(fine: NDArray[np.float64], coarse: NDArray[np.float64]) -> NDArray[np.int64]:
    """(fine run,): the coarse run of the same parameters; -1 without one."""
    span = np.maximum(np.ptp(np.concatenate([fine, coarse]), axis=0), 1e-300)
    apart = np.abs((fine[:, None] - coarse[None]) / span).max(axis=2, initial=0.0)
    return np.where(apart.min(axis=1) <= _SAME, apart.argmin(axis=1), -1)


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
    needed = max(_WORTH_IT * float(np.nanmean(alone)), _SURE * float(gain.std(ddof=1)) / np.sqrt(len(gain)))
    return bool(gain.mean() > needed)
