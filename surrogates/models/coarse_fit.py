"""How coarse runs are put beneath the fine ones of a POD regression: as courses of coefficients of the fine runs' modes.

What is taken over, and whether anything is, folds over the fine training runs say: `surrogates.regression.beneath`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from surrogates.data.campaign import FEWEST_COARSE, CoarseRuns
from surrogates.data.inputs import over_range
from surrogates.data.samples import LevelRuns, Notes
from surrogates.errors import SurrogateError
from surrogates.models.coarse_base import CoarseBase, CoarseMesh, coarse_modes
from surrogates.physics.clock import between
from surrogates.physics.registration import Registration
from surrogates.physics.trials import Trials
from surrogates.regression.beneath import Beneath, Courses3, FineRuns, RunsBelow, put_beneath, twins
from surrogates.regression.gaussian import Gaussian
from surrogates.settings import Settings

_log = logging.getLogger(__name__)


@dataclass
class CoarseFit:
    """What folds said of coarse runs.

    Attributes
    ----------
    way, errors, runs, twins
        See `regression.beneath.Beneath`; errors are e2, m.
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
    inputs = trials.inputs(registration)
    keep = with_inputs(coarse, registration, notes)
    own, images = _coefficients(coarse, trials, registration, turn, settings, notes)
    parameters = coarse.campaign.parameters
    courses = [_registered(coarse, registration, some, keep) for some in (own, images) if some is not None]
    below = RunsBelow(
        over_range(registration.read_with_images(parameters[keep]), inputs), np.concatenate(courses), len(keep),
        twins(trials.parameters, parameters[keep]),
    )  # fmt: skip
    fine = _Fine(trials, registration, plane, turn, inputs)
    found = put_beneath(fine.runs(), below)
    out = CoarseFit(found.way, found.errors, found.runs, found.twins)
    if found.own is not None and found.below is not None:
        out.machine, out.values = found.own[0], _first(found.own[1], count)
        second = None if found.beside is None else (found.beside[0], _first(found.beside[1], count))
        out.base = CoarseBase(
            found.below[0], _first(found.below[1], count), found.slopes[:count].copy(), CoarseMesh.of(coarse),
            found.share, second,
        )  # fmt: skip
        out.held = list(fine.left_out(found, below, count))
    return out


def with_inputs(coarse: CoarseRuns, registration: Registration, notes: Notes) -> NDArray[np.int64]:
    """Places of the coarse runs whose parameters have the derived inputs of the registration.

    Raises
    ------
    SurrogateError
        Where they are too few to give a process.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        inputs = registration.read(coarse.campaign.parameters)
    keep = np.flatnonzero(np.isfinite(inputs).all(axis=1))
    if len(keep) < len(inputs):
        notes.add(f"{len(inputs) - len(keep)} coarse runs are left out: their parameters have no derived inputs")
    if len(keep) < FEWEST_COARSE:
        raise SurrogateError(
            f"{len(keep)} of {len(inputs)} coarse runs have derived inputs; expected at least {FEWEST_COARSE}"
        )
    return keep


@dataclass(frozen=True)
class _Fine:
    """The fine runs of `trials`, behind a registration, in the modes of `turn`."""

    trials: Trials
    of: Registration
    plane: int
    turn: NDArray[np.float32]
    inputs: NDArray[np.float64]

    def runs(self) -> FineRuns:
        """As regressions see them."""
        moves = np.flatnonzero(np.ptp(self.inputs, axis=0) > 0).tolist()
        return FineRuns(
            over_range(self.inputs, self.inputs),
            self.trials.values(self.of, self.plane) @ self.turn,
            len(self.trials.parameters),
            list(self.trials.folds),
            [moves.index(k) for k in self.of.inputs.mixed if k in moves],
            self.trials.seed,
            lambda courses: self.trials.likely(self.of, courses),
            self.weight,
            lambda runs, courses: self.trials.distances(runs, self.undone(courses, runs) @ self.turn.T),
        )

    def weight(self, runs: NDArray[np.int64]) -> NDArray[np.float64]:
        """(run, state) the size of each run, where the state was computed."""
        parameters, time = self.trials.parameters[runs], self.trials.courses.time
        size = self.of.clock.size(parameters)[:, None]
        return np.asarray(size * self.of.clock.known(parameters, time, self.of.grid))

    def undone(self, courses: Courses3, runs: NDArray[np.int64]) -> Courses3:
        """Registered courses of fine runs at the runs' own times: (run, state, mode)."""
        out, parameters = [], self.trials.parameters[runs]
        for course, one, size in zip(courses, parameters, self.of.clock.size(parameters), strict=True):
            times = self.of.clock.times(one, self.trials.courses.time)
            out.append(between(course, self.of.grid, times) * np.float32(size))
        return np.stack(out)

    def left_out(
        self, found: Beneath, below: RunsBelow, count: int
    ) -> Iterator[tuple[int, Courses3, Courses3 | None, float]]:
        """See `CoarseFit.held`."""
        for part in found.parts:
            far = self.undone(found.far(part), part.held)[..., :count]
            itself = self.undone(found.itself(part), part.held)[..., :count]
            for k, run in enumerate(part.held):
                yield int(run), far[k], itself[k] if below.twin[run] >= 0 else None, float(part.deviation[k])


def _first(courses: Courses3, count: int) -> Courses3:
    """The first `count` modes."""
    return np.ascontiguousarray(courses[..., :count], np.float32)


def _registered(coarse: CoarseRuns, of: Registration, courses: list[Courses3], keep: NDArray[np.int64]) -> Courses3:
    """(kept run, state of the grid, mode)"""
    campaign = coarse.campaign
    return np.stack([of.on_grid(courses[k], campaign.parameters[k], campaign.time) for k in keep])


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
