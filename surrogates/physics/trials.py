"""What a registration is worth: a process over whole runs, judged by folds over the training runs, on POD coefficients.

Runs and images are projected once on a common basis, large enough to lose nothing that matters. There a registration
is a matter of small arrays, and one trial of all folds takes about a second. Errors are distances of nodes, measured on
some nodes and states of the left-out runs as computed; a run and its image always lie in the same fold.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from data_schema.mirror import MirrorPlane
from data_schema.pod import pod
from surrogates.data.campaign import Campaign
from surrogates.data.inputs import over_range
from surrogates.data.samples import LevelRuns, Notes
from surrogates.errors import SurrogateError
from surrogates.physics.clock import between
from surrogates.physics.registration import Registration
from surrogates.physics.symmetry import mirrored
from surrogates.physics.weigher import Machine, Weigher
from surrogates.regression.gaussian import Gaussian, Kernel, RadialBasis
from surrogates.settings import Settings

_log = logging.getLogger(__name__)

# Modes of the common basis, and numbers a field of that many modes may hold at most.
MODES = 128
_NUMBERS = 1.6e8
# Singular values below this share of the largest are rounding.
_SMALLEST = 1e-5
_TRANSLATIONS = 3
# Modes carried along beside those of the basis, and rows of it worked on at once.
_KEPT_BESIDE, _ROWS = 16, 1 << 13
# Nodes that the basis spans where it is only judged with; more say nothing new of a registration.
_SPANNED = 1 << 15
# States of a run that the basis is made of, nodes and states on which errors are measured, states of the likelihood.
_BASIS_STATES = 32
_JUDGED_NODES, _JUDGED_STATES = 400, 21
_LIKELIHOOD_STATES = 21
# Up to so many runs each is left out in turn.
_LEAVE_ONE = 12
# How often they are parted anew, by the largest number of runs.
_ROUNDS = ((32, 2), (1 << 62, 1))


def one_thread() -> AbstractContextManager[object]:
    """Inside, matrix products take one thread: those of trials are small, and sharing them costs more than they do."""
    from threadpoolctl import threadpool_limits

    limits: AbstractContextManager[object] = threadpool_limits(1, user_api="blas")
    return limits


@dataclass(frozen=True)
class Folds:
    """Training runs in parts that are left out in turn, several times over where runs are few.

    Attributes
    ----------
    part
        (round, run): the part in which each run is left out; -1: never.
    """

    part: NDArray[np.int64]

    @classmethod
    def of(cls, runs: int, count: int, seed: int) -> Folds:
        """`count` parts of about the same size, drawn by the seed; each run its own part where there are few, none for one or two."""
        if runs < 3:
            return cls(np.full((1, runs), -1))
        if runs <= max(_LEAVE_ONE, count):
            return cls(np.arange(runs)[None])
        draw = np.random.default_rng(seed)
        rounds = next(rounds for most, rounds in _ROUNDS if runs <= most)
        part = np.empty((rounds, runs), np.int64)
        for row in part:
            row[draw.permutation(runs)] = np.arange(runs) % count
        return cls(part)

    @property
    def judged(self) -> NDArray[np.int64]:
        """Places of the runs that are left out at some time."""
        return np.flatnonzero((self.part >= 0).any(axis=0))

    def __iter__(self) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Places of the runs that train, and of those left out."""
        for row in self.part:
            for k in range(int(row.max(initial=-1)) + 1):
                yield np.flatnonzero(row != k), np.flatnonzero(row == k)


@dataclass
class Courses:
    """Runs and images as coefficients of one basis.

    Attributes
    ----------
    modes
        (3 * node, mode) float32, orthonormal; the first three are translations. Of all nodes, or of some.
    own
        (run, state, mode); images (run, state, mode) of each plane.
    nodes
        Places of the judged nodes among those of `modes`, states judged states, truth (run, judged state, judged node, 3), m, and which
        of these nodes are there; None: all.
    """

    modes: NDArray[np.float32]
    time: NDArray[np.float64]
    own: NDArray[np.float32]
    images: dict[int, NDArray[np.float32]]
    nodes: NDArray[np.int64]
    states: NDArray[np.int64]
    truth: NDArray[np.float32]
    there: NDArray[np.bool_] | None = None

    @classmethod
    def of(
        cls,
        campaign: Campaign,
        runs: LevelRuns,
        chosen: NDArray[np.int64],
        mirrors: Sequence[MirrorPlane],
        modes: int,
        seed: int,
        spanned: int | None = None,
    ) -> Courses:
        """The runs `chosen`, read twice: once for the basis, once for the coefficients.

        Parameters
        ----------
        spanned
            Nodes that the basis has at most, drawn by the seed; None: all.
        """
        draw = np.random.default_rng(seed)
        drawn = draw.permutation(runs.nodes)
        some = None if spanned is None or runs.nodes <= spanned else np.sort(drawn[:spanned])
        fields = _Fields(runs, mirrors, some)
        count = int(max(8, min(modes, _NUMBERS / fields.length / 3)))
        basis = _basis(fields, chosen, count)
        own = np.empty((len(chosen), runs.states, basis.shape[1]), np.float32)
        images = {k: np.empty_like(own) for k in range(len(mirrors))}
        judged = np.sort(drawn[:_JUDGED_NODES])
        states = np.unique(np.linspace(0, runs.states - 1, _JUDGED_STATES).astype(int))
        truth = np.empty((len(chosen), len(states), len(judged), 3), np.float32)
        there = np.ones(truth.shape[:3], bool)
        for k, run in enumerate(chosen):
            _log.info("coefficients of run %d of %d", k + 1, len(chosen))
            values = runs.read(run)
            truth[k] = values[states[:, None], judged]
            known = runs.there(run)
            if known is not None:
                there[k] = known[states][:, judged]
            for plane, part in enumerate(fields.of(values)):
                (own if plane == 0 else images[plane - 1])[k] = part.reshape(len(part), -1) @ basis
            del values, part  # else they are there while the next run is read
        nodes = judged if some is None else np.searchsorted(some, judged)
        return cls(
            basis, campaign.time.astype(np.float64), own, images, nodes, states, truth, None if there.all() else there
        )

    def registered(
        self, registration: Registration, parameters: NDArray[np.float64], plane: int
    ) -> NDArray[np.float32]:
        """(run and image, state of the grid, mode): coefficients on the reference's clock."""
        own = [registration.clock.apply(c, p, self.time, registration.grid) for c, p in zip(self.own, parameters)]
        if registration.symmetry.is_identity:
            return np.stack(own)
        images = (
            registration.clock.apply(c, p, self.time, registration.grid)
            for c, p in zip(self.images[plane], parameters, strict=True)
        )
        return np.stack([*own, *images])


@dataclass
class Trials:
    """Judges registrations by folds; what was measured is kept.

    Attributes
    ----------
    parameters
        (run, parameter) of the training runs.
    machine
        "pod-gpr" or "pod-rbf": the regression.
    """

    courses: Courses
    parameters: NDArray[np.float64]
    folds: Folds
    machine: str
    seed: int
    _known: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    _registered: tuple[str, NDArray[np.float32]] | None = None

    def errors(self, registration: Registration, plane: int = 0) -> NDArray[np.float64]:
        """(run,) e2, m, of each run, predicted without it; NaN for those that are never left out."""
        key = f"{plane} {registration.inputs} {registration.clock} {registration.symmetry.odd} " + str(
            (registration.symmetry.is_identity, registration.symmetry.flagged, registration.reach)
        )
        if key not in self._known:
            out, rounds = np.zeros(len(self.parameters)), np.zeros(len(self.parameters))
            try:
                for held, coefficients in self.predicted(registration, plane):
                    out[held] += self.distances(held, coefficients)
                    rounds[held] += 1
            except SurrogateError:  # inputs that radial basis functions cannot tell apart
                out[self.folds.judged], rounds[self.folds.judged] = np.inf, 1
            out = np.where(rounds > 0, out / np.maximum(rounds, 1), np.nan)
            self._known[key] = out
        return self._known[key]

    def predicted(
        self, registration: Registration, plane: int = 0
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float32]]]:
        """Places of the left-out runs of each fold, and what the others say of them, (run, state, mode)."""
        return ((held, course) for held, course, _ in self.believed(registration, plane))

    def believed(
        self, registration: Registration, plane: int = 0
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float64]]]:
        """As `predicted`, and the deviation (run,) that the process believes to have, up to a factor."""
        values = self.values(registration, plane)
        for held, part, weigher, inputs in self.weighers(registration, plane):
            flat = values[part].reshape(len(part), -1)

            def course(
                x: NDArray[np.float64], time: NDArray[np.float64], weigher: Weigher = weigher,
                flat: NDArray[np.float32] = flat,
            ) -> NDArray[np.float32]:  # fmt: skip
                out = (weigher.weights(x).astype(np.float32) @ flat).reshape(len(x), *values.shape[1:])
                return _at(out, registration.grid, time)

            said = registration.undo(course, self.parameters[held], self.courses.time).astype(np.float32)
            yield held, said, weigher.deviation(inputs)

    def weighers(
        self, registration: Registration, plane: int = 0, values: NDArray[np.float32] | None = None
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], Weigher, NDArray[np.float64]]]:
        """Of each fold: places of the runs left out, of the runs and images that train, what these weigh, and the inputs
        (run, input) of those left out.

        Parameters
        ----------
        values
            Courses (run and image, state of the grid, number) to fit to; those of the displacements without.
        """
        inputs = self.inputs(registration)
        values = self.values(registration, plane) if values is None else values
        start = None
        for train, held in self.folds:
            part = self.with_images(registration, train)
            machine = self.fitted(registration, inputs[part], values[part], start)
            start = getattr(machine, "kernel", None)
            yield held, part, Weigher.of(machine, inputs[part]), inputs[held]

    def likelihood(self, registration: Registration, plane: int = 0) -> float:
        """Of all training runs, for each sample and output: compares inputs of one clock."""
        inputs, values = self.inputs(registration), self.values(registration, plane)
        machine = self.fitted(registration, inputs, values)
        return machine.likelihood if isinstance(machine, Gaussian) else 0.0

    def fitted(
        self,
        registration: Registration,
        inputs: NDArray[np.float64],
        values: NDArray[np.float32],
        start: Kernel | None = None,
    ) -> Machine:
        """The regression of courses (run, state, mode) by inputs (run, input)."""
        values = values[:, registration.grid <= registration.reach * (1 + 1e-9)]
        return course_machine(self.machine, inputs, values, registration.inputs.mixed, self.seed, start)

    def likely(self, registration: Registration, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """(run, number) of courses (run, state, mode): the states that a process's likelihood counts."""
        return likely_states(values[:, registration.grid <= registration.reach * (1 + 1e-9)])

    def inputs(self, registration: Registration) -> NDArray[np.float64]:
        """(run and image, input)"""
        return registration.read_with_images(self.parameters)

    def values(self, registration: Registration, plane: int) -> NDArray[np.float32]:
        """(run and image, state of the grid, mode); the last clock's are kept."""
        key = f"{plane} {registration.clock} {registration.symmetry.is_identity}"
        if self._registered is None or self._registered[0] != key:
            self._registered = (key, self.courses.registered(registration, self.parameters, plane))
        return self._registered[1]

    def with_images(self, registration: Registration, runs: NDArray[np.int64]) -> NDArray[np.int64]:
        """Places of the runs and their images."""
        return runs if registration.symmetry.is_identity else np.concatenate([runs, runs + len(self.parameters)])

    def distances(self, held: NDArray[np.int64], coefficients: NDArray[np.float32]) -> NDArray[np.float64]:
        c = self.courses
        rows = c.modes.reshape(-1, 3, c.modes.shape[1])[c.nodes].reshape(-1, c.modes.shape[1])
        said = (coefficients[:, c.states] @ rows.T).reshape(c.truth[held].shape)
        distance = np.linalg.norm(said - c.truth[held], axis=-1)
        if c.there is None:
            return np.asarray(distance.mean(axis=(1, 2)))
        # What is gone has no truth: only living nodes count, and every state the same, as in the report.
        living = c.there[held]
        return np.asarray(((distance * living).sum(axis=2) / np.maximum(living.sum(axis=2), 1)).mean(axis=1))


def course_machine(
    name: str,
    inputs: NDArray[np.float64],
    values: NDArray[np.floating],
    mixed: Sequence[int],
    seed: int,
    start: Kernel | None = None,
) -> Machine:
    """The regression `name` ("pod-gpr" or "pod-rbf") of whole courses (run, state, mode) by inputs (run, input).

    Parameters
    ----------
    mixed
        Inputs with a full matrix of lengths; none of them is constant.
    """
    x = over_range(inputs, inputs)
    if name == "pod-rbf":
        return RadialBasis(x)
    moves = np.flatnonzero(np.ptp(inputs, axis=0) > 0).tolist()
    return Gaussian(x, mixed=[moves.index(k) for k in mixed if k in moves]).fit(likely_states(values), seed, start)


def likely_states(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """(run, number) of courses (run, state, mode): some states, the last one among them."""
    every = max(1, values.shape[1] // _LIKELIHOOD_STATES)
    return values[:, ::-every].reshape(len(values), -1).astype(np.float64)


def courses_of(
    campaign: Campaign, settings: Settings, chosen: NDArray[np.int64], notes: Notes, *, only_judged: bool = False
) -> Courses:
    """The runs `chosen` of the full mesh with the images of all planes.

    Parameters
    ----------
    only_judged
        Nothing is predicted with the modes: on a large mesh they have some of its nodes.
    """
    runs = LevelRuns(campaign, 0, settings, notes)
    modes = max(MODES, max(settings.pod.modes, default=0))
    spanned = _SPANNED if only_judged else None
    return Courses.of(campaign, runs, chosen, campaign.mirrors, modes, settings.seed, spanned)


@dataclass(frozen=True)
class _Fields:
    """A run and its images at all planes, on `nodes` (None: all)."""

    runs: LevelRuns
    mirrors: Sequence[MirrorPlane]
    nodes: NDArray[np.int64] | None

    @property
    def length(self) -> int:
        return 3 * (self.runs.nodes if self.nodes is None else len(self.nodes))

    def of(self, values: NDArray[np.float32]) -> Iterator[NDArray[np.float32]]:
        """Of some states (state, node of the mesh, 3) of a run: those, then their images."""
        yield values if self.nodes is None else values[:, self.nodes]
        for mirror in self.mirrors:
            yield mirrored(mirror, values, self.nodes)


def _basis(fields: _Fields, chosen: NDArray[np.int64], count: int) -> NDArray[np.float32]:
    """(3 * node, mode): the structure as a whole moved along each axis, then the POD of runs and images, of what is
    left without their translation; orthonormal."""

    def states() -> Iterator[NDArray[np.float32]]:
        for k, run in enumerate(chosen):
            _log.info("modes of run %d of %d%s", k + 1, len(chosen), " and its images" if fields.mirrors else "")
            values = fields.runs.read(run)
            values = values[np.unique(np.linspace(0, len(values) - 1, _BASIS_STATES).astype(int))]
            for part in fields.of(values):
                part -= part.mean(axis=1, keepdims=True)  # in place: images lose their translation anyway
                yield part
            del values, part  # else they are there while the next run is read

    found = pod(states(), count, keep=count + _KEPT_BESIDE)
    good = found.singular_values > _SMALLEST * found.singular_values[0]
    moving = int(good.sum()) if good.any() else 0  # nothing moves: one mode of zeros is given
    out = np.zeros((fields.length, _TRANSLATIONS + moving), np.float32)
    out.reshape(-1, 3, out.shape[1])[:, :, :_TRANSLATIONS] = np.eye(3) / np.sqrt(fields.length / 3)
    if moving:
        out[:, _TRANSLATIONS:] = found.modes[:, :moving]  # those are the first ones
        del found
        _orthonormal(out)
    return out


def _orthonormal(modes: NDArray[np.float32]) -> None:
    """Gram-Schmidt of columns that are nearly orthonormal already, in place: what rounding left in faint modes.

    By the Cholesky factor of their products, twice (Yamamoto et al. 2015, doi 10.1553/etna_vol44s306).
    """
    from scipy.linalg import solve_triangular

    for _ in range(2):
        gram = np.zeros((modes.shape[1],) * 2)
        blocks = [slice(k, k + _ROWS) for k in range(0, len(modes), _ROWS)]
        for rows in blocks:
            some = modes[rows].astype(np.float64)
            gram += some.T @ some
        turn = solve_triangular(np.linalg.cholesky(gram), np.eye(len(gram)), lower=True).T
        for rows in blocks:
            modes[rows] = modes[rows].astype(np.float64) @ turn


def _at(course: NDArray[np.float32], trained: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float32]:
    """(run, state, mode) at other times, linear."""
    return np.asarray(between(course.transpose(1, 0, 2), trained, time).transpose(1, 0, 2))
