"""A Gaussian process from parameters to whole courses of latent vectors, to stand beside the network's regression.

Runs are the samples and one kernel serves all outputs, so a prediction is a weighted sum of the training runs' courses;
between trained states these are cubic. On few runs it errs differently from a network, and their mean is better than
either. In torch, hence differentiable by the parameters and exportable.
Source of the kernel's numbers: `surrogates.regression.gaussian.Gaussian` (Rasmussen and Williams 2006, equation 5.8).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from surrogates.regression.gaussian import Gaussian

Wish = Literal["network", "process", "mean", "auto"]
# Shares of the process to choose from; without validation runs the first one is taken.
_SHARES: Mapping[str, tuple[float, ...]] = {"process": (1.0,), "mean": (0.5,), "auto": (0.5, 0.0, 1.0)}


class LatentProcess(nn.Module):
    """Scaled inputs (b, parameter + 1, ..) -> z (b, latent); what stands behind the time is not read.

    Attributes
    ----------
    share
        Of the process in the level's regression; the rest is the network's.
    runs
        (run, parameter) scaled parameters of the training runs.
    time
        (state,) scaled, increasing.
    mean
        (state, latent) mean course, and `pull` (run, state, latent) what each run adds to it.
    numbers
        Variance, variance of the linear trend, noise; `mix` (parameter, parameter), see `gaussian.Kernel`.
    over
        What coarse runs add; None without. Then `mean` and `pull` are of what they leave to the fine ones.
    """

    runs: Tensor
    time: Tensor
    mean: Tensor
    pull: Tensor
    numbers: Tensor
    mix: Tensor
    share: Tensor

    def __init__(self, runs: int, parameters: int, states: int, latent: int) -> None:
        super().__init__()
        for name, shape in (
            ("runs", (runs, parameters)),
            ("time", (states,)),
            ("mean", (states, latent)),
            ("pull", (runs, states, latent)),
            ("numbers", (3,)),
            ("mix", (parameters, parameters)),
            ("share", ()),
        ):
            self.register_buffer(name, torch.zeros(shape))
        self.over: OverCoarse | None = None

    def forward(self, inputs: Tensor) -> Tensor:
        own = self.of_runs(inputs)
        return own if self.over is None else own + self.over(inputs)

    def of_runs(self, inputs: Tensor) -> Tensor:
        """What its own runs say."""
        place, parts = self._stencil(inputs[:, self.runs.shape[1]])
        parameters = inputs[:, : self.runs.shape[1]]
        one_run = _alike(parameters)
        weights = self.weights(parameters[:1] if one_run else parameters)
        courses = self.mean + (weights @ self.pull.flatten(1)).unflatten(1, self.mean.shape)
        if one_run:
            courses = courses.expand(len(inputs), -1, -1)
        out = torch.zeros_like(self.mean[:1])
        for k, part in enumerate(parts):
            at = (place + (k - 1)).clamp(0, len(self.time) - 1)
            out = out + part[:, None] * courses.gather(1, at[:, None, None].expand(-1, 1, out.shape[1])).squeeze(1)
        return out

    def weights(self, x: Tensor) -> Tensor:
        """(b, run) what courses are weighted with: Matern 3/2 with a linear trend."""
        apart = ((x[:, None] - self.runs) @ self.mix.T).square().sum(dim=2)
        distance = math.sqrt(3.0) * torch.sqrt(apart + 1e-12)
        matern = self.numbers[0] * (1.0 + distance) * torch.exp(-distance)
        return matern + self.numbers[1] * (x @ self.runs.T)

    def _stencil(self, time: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor, Tensor]]:
        """Interval (b,) of each time, and the weights (b,) of the states -1, 0, 1, 2 from its start.

        Cubic Hermite pieces with slopes from the neighbouring states, one-sided at the ends; held outside.
        """
        last = len(self.time) - 1
        if last == 0:
            zero, one = torch.zeros_like(time), torch.ones_like(time)
            return torch.zeros_like(time, dtype=torch.int64), (zero, one, zero, zero)
        time = time.clamp(self.time[0], self.time[-1])
        place = (time[:, None] >= self.time[1:-1]).sum(dim=1)
        before, start, end, after = (self.time[(place + k).clamp(0, last)] for k in (-1, 0, 1, 2))
        step = end - start
        s = (time - start) / step
        slope_start = step * s * (1 - s) ** 2
        slope_end = step * s**2 * (s - 1)
        left, right = slope_start / (end - before), slope_end / (after - start)
        rise = s**2 * (3 - 2 * s)
        return place, (-left, 1 - rise - right, rise + left, right)

    @classmethod
    def like(cls, tensors: Mapping[str, Tensor]) -> LatentProcess:
        """An empty one with room for stored `tensors`."""
        runs, states, latent = tensors["pull"].shape
        out = cls(runs, tensors["runs"].shape[1], states, latent)
        if "over.slopes" in tensors:
            of = {name: _under(tensors, f"over.{name}.") for name in ("below", "beside")}
            beside = cls.like(of["beside"]) if of["beside"] else None
            out.over = OverCoarse(cls.like(of["below"]), beside, torch.zeros_like(tensors["over.slopes"]))
        return out


class OverCoarse(nn.Module):
    """What coarse runs add to a process of fine ones.

    Attributes
    ----------
    below
        Over the coarse runs, their slopes in it.
    beside
        A second process over the fine runs, with other lengths; None without.
    slopes
        (latent, latent): z of a coarse run -> what is taken over of it.
    query
        How much a coarse run of the query counts; `below` counts by the rest.
    """

    slopes: Tensor
    query: Tensor

    def __init__(self, below: LatentProcess, beside: LatentProcess | None, slopes: Tensor, query: float = 0.0) -> None:
        super().__init__()
        self.below, self.beside = below, beside
        self.register_buffer("slopes", slopes)
        self.register_buffer("query", torch.tensor(float(query)))

    def forward(self, inputs: Tensor) -> Tensor:
        below: Tensor = self.below(inputs)
        return below if self.beside is None else below + self.beside(inputs)

    def from_query(self, inputs: Tensor, z: Tensor) -> Tensor:
        """What a coarse run of the query, encoded as z (b, latent), changes of the answer: (b, latent)."""
        out: Tensor = self.query * (z @ self.slopes.T - self.below(inputs))
        return out


def _under(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def _alike(rows: Tensor) -> bool:
    """Whether, in a prediction, all rows are equal, as for the states of one run; its course is then computed once."""
    if torch.is_grad_enabled() or torch.compiler.is_compiling():
        return False
    return bool((rows == rows[:1]).all())


def fit_process(
    runs: NDArray[np.float64],
    time: NDArray[np.float64],
    courses: NDArray[np.float64],
    sizes: NDArray[np.float64],
    seed: int,
    mixed: Sequence[int] = (),
) -> LatentProcess:
    """A process fitted to the courses (run, state, latent) of training runs with scaled parameters (run, parameter).

    Parameters
    ----------
    time
        (state,) scaled.
    sizes
        (latent,) how far the displacements move with each latent number: what counts in the kernel's likelihood.
    mixed
        Parameters whose lengths form a full matrix, see `gaussian.Gaussian`.
    """
    machine = Gaussian(runs, mixed=mixed).fit((courses * sizes).reshape(len(runs), -1), seed)
    return process_of(machine, time, courses)


def process_of(machine: Gaussian, time: NDArray[np.float64], courses: NDArray[np.floating]) -> LatentProcess:
    """A fitted process of the courses (run, state, latent) at the scaled times (state,), in torch."""
    runs = machine.x
    mean, pull = machine.expanded(courses.reshape(len(runs), -1).astype(np.float64))
    kernel = machine.kernel
    out = LatentProcess(len(runs), runs.shape[1], len(time), courses.shape[2])
    named = {
        "runs": runs, "time": time, "mean": mean.reshape(courses.shape[1:]), "pull": pull.reshape(courses.shape),
        "numbers": kernel.numbers, "mix": kernel.mix,
    }  # fmt: skip
    for name, values in named.items():
        getattr(out, name).copy_(torch.from_numpy(np.asarray(values, np.float64)))
    return out


class HasProcess(Protocol):
    """A level."""

    process: LatentProcess | None


class Judge(Protocol):
    """The samples a level was trained on, and its losses on validation runs."""

    def latents(self) -> tuple[Tensor, Tensor]:
        """Inputs (sample, ..) and encoded states (sample, latent) of the training runs, run by run."""
        ...

    def latent_sizes(self) -> Tensor:
        """(latent,) RMS movement of the nodes for a latent number that moves by one."""
        ...

    def validation(self) -> Tensor | None:
        """Losses (2,): approximation and reconstruction."""
        ...


@torch.no_grad()
def mix_in(level: HasProcess, judge: Judge, wish: Wish, parameters: int, states: int, seed: int) -> None:
    """Give a trained level the process that `wish` asks for; "auto" takes the share that is best on validation runs.

    Nothing happens with fewer than 3 training runs, or runs that agree in all parameters.
    """
    if wish == "network":
        return
    found = judge.latents()
    device = found[0].device
    inputs, z = (tensor.double().cpu().numpy() for tensor in found)
    runs, time = inputs[::states, :parameters], inputs[:states, parameters]
    if len(runs) < 3 or not np.ptp(runs, axis=0).any():
        return
    sizes = judge.latent_sizes().double().cpu().numpy()
    process = fit_process(runs, time, z.reshape(len(runs), states, -1), sizes, seed)
    level.process = process.to(device)
    losses = {}
    for share in _SHARES[wish]:
        process.share.fill_(share)
        measured = judge.validation()
        losses[share] = 0.0 if measured is None else float(measured[0])
    best = min(losses, key=lambda share: losses[share])
    process.share.fill_(best)
    if best == 0:
        level.process = None
