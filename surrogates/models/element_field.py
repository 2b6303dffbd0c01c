"""A result on elements, such as plastic strain, beside the displacements: POD of the field and a process of its own.

It stands behind the registration of the displacements: the same inputs, clock and mirrored runs. A field on the
reference's clock is as large as in the run, or divided by the run's size as displacements are: strains of runs that are
drawn at another size are alike, strains of runs of another strength may not be. Folds decide, and between the process of
the displacements and one of the field's own.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from data_schema.levels import Level
from data_schema.pod import pod
from surrogates.data.campaign import Campaign, ElementTarget
from surrogates.models.removal import centres, mirrored_faces
from surrogates.physics.clock import between
from surrogates.physics.registration import Registration
from surrogates.physics.trials import Trials
from surrogates.physics.weigher import Weigher

_log = logging.getLogger(__name__)

# Modes at most, and states of a run that they are made of.
_MODES, _BASIS_STATES = 96, 24
# States and elements on which errors are judged.
_JUDGED, _JUDGED_FACES = 21, 2000
# Another choice is taken where it lowers the error by this share.
_MARGIN = 0.005
# Fewer runs than this choose nothing.
_FEWEST = 6


@dataclass
class ElementField:
    """The fitted field.

    Attributes
    ----------
    modes
        (face, mode) float32.
    courses
        (run and image, state of the grid, mode) float32: coefficients of the registered runs.
    power
        The field goes with this power of a run's size: 0 or 1.
    low, high
        Smallest and largest value in the training runs: predictions stay within.
    errors
        Mean absolute error over living elements of runs that folds left out, by what was tried; "chosen" is the
        best, "mean of the runs" and "nearest run" are the baselines.
    """

    name: str
    unit: str
    weigher: Weigher
    modes: NDArray[np.float32]
    courses: NDArray[np.float32]
    power: int
    low: float
    high: float
    errors: dict[str, float] = field(default_factory=dict)

    def predict(
        self, registration: Registration, parameters: NDArray[np.float64], time: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """(run, state, face) of runs with parameters (run, parameter) at their own times (state,), s."""
        weights = self.weigher.weights(registration.read(parameters)).astype(np.float32)
        return np.stack(
            [
                np.clip(_own(w, self.courses, registration, p, time, self.power) @ self.modes.T, self.low, self.high)
                for w, p in zip(weights, parameters, strict=True)
            ]
        )

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What has to be kept beside name, unit and errors."""
        return {
            **{f"weigher.{name}": values for name, values in self.weigher.arrays().items()},
            "modes": self.modes, "courses": self.courses, "range": np.array([self.low, self.high]),
            "power": np.array([self.power]),
        }  # fmt: skip

    @classmethod
    def load(
        cls, arrays: Mapping[str, NDArray[Any]], name: str, unit: str, errors: Mapping[str, float]
    ) -> ElementField:
        """From what `arrays` gave."""
        weigher = {n.removeprefix("weigher."): v for n, v in arrays.items() if n.startswith("weigher.")}
        low, high = (float(v) for v in arrays["range"])
        return cls(
            name, unit, Weigher.load(weigher), arrays["modes"], arrays["courses"], int(arrays["power"][0]), low, high,
            dict(errors),
        )  # fmt: skip


def _own(
    weights: NDArray[np.float32], courses: NDArray[np.float32], registration: Registration,
    parameters: NDArray[np.float64], time: NDArray[np.float64], power: int,
) -> NDArray[np.float32]:  # fmt: skip
    """(state, number): the weighted sum of registered courses, at the run's own times and size."""
    course = np.tensordot(weights, courses, axes=1)
    grid = registration.grid
    times = np.clip(registration.clock.times(parameters, time), grid[0], grid[-1])
    size = float(registration.clock.size(parameters[None])[0]) ** power
    return np.asarray(between(course, grid, times) * np.float32(size), np.float32)


def fit_element_field(
    target: ElementTarget, campaign: Campaign, trials: Trials, registration: Registration, plane: int,
    chosen: NDArray[np.int64],
) -> ElementField:  # fmt: skip
    """The field `target` of the training runs `chosen`, in the order of `trials`."""
    _log.info("%s of %d runs", target.name, len(chosen))
    runs = _Runs(target, campaign, registration, chosen)
    basis = pod(runs.pieces(), _MODES).modes
    own = np.stack([runs.read(run) @ basis for run in range(len(chosen))])
    images = None
    if runs.images is not None:
        turned = basis[runs.images]  # mirrored field times a mode is the field times the mirrored mode
        images = np.stack([runs.read(run) @ turned for run in range(len(chosen))])
    parameters = campaign.parameters[chosen]
    low, high = runs.range
    courses = {power: _registered(own, images, registration, parameters, campaign.time, power) for power in (0, 1)}
    if registration.clock.is_identity:
        del courses[1]
    inputs = trials.inputs(registration)
    errors: dict[str, float] = {}
    best = (0, False)
    if len(chosen) >= _FEWEST and len(trials.folds.judged):
        judge = _Judge(runs, basis, registration, parameters, campaign.time, (low, high))
        errors = {
            "mean of the runs": judge.mean(own, trials),
            "nearest run": judge.nearest(own, trials, registration, plane),
        }
        lowest = np.inf
        for power, values in courses.items():
            for itself in (False, True):
                error = judge.error(trials.weighers(registration, plane, values if itself else None), values, power)
                errors[f"{_OWN[itself]}{_SIZED[power]}"] = error
                if error < lowest * (1 - _MARGIN):
                    lowest, best = error, (power, itself)
        errors["chosen"] = lowest
    power, itself = best
    machine = trials.fitted(registration, inputs, courses[power] if itself else trials.values(registration, plane))
    return ElementField(
        target.name, target.unit, Weigher.of(machine, inputs), basis, courses[power].astype(np.float32), power, low, high,
        errors,
    )  # fmt: skip


_OWN = {False: "process of the displacements", True: "process of its own"}
_SIZED = {0: "", 1: ", sized as displacements"}


def _registered(
    own: NDArray[np.float32], images: NDArray[np.float32] | None, registration: Registration,
    parameters: NDArray[np.float64], time: NDArray[np.float64], power: int,
) -> NDArray[np.float32]:  # fmt: skip
    """(run and image, state of the grid, mode); beyond a run's end its last state stays."""
    out = []
    for kind in (own, images) if images is not None else (own,):
        for course, p in zip(kind, parameters, strict=True):
            rate, size = float(registration.clock.rate(p[None])[0]), float(registration.clock.size(p[None])[0])
            start = registration.clock.start
            at = np.minimum(start + (registration.grid - start) / rate, time[-1])
            out.append(between(course, time, at) / np.float32(size**power))
    return np.stack(out)


class _Runs:
    """The field of the chosen runs, without gaps: what an element had last stays where it is gone or not written."""

    def __init__(
        self, target: ElementTarget, campaign: Campaign, registration: Registration, chosen: NDArray[np.int64]
    ) -> None:
        self._target, self._alive, self._chosen = target, campaign.alive, chosen
        self.range = (np.inf, -np.inf)
        self.images: NDArray[np.int64] | None = None
        mirror = registration.symmetry.mirror
        if mirror is not None and campaign.points is not None and campaign.faces is not None:
            part = None if campaign.labels is None else campaign.labels.face_part
            self.images = mirrored_faces(mirror, campaign.points, campaign.faces, part)

    def read(self, run: int) -> NDArray[np.float32]:
        """(state, face)"""
        return self._held(run)[0]

    def truth(
        self, run: int, states: NDArray[np.int64], faces: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """(state, face) at `states` of `faces`, and where an element lives and has a value."""
        values, there = self._held(run)
        return values[states][:, faces], there[states][:, faces]

    def _held(self, run: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        values = np.asarray(self._target.values[int(self._chosen[run])], np.float32)
        there = np.isfinite(values)
        if self._alive is not None:
            there &= np.asarray(self._alive[int(self._chosen[run])], bool)
        last = np.where(there, np.arange(len(values))[:, None], 0)
        np.maximum.accumulate(last, axis=0, out=last)
        held = np.nan_to_num(values[last, np.arange(values.shape[1])[None]], nan=0.0, posinf=0.0, neginf=0.0)
        self.range = (min(self.range[0], float(held.min())), max(self.range[1], float(held.max())))
        return held, there

    def pieces(self) -> Iterator[NDArray[np.float32]]:
        """(state, face) of some states of each run and its image."""
        for run in range(len(self._chosen)):
            values = self.read(run)
            values = values[np.unique(np.linspace(0, len(values) - 1, _BASIS_STATES).astype(int))]
            yield values if self.images is None else np.concatenate([values, values[:, self.images]])


class _Judge:
    """Mean absolute errors over living elements of runs that were left out."""

    def __init__(
        self, runs: _Runs, basis: NDArray[np.float32], registration: Registration, parameters: NDArray[np.float64],
        time: NDArray[np.float64], limits: tuple[float, float],
    ) -> None:  # fmt: skip
        self.registration, self.parameters, self.time, self.limits = registration, parameters, time, limits
        self.states = np.unique(np.linspace(0, len(time) - 1, _JUDGED).astype(int))
        faces = np.sort(np.random.default_rng(0).permutation(len(basis))[:_JUDGED_FACES])
        self.basis = basis[faces]
        self.truth = [runs.truth(run, self.states, faces) for run in range(len(parameters))]

    def error(
        self, weighers: Iterator[tuple[NDArray[np.int64], NDArray[np.int64], Weigher, NDArray[np.float64]]],
        courses: NDArray[np.float32], power: int,
    ) -> float:  # fmt: skip
        found = []
        for held, part, weigher, inputs in weighers:
            weights = weigher.weights(inputs).astype(np.float32)
            for w, run in zip(weights, held, strict=True):
                said = _own(w, courses[part], self.registration, self.parameters[run], self.time[self.states], power)
                found.append(self._off(int(run), said))
        return float(np.mean(found))

    def mean(self, own: NDArray[np.float32], trials: Trials) -> float:
        """Of the mean of the training runs at the same time."""
        found = []
        for train, held in trials.folds:
            mean = own[train][:, self.states].mean(axis=0)
            found += [self._off(int(run), mean) for run in held]
        return float(np.mean(found))

    def nearest(self, own: NDArray[np.float32], trials: Trials, registration: Registration, plane: int) -> float:
        """Of the nearest training run, as the process of the displacements measures."""
        found = []
        for held, part, weigher, inputs in trials.weighers(registration, plane):
            computed = part[part < len(own)]
            near = weigher.nearest(inputs, len(computed))
            found += [self._off(int(run), own[computed[n]][self.states]) for run, n in zip(held, near, strict=True)]
        return float(np.mean(found))

    def _off(self, run: int, coefficients: NDArray[np.float32]) -> float:
        said = np.clip(coefficients @ self.basis.T, *self.limits)
        truth, there = self.truth[run]
        return float(np.abs(said - truth)[there].mean()) if there.any() else 0.0


def faces_to_level(
    points: NDArray[np.float64], faces: NDArray[np.integer], level: Level, part: NDArray[np.integer] | None = None
) -> sparse.csr_matrix:
    """(face of the level, face of the full mesh): means over the elements that lie nearest to each face of a coarse level.

    A face that is nearest to none has the value of the element nearest to it. Parts keep to themselves where the level
    knows its own.

    Parameters
    ----------
    points, faces
        The full mesh (node, 3), m, and (face, corner); `part` (face,) of its elements.
    """
    from scipy.spatial import cKDTree

    fine, coarse = centres(points, faces), centres(points[level.kept], level.faces)
    nearest, back = np.empty(len(fine), np.int64), np.empty(len(coarse), np.int64)
    of_fine, of_coarse = np.zeros(len(fine), np.int64), np.zeros(len(coarse), np.int64)
    if part is not None and level.face_part is not None:
        of_fine, of_coarse = np.asarray(part, np.int64), np.asarray(level.face_part, np.int64)
    for number in np.union1d(of_fine, of_coarse):
        mine, theirs = np.flatnonzero(of_fine == number), np.flatnonzero(of_coarse == number)
        to_coarse = theirs if len(theirs) else np.arange(len(coarse))  # a part may have no face left
        to_fine = mine if len(mine) else np.arange(len(fine))
        nearest[mine] = to_coarse[cKDTree(coarse[to_coarse]).query(fine[mine])[1]] if len(mine) else 0
        back[theirs] = to_fine[cKDTree(fine[to_fine]).query(coarse[theirs])[1]] if len(theirs) else 0
    alone = np.setdiff1d(np.arange(len(coarse)), nearest)
    rows, columns = np.concatenate([nearest, alone]), np.concatenate([np.arange(len(fine)), back[alone]])
    counts = np.bincount(rows, minlength=len(coarse))
    return sparse.csr_matrix((1.0 / counts[rows], (rows, columns)), (len(coarse), len(fine)))
