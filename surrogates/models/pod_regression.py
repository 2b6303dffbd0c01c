"""POD with Gaussian processes or radial basis functions: what an engineer would use instead of a network.

Two views of the same coefficients compete: `trajectory`, where a run is one sample and its whole course of coefficients
the answer, and `point`, where every state is a sample and the time one more input. View, number of modes and what is
known of the crash beforehand (`surrogates.physics`) are chosen by cross-validation over the training runs; then
everything is fitted again to all of them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from data_schema.memory import give_back
from surrogates.data.campaign import Campaign, CoarseRuns
from surrogates.data.inputs import over_range
from surrogates.data.samples import Notes, scale_of
from surrogates.errors import SurrogateError
from surrogates.models.coarse_base import CoarseBase
from surrogates.models.coarse_fit import CoarseFit, fit_coarse
from surrogates.physics.choice import Worth, choose, not_used
from surrogates.physics.registration import Registration
from surrogates.physics.trials import Courses, Folds, Trials, courses_of, one_thread
from surrogates.physics.weigher import Machine
from surrogates.regression.gaussian import Gaussian, RadialBasis
from surrogates.settings import Settings

_log = logging.getLogger(__name__)

Inputs = Literal["trajectory", "point"]
# Share of the time steps' length below which two times are the same.
_SAME_TIME = 1e-6
# Fewer modes than this are those of the POD alone; else the first three move the structure as a whole, exactly.
_WITH_TRANSLATIONS = 8
_TRANSLATIONS = 3
# Another view or number of modes is chosen if it lowers the error by this share.
_MARGIN = 0.001
# Nodes whose distances are worked out at once.
_NODES = 1 << 13


@dataclass
class Coefficients:
    """What a regression is fitted to.

    parameters  (run, p) scaled to [-1, 1], without columns that are constant; time (state,), s
    values      (run, state, mode), m
    """

    parameters: NDArray[np.float64]
    time: NDArray[np.float64]
    values: NDArray[np.float32]


class PodRegression:
    """POD modes and a regression of their coefficients; predicts on the full mesh (level 0).

    modes      (3 * node, mode) float32
    low, high  (p,) ranges that scale the parameters; a constant one is left out
    base       what coarse runs add to it; then `data` holds what they leave to the fine ones
    """

    def __init__(
        self,
        modes: NDArray[np.float32],
        data: Coefficients,
        machine: Machine,
        inputs: Inputs,
        low: NDArray[np.float64],
        high: NDArray[np.float64],
        samples: NDArray[np.int64] | None = None,
        base: CoarseBase | None = None,
    ) -> None:
        self.modes, self.data, self.machine, self.inputs = modes, data, machine, inputs
        self.low, self.high, self.samples, self.base = low, high, samples, base

    @property
    def numbers(self) -> tuple[int, ...]:
        return (0,)

    def latent(self, number: int) -> int:
        return int(self.modes.shape[1])

    def coefficients(
        self,
        parameters: NDArray[np.float64],
        time: NDArray[np.float64],
        coarse: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """(run, p) and (state,), s -> (run, state, mode), m. Between trained times the course is interpolated.

        coarse  (run, state of the grid, mode), m: what is taken over from coarse runs at these parameters, where there
                are some; else the coarse process alone says it
        """
        x = self.scaled(parameters)
        r = self.modes.shape[1]
        if self.inputs == "trajectory":
            course = _summed(self.machine.weights(x), self.data.values)
            if self.base is not None:
                if self.base.beside is not None:
                    course += _summed(self.base.beside[0].weights(x), self.base.beside[1])
                beneath = _summed(self.base.process.weights(x), self.base.values)
                course += beneath if coarse is None else beneath + self.base.share * (coarse - beneath)
            return _at(course, self.data.time, time)
        points = np.concatenate(
            [np.repeat(x, len(time), axis=0), np.tile(_scaled_time(time, self.data.time), len(x))[:, None]], axis=1
        )
        known = self.data.values.reshape(-1, r)[self.samples]
        out = np.concatenate([self.machine.weights(p) @ known for p in _pieces(points)])
        return out.reshape(len(x), len(time), r)

    def weights(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """(run, p) -> (run, training sample): how much each of the `courses` enters, where a run is one sample."""
        x = self.scaled(parameters)
        own = self.machine.weights(x)
        return own if self.base is None else np.concatenate([own, self.base.weights(x)], axis=1)

    @property
    def courses(self) -> NDArray[np.float32]:
        """(training sample, state, mode), m: fine runs, then coarse ones."""
        return self.data.values if self.base is None else np.concatenate([self.data.values, self.base.courses])

    def deviation(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """(run, p) -> (run,): what the process believes its error to be, up to a factor; ones where it believes nothing."""
        if self.inputs == "trajectory" and isinstance(self.machine, Gaussian):
            return self.machine.deviation(self.scaled(parameters))
        return np.ones(len(parameters))

    def displacement(
        self,
        parameters: NDArray[np.float64],
        time: NDArray[np.float64],
        number: int = 0,
        nodes: NDArray[np.int64] | None = None,
        coarse: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float32]:
        """(run, p) and (state,) -> (run, state, node, 3), m; with `nodes` on these alone, `coarse` as for `coefficients`."""
        return self.decoded(self.coefficients(parameters, time, coarse), nodes)

    def decoded(self, z: NDArray[np.float64], nodes: NDArray[np.int64] | None = None) -> NDArray[np.float32]:
        """Coefficients (run, state, mode), m -> displacements (run, state, node, 3), m."""
        modes = self.modes
        if nodes is not None:
            modes = modes.reshape(-1, 3, modes.shape[1])[nodes].reshape(-1, modes.shape[1])
        flat = z.reshape(-1, z.shape[-1]).astype(np.float32)
        return np.asarray(flat @ modes.T, np.float32).reshape(*z.shape[:2], -1, 3)

    def reconstruct(self, states: NDArray[np.float32], number: int = 0) -> NDArray[np.float32]:
        """(state, node, 3) projected on the modes."""
        return np.asarray(self.encode(states) @ self.modes.T, np.float32).reshape(states.shape)

    def encode(self, states: NDArray[np.float32]) -> NDArray[np.float32]:
        """(state, node, 3) -> (state, mode): coefficients of the modes."""
        return np.asarray(np.asarray(states, np.float32).reshape(len(states), -1) @ self.modes, np.float32)

    def n_parameters(self, number: int = 0) -> int:
        """Modes, the coefficients they are predicted from, and the kernel's numbers."""
        kernel = sum(v.size for v in self.machine.numbers().values())
        return self.modes.size + self.courses.size + kernel

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What has to be stored."""
        arrays: dict[str, NDArray[Any]] = {
            "modes": self.modes, "parameters": self.data.parameters, "time": self.data.time,
            "values": self.data.values, "low": self.low, "high": self.high, **self.machine.numbers(),
        }  # fmt: skip
        if self.samples is not None:
            arrays["samples"] = self.samples
        return {k: np.ascontiguousarray(v) for k, v in arrays.items()}

    @classmethod
    def load(
        cls, a: Mapping[str, NDArray[Any]], model: str, inputs: Inputs, base: CoarseBase | None = None
    ) -> PodRegression:
        """From what `arrays` gave; what coarse runs add is kept apart."""
        data = Coefficients(a["parameters"], a["time"], a["values"])
        samples = a.get("samples")
        x = data.parameters if inputs == "trajectory" else _points(data)[samples]
        machine = Gaussian.load(x, a) if model == "pod-gpr" else RadialBasis(x)
        return cls(a["modes"], data, machine, inputs, a["low"], a["high"], samples, base)

    def scaled(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        return over_range(parameters, np.stack([self.low, self.high]))


@dataclass
class PodChoice:
    """What cross-validation said: e2 (m) of each candidate, and the chosen one."""

    inputs: Inputs
    modes: int
    errors: dict[str, float] = field(default_factory=dict)


@dataclass
class PodFit:
    """A fitted POD regression of the registered campaign, and how it was chosen.

    trials  what everything was chosen with, and the place of the chosen plane among its mirrors
    held    calls back with each training run and what the model made without it says of it
    coarse  what folds said of coarse runs; None without any
    itself  as `held`, of those that have a coarse run of the same parameters, and starting from it
    """

    core: PodRegression
    registration: Registration
    choice: PodChoice
    worth: Worth
    held: Callable[[], Iterator[Held]]
    trials: Trials
    plane: int = 0
    coarse: CoarseFit | None = None
    itself: Callable[[], Iterator[Held]] | None = None


@dataclass(frozen=True)
class Held:
    """One training run as the others predict it: its place, coefficients, and the belief's deviation.

    course (state, mode), m, of modes (3 * node, mode)
    """

    run: int
    course: NDArray[np.float32]
    modes: NDArray[np.float32]
    deviation: float

    @property
    def predicted(self) -> NDArray[np.float32]:
        """(state, node, 3), m"""
        return np.asarray((self.course @ self.modes.T).reshape(len(self.course), -1, 3), np.float32)

    def off(self, truth: NDArray[np.float32]) -> NDArray[np.float32]:
        """(state, node), m: how far it is from the run's own displacements (state, node, 3); some nodes at a time."""
        out = np.empty(truth.shape[:2], np.float32)
        for first in range(0, truth.shape[1], _NODES):
            nodes, rows = slice(first, first + _NODES), slice(3 * first, 3 * (first + _NODES))
            some = (self.course @ self.modes[rows].T).reshape(len(truth), -1, 3)
            some -= truth[:, nodes]
            out[:, nodes] = np.sqrt(np.einsum("snx,snx->sn", some, some))
        return out


def fit_pod_regression(
    campaign: Campaign,
    settings: Settings,
    chosen: NDArray[np.int64],
    notes: Notes,
) -> PodFit:
    """Choose registration, view and modes by folds of the runs `chosen`, then fit to all of them."""
    if not settings.pod.modes:
        raise SurrogateError("pod.modes is empty; give at least one number of modes")
    _log.info("modes of %d runs", len(chosen))
    courses = courses_of(campaign, settings, chosen, notes)
    scale_of(float(np.square(courses.own, dtype=np.float64).sum()))
    folds = _folds(campaign, settings, chosen)
    trials = Trials(courses, campaign.parameters[chosen], folds, settings.model, settings.seed)
    with one_thread():
        best, core, choice, worth = _chosen(campaign, settings, chosen, trials, notes)
    core.modes = np.ascontiguousarray(courses.modes @ core.modes)
    give_back()
    fit = PodFit(
        core, best.registration, choice, worth, lambda: _held(best, trials, settings, choice.modes), trials, best.plane
    )
    return fit if campaign.coarse is None else with_coarse(fit, campaign.coarse, settings, notes)


def with_coarse(fit: PodFit, coarse: CoarseRuns, settings: Settings, notes: Notes) -> PodFit:
    """`fit` with coarse runs beneath, if folds show a gain; else `fit` with what folds said of them."""
    trials, registration = fit.trials, fit.registration
    most = trials.courses.own.shape[2]
    with one_thread():
        every = _rotation(trials.values(registration, fit.plane))(most)
        count = min(max(settings.pod.modes), most)
        found = fit_coarse(coarse, trials, registration, fit.plane, every, count, settings, notes)
    if found.base is None or found.machine is None or found.values is None:
        why = "did not lower the error in cross-validation" if found.errors else "cannot be judged by so few fine runs"
        notes.add(f"coarse runs {why}: the fine runs alone are kept")
        return replace(fit, coarse=found)
    old, modes = fit.core, np.ascontiguousarray(trials.courses.modes @ every[:, :count])
    data = Coefficients(old.data.parameters, old.data.time, found.values)
    core = PodRegression(modes, data, found.machine, "trajectory", old.low, old.high, base=found.base)
    return replace(
        fit,
        core=core,
        choice=replace(fit.choice, modes=count),
        coarse=found,
        held=lambda: _held_over(found, modes, itself=False),
        itself=lambda: _held_over(found, modes, itself=True),
    )


def from_coarse_run(
    core: PodRegression,
    registration: Registration,
    parameters: NDArray[np.float64],
    states: NDArray[np.float32],
    states_time: NDArray[np.float64],
    time: NDArray[np.float64],
) -> NDArray[np.float32]:
    """(state, node, 3), m, at `time` of one run with parameters (1, parameter), from its states (state, coarse node, 3), m."""
    assert core.base is not None
    course = registration.on_grid(core.base.project(states, core.modes), parameters[0], states_time)
    out: NDArray[np.float32] = registration.undo(
        lambda x, t: core.displacement(x, t, coarse=course[None]), parameters, time
    )[0]
    return out


def _held_over(found: CoarseFit, modes: NDArray[np.float32], *, itself: bool) -> Iterator[Held]:
    """Left-out runs with coarse runs beneath: from what these say elsewhere, or from the coarse run of each."""
    for run, far, near, deviation in found.held:
        course = near if itself else far
        if course is not None:
            yield Held(run, np.asarray(course, np.float32), modes, deviation)


def _chosen(
    campaign: Campaign, settings: Settings, chosen: NDArray[np.int64], trials: Trials, notes: Notes
) -> tuple[_Candidate, PodRegression, PodChoice, Worth]:
    """What the folds say, and the regression of all runs, its modes still (mode of the common basis, mode)."""
    registration, plane, worth = choose(campaign, chosen, settings, trials)
    for line in not_used(registration, settings):
        notes.add(line)
    courses = trials.courses
    candidates = [_Candidate("trajectory", registration, plane)]
    if settings.pod.inputs == "point":
        candidates = [_Candidate("point", Registration.identity(campaign.parameter_names, courses.time), 0)]
    elif settings.pod.inputs == "auto" and registration.is_identity and campaign.coarse is None:
        candidates.append(_Candidate("point", registration, 0))
    counts = tuple(sorted({min(m, courses.own.shape[2]) for m in settings.pod.modes}))
    if not len(trials.folds.judged):
        best, count, errors = candidates[0], counts[-1], {}
        notes.add(
            f"{len(chosen)} runs cannot be told apart by folds; {count} modes and {best.view} inputs are taken unseen"
        )
    else:
        _log.info("number of modes by cross-validation")
        errors = {c: _errors(c, trials, settings, counts) for c in candidates}
        best, count = _best(errors, counts)
    choice = PodChoice(best.view, count, _named(errors, counts))
    return best, _fitted(best, trials, settings, count), choice, worth


@dataclass(frozen=True, eq=False)
class _Candidate:
    view: Inputs
    registration: Registration
    plane: int


def _folds(campaign: Campaign, settings: Settings, chosen: NDArray[np.int64]) -> Folds:
    """The folds of the settings; runs named for validation are the only ones left out."""
    names = settings.validation.runs
    if names:
        named = np.array([campaign.runs[run] in names for run in chosen])
        return Folds(np.where(named, 0, -1)[None])
    return Folds.of(len(chosen), settings.validation.folds, settings.seed)


def _errors(candidate: _Candidate, trials: Trials, settings: Settings, counts: Sequence[int]) -> NDArray[np.float64]:
    """(count,) e2 (m) over the left-out runs with so many modes, each fold with modes of its own."""
    total, runs = np.zeros(len(counts)), 0
    for part, held, course, _ in _fold_courses(candidate, trials, settings):
        turn = _rotation(part)
        for place, count in enumerate(counts):
            some = turn(count)
            total[place] += trials.distances(held, np.asarray((course @ some) @ some.T, np.float32)).sum()
        runs += len(held)
    return total / max(1, runs)


def _fold_courses(
    candidate: _Candidate, trials: Trials, settings: Settings
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32], NDArray[np.float64]]]:
    """Of each fold: courses that trained, places of the runs left out, their predicted courses, deviations (run,)."""
    if candidate.view == "trajectory":
        values = trials.values(candidate.registration, candidate.plane)
        splits = [trials.with_images(candidate.registration, train) for train, _ in trials.folds]
        found = trials.believed(candidate.registration, candidate.plane)
        for part, (held, course, deviations) in zip(splits, found, strict=True):
            yield values[part], held, course, deviations
        return
    for train, held in trials.folds:
        core = _points_fitted(trials.courses, trials.parameters[train], train, settings)
        states = core.coefficients(trials.parameters[held], trials.courses.time)
        yield trials.courses.own[train], held, states.astype(np.float32), np.ones(len(held))


def _best(errors: Mapping[_Candidate, NDArray[np.float64]], counts: Sequence[int]) -> tuple[_Candidate, int]:
    """The candidate and the fewest modes that no other beats by more than the margin."""
    lowest = min(float(e.min()) for e in errors.values())
    for candidate, found in errors.items():
        good = np.flatnonzero(found <= lowest * (1 + _MARGIN))
        if len(good):
            return candidate, counts[int(good[0])]
    raise SurrogateError("the errors of cross-validation are not finite; check the displacements")


def _named(errors: Mapping[_Candidate, NDArray[np.float64]], counts: Sequence[int]) -> dict[str, float]:
    return {
        f"{candidate.view}, {count} modes": float(error)
        for candidate, found in errors.items()
        for count, error in zip(counts, found, strict=True)
    }


def _fitted(candidate: _Candidate, trials: Trials, settings: Settings, count: int) -> PodRegression:
    courses, registration = trials.courses, candidate.registration
    if candidate.view == "point":
        core = _points_fitted(courses, trials.parameters, np.arange(len(trials.parameters)), settings)
        turn = _rotation(courses.own)(count)
    else:
        inputs, values = trials.inputs(registration), trials.values(registration, candidate.plane)
        machine = trials.fitted(registration, inputs, values)
        turn = _rotation(values)(count)
        data = Coefficients(over_range(inputs, inputs), registration.grid, values)
        core = PodRegression(turn, data, machine, "trajectory", inputs.min(axis=0), inputs.max(axis=0))
    core.modes = turn
    core.data.values = np.ascontiguousarray(core.data.values @ turn)
    return core


def _points_fitted(
    courses: Courses, parameters: NDArray[np.float64], runs: NDArray[np.int64], settings: Settings
) -> PodRegression:
    """Every state a sample, on the common basis."""
    low, high = parameters.min(axis=0), parameters.max(axis=0)
    data = Coefficients(over_range(parameters, parameters), courses.time, courses.own[runs])
    points = _points(data)
    samples = np.sort(np.random.default_rng(settings.seed).permutation(len(points))[: settings.pod.points])
    x, y = points[samples], data.values.reshape(len(points), -1)[samples].astype(np.float64)
    machine: Machine = RadialBasis(x) if settings.model == "pod-rbf" else Gaussian(x).fit(y, settings.seed)
    return PodRegression(courses.modes, data, machine, "point", low, high, samples)


def _rotation(values: NDArray[np.float32]) -> Callable[[int], NDArray[np.float32]]:
    """From the common basis to the first modes of courses (run, state, mode): count -> (mode, count), orthonormal.

    From a few modes on, the structure's translations are the first ones, so that a motion as a whole is kept exactly.
    """
    flat = values.reshape(-1, values.shape[2])
    gram = (flat.T @ flat).astype(np.float64)
    alone = np.linalg.eigh(gram)[1][:, ::-1]
    beside = np.zeros_like(alone)
    beside[:_TRANSLATIONS, :_TRANSLATIONS] = np.eye(_TRANSLATIONS)
    rest = np.linalg.eigh(gram[_TRANSLATIONS:, _TRANSLATIONS:])[1][:, ::-1]
    beside[_TRANSLATIONS:, _TRANSLATIONS:] = rest

    def first(count: int) -> NDArray[np.float32]:
        return (beside if count >= _WITH_TRANSLATIONS else alone)[:, :count].astype(np.float32)

    return first


def _held(candidate: _Candidate, trials: Trials, settings: Settings, count: int) -> Iterator[Held]:
    """Every left-out run; one that several folds leave out comes several times in a row."""
    out = []
    with one_thread():
        for part, held, course, deviations in _fold_courses(candidate, trials, settings):
            turn = _rotation(part)(count)
            for run, states, deviation in zip(held, (course @ turn) @ turn.T, deviations, strict=True):
                out.append(Held(int(run), states, trials.courses.modes, float(deviation)))
    yield from sorted(out, key=lambda held: held.run)


def _points(data: Coefficients) -> NDArray[np.float64]:
    """(run * state, p + 1): scaled parameters and time of every state."""
    states = len(data.time)
    time = np.tile(_scaled_time(data.time, data.time), len(data.parameters))[:, None]
    return np.concatenate([np.repeat(data.parameters, states, axis=0), time], axis=1)


def _scaled_time(time: NDArray[np.float64], trained: NDArray[np.float64]) -> NDArray[np.float64]:
    span = trained[-1] - trained[0]
    return np.asarray(2 * (time - trained[0]) / (span if span > 0 else 1.0) - 1)


def _at(course: NDArray[np.float64], trained: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float64]:
    """(run, trained state, mode) at other times, by monotone cubics; the ends are held outside the trained times."""
    if len(trained) == 1:
        return np.repeat(course, len(time), axis=1)
    places = np.clip(np.searchsorted(trained, time), 0, len(trained) - 1)
    if np.abs(trained[places] - time).max() <= _SAME_TIME * np.diff(trained).min():
        return course[:, places]
    from scipy.interpolate import PchipInterpolator

    return np.asarray(PchipInterpolator(trained, course, axis=1)(np.clip(time, trained[0], trained[-1])))


def _summed(weights: NDArray[np.float64], values: NDArray[np.float32]) -> NDArray[np.float64]:
    """(run, sample) weights of courses (sample, state, mode) -> (run, state, mode)."""
    return np.asarray((weights @ values.reshape(len(values), -1)).reshape(len(weights), *values.shape[1:]))


def _pieces(points: NDArray[np.float64], size: int = 2048) -> Iterable[NDArray[np.float64]]:
    return (points[k : k + size] for k in range(0, len(points), size))
