"""POD with Gaussian processes or radial basis functions: what an engineer would use instead of a network.

Two views of the same coefficients compete on validation runs: `trajectory`, where a run is one sample and its whole
course of coefficients the answer, and `point`, where every state is a sample and the time one more input. The number of
modes is chosen there as well; then everything is fitted again to all training runs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogates.data.campaign import Campaign
from surrogates.data.samples import Notes, Runs, Split, scale_of
from surrogates.errors import SurrogateError
from surrogates.reductions.pod import Pod, pod
from surrogates.regression.gaussian import Gaussian, RadialBasis
from surrogates.settings import Settings

if TYPE_CHECKING:
    pass

Inputs = Literal["trajectory", "point"]
# Share of the time steps' length below which two times are the same.
_SAME_TIME = 1e-6


@dataclass
class Coefficients:
    """What a regression is fitted to.

    parameters  (run, p) scaled to [-1, 1], without columns that are constant; time (state,), s
    values      (run, state, mode), m
    """

    parameters: NDArray[np.float64]
    time: NDArray[np.float64]
    values: NDArray[np.float64]


class PodRegression:
    """POD modes and a regression of their coefficients; predicts on the full mesh (level 0).

    modes      (3 * node, mode) float32
    low, high  (p,) ranges that scale the parameters; a constant one is left out
    """

    def __init__(
        self,
        modes: NDArray[np.float32],
        data: Coefficients,
        machine: Gaussian | RadialBasis,
        inputs: Inputs,
        low: NDArray[np.float64],
        high: NDArray[np.float64],
        samples: NDArray[np.int64] | None = None,
    ) -> None:
        self.modes, self.data, self.machine, self.inputs = modes, data, machine, inputs
        self.low, self.high, self.samples = low, high, samples

    @property
    def numbers(self) -> tuple[int, ...]:
        return (0,)

    def latent(self, number: int) -> int:
        return self.modes.shape[1]

    def coefficients(self, parameters: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float64]:
        """(run, p) and (state,), s -> (run, state, mode), m. Between trained times the course is interpolated."""
        x = scaled(parameters, self.low, self.high)
        r = self.modes.shape[1]
        if self.inputs == "trajectory":
            known = self.data.values.reshape(len(self.data.values), -1)
            mean = known.mean(axis=0)
            weights = self.machine.weights(x)
            if isinstance(self.machine, Gaussian):
                course = mean + weights @ (known - mean)
            else:
                course = weights @ known
            return _at(course.reshape(len(x), -1, r), self.data.time, time)
        points = np.concatenate(
            [np.repeat(x, len(time), axis=0), np.tile(_scaled_time(time, self.data.time), len(x))[:, None]], axis=1
        )
        known = self.data.values.reshape(-1, r)[self.samples]
        mean = known.mean(axis=0) if isinstance(self.machine, Gaussian) else 0.0
        out = np.concatenate([mean + self.machine.weights(p) @ (known - mean) for p in _pieces(points)])
        return out.reshape(len(x), len(time), r)

    def displacement(
        self, parameters: NDArray[np.float64], time: NDArray[np.float64], number: int = 0
    ) -> NDArray[np.float32]:
        """(run, p) and (state,) -> (run, state, node, 3), m"""
        z = self.coefficients(parameters, time).astype(np.float32)
        return (z.reshape(-1, z.shape[-1]) @ self.modes.T).reshape(*z.shape[:2], -1, 3)

    def truncated(self, count: int) -> PodRegression:
        """The same with the first `count` modes only."""
        values = np.ascontiguousarray(self.data.values[..., :count])
        data = Coefficients(self.data.parameters, self.data.time, values)
        modes = np.ascontiguousarray(self.modes[:, :count])
        return PodRegression(modes, data, self.machine, self.inputs, self.low, self.high, self.samples)

    def reconstruct(self, states: NDArray[np.float32], number: int = 0) -> NDArray[np.float32]:
        """(state, node, 3) projected on the modes."""
        flat = np.asarray(states, np.float32).reshape(len(states), -1)
        return np.asarray((flat @ self.modes) @ self.modes.T, np.float32).reshape(states.shape)

    def n_parameters(self, number: int = 0) -> int:
        """Modes, the coefficients they are predicted from, and the kernel's numbers."""
        kernel = sum(v.size for v in self.machine.numbers().values())
        return self.modes.size + self.data.values.size + kernel

    def tensors(self) -> dict[str, dict[str, Tensor]]:
        arrays: dict[str, NDArray] = {
            "modes": self.modes, "parameters": self.data.parameters, "time": self.data.time,
            "values": self.data.values, "low": self.low, "high": self.high, **self.machine.numbers(),
        }  # fmt: skip
        if self.samples is not None:
            arrays["samples"] = self.samples
        return {"pod": {k: torch.from_numpy(np.ascontiguousarray(v)) for k, v in arrays.items()}}

    @classmethod
    def load(cls, tensors: Mapping[str, Tensor], model: str, inputs: Inputs) -> PodRegression:
        """From what `tensors` gave."""
        a = {k: v.numpy() for k, v in tensors.items()}
        data = Coefficients(a["parameters"], a["time"], a["values"])
        samples = a.get("samples")
        x = data.parameters if inputs == "trajectory" else _points(data)[samples]
        machine = Gaussian(x, a["theta"]) if model == "pod-gpr" else RadialBasis(x)
        return cls(a["modes"], data, machine, inputs, a["low"], a["high"], samples)


@dataclass
class Choice:
    """What validation said: e2 (m) of each candidate, and the chosen one."""

    inputs: Inputs
    modes: int
    errors: dict[str, float] = field(default_factory=dict)


def fit_pod_regression(
    campaign: Campaign, settings: Settings, split: Split, notes: Notes
) -> tuple[PodRegression, PodRegression | None, Choice]:
    """Choose inputs and modes on the validation runs, then fit to all training runs.

    Returns the model, the one that was judged on the validation runs (None without any), and the choice.
    """
    runs = Runs(campaign, 0, settings, notes)
    everything = np.sort(np.concatenate([split.training, split.validation]))
    views: tuple[Inputs, ...] = ("trajectory", "point") if settings.pod.inputs == "auto" else (settings.pod.inputs,)
    wanted = tuple(sorted(settings.pod.modes))
    if not len(split.validation):
        choice = Choice(views[0], wanted[-1])
        notes.add(f"without validation runs {choice.modes} modes and {choice.inputs} inputs are taken unseen")
        return _fitted(campaign, settings, runs, everything, choice.inputs, choice.modes), None, choice
    errors: dict[str, float] = {}
    best: tuple[float, PodRegression] | None = None
    basis = _basis(runs, split.training, wanted[-1])
    for view in views:
        model = _fitted(campaign, settings, runs, split.training, view, wanted[-1], basis)
        z = model.coefficients(campaign.parameters[split.validation], campaign.time).astype(np.float32)
        counts = sorted({min(m, z.shape[-1]) for m in wanted})
        for count, error in zip(counts, _errors(model, z, runs, split.validation, counts), strict=True):
            errors[f"{view}, {count} modes"] = error
            if best is None or error < best[0]:
                best = (error, model.truncated(count))
    if best is None:
        raise SurrogateError("pod.modes is empty; give at least one number of modes")
    choice = Choice(best[1].inputs, best[1].latent(0), errors)
    return _fitted(campaign, settings, runs, everything, choice.inputs, choice.modes), best[1], choice


def scaled(values: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """(run, p) -> [-1, 1] over [low, high], without the columns where these agree."""
    moves = high > low
    return 2 * (np.atleast_2d(values)[:, moves] - low[moves]) / (high - low)[moves] - 1


def _basis(runs: Runs, chosen: NDArray[np.int64], count: int) -> Pod:
    basis = pod((runs.read(run) for run in chosen), count)
    scale_of(float(basis.singular_values[0]))
    return basis


def _fitted(
    campaign: Campaign,
    settings: Settings,
    runs: Runs,
    chosen: NDArray[np.int64],
    inputs: Inputs,
    count: int,
    basis: Pod | None = None,
) -> PodRegression:
    basis = basis or _basis(runs, chosen, count)
    parameters = campaign.parameters[chosen]
    low, high = parameters.min(axis=0), parameters.max(axis=0)
    values = np.stack([basis.coefficients(runs.read(run)) for run in chosen]).astype(np.float64)
    data = Coefficients(scaled(parameters, low, high), campaign.time.astype(np.float64), values)
    samples = None
    x, y = data.parameters, values.reshape(len(chosen), -1)
    if inputs == "point":
        points = _points(data)
        samples = np.sort(np.random.default_rng(settings.seed).permutation(len(points))[: settings.pod.points])
        x, y = points[samples], values.reshape(len(points), -1)[samples]
    machine = (Gaussian(x) if settings.model == "pod-gpr" else RadialBasis(x)).fit(y, settings.seed)
    return PodRegression(basis.modes, data, machine, inputs, low, high, samples)


def _errors(
    model: PodRegression, z: NDArray[np.float32], runs: Runs, chosen: NDArray[np.int64], counts: Iterable[int]
) -> list[float]:
    """e2 (m) over the runs `chosen` with the first 1, 2, .. `counts` modes; z (run, state, mode)."""
    total = np.zeros(len(list(counts)))
    for k, run in enumerate(chosen):
        truth = runs.read(run).reshape(runs.states, -1)
        for place, count in enumerate(counts):
            wrong = z[k, :, :count] @ model.modes[:, :count].T - truth
            total[place] += np.linalg.norm(wrong.reshape(runs.states, -1, 3), axis=2).mean()
    return (total / len(chosen)).tolist()


def _points(data: Coefficients) -> NDArray[np.float64]:
    """(run * state, p + 1): scaled parameters and time of every state."""
    states = len(data.time)
    time = np.tile(_scaled_time(data.time, data.time), len(data.parameters))[:, None]
    return np.concatenate([np.repeat(data.parameters, states, axis=0), time], axis=1)


def _scaled_time(time: NDArray[np.float64], trained: NDArray[np.float64]) -> NDArray[np.float64]:
    span = trained[-1] - trained[0]
    return 2 * (time - trained[0]) / (span if span > 0 else 1.0) - 1


def _at(course: NDArray[np.float64], trained: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float64]:
    """(run, trained state, mode) at other times, by monotone cubics; the ends are held outside the trained times."""
    if len(trained) == 1:
        return np.repeat(course, len(time), axis=1)
    places = np.clip(np.searchsorted(trained, time), 0, len(trained) - 1)
    if np.abs(trained[places] - time).max() <= _SAME_TIME * np.diff(trained).min():
        return course[:, places]
    from scipy.interpolate import PchipInterpolator

    return PchipInterpolator(trained, course, axis=1)(np.clip(time, trained[0], trained[-1]))


def _pieces(points: NDArray[np.float64], size: int = 2048) -> Iterable[NDArray[np.float64]]:
    return (points[k : k + size] for k in range(0, len(points), size))
