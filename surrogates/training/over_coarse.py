"""The process of a level put over encoded coarse runs, if folds show a gain: `surrogates.regression.beneath` on latent numbers.

Latent numbers move the nodes by more or less, and together. So courses are turned to directions that are orthogonal and in
metres of node movement before slopes are fitted, and back afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogates.regression.beneath import ALONE, OF_QUERY, Beneath, Courses3, FineRuns, Part, RunsBelow, put_beneath
from surrogates.regression.gaussian import Gaussian
from surrogates.regression.latent_process import LatentProcess, OverCoarse, process_of
from surrogates.training.latents import CoarseLatents, Latents

# Latent numbers that move the nodes by less than this share of what the strongest one does count as if they did so much.
_FAINT = 1e-4


@dataclass
class OverLevel:
    """What folds said of coarse runs on one level.

    Attributes
    ----------
    found
        The way, errors and slopes, by turned latent numbers.
    process
        Over coarse runs, of all runs; None where fine runs do better alone.
    said
        (fold + 1, run, state, latent) what such processes say without each part of the runs, and of all.
    itself
        (own run, state, latent) of left-out runs, from their own coarse run; where there is none, what is said without.
    """

    found: Beneath
    process: LatentProcess | None = None
    said: Tensor | None = None
    itself: Tensor | None = None

    def from_runs(self, left_out: Tensor, share: float, latents: Latents) -> Tensor:
        """(own run, state, latent) of left-out runs from their own coarse runs.

        Parameters
        ----------
        left_out
            What a mixture with this `share` of the process says of them without.
        """
        assert self.said is not None
        assert self.itself is not None
        own = torch.arange(latents.own, device=left_out.device)
        return left_out + share * (self.itself - self.said[latents.part[: latents.own], own])

    def tell(self, errors: Mapping[str, float], error: Callable[[Tensor], float]) -> None:
        """Say the errors as the level's other choices say theirs: over all states, and not run by run.

        Parameters
        ----------
        errors
            What was tried for the level, by name.
        error
            Of latent vectors (own run, state, latent), m.
        """
        known = self.found.errors
        for way, name in ((ALONE, "process"), (self.found.way, "process over coarse runs")):
            known[way] = errors.get(name, known[way])
        if OF_QUERY in known and self.itself is not None:
            known[OF_QUERY] = error(self.itself)

    def reject(self) -> None:
        """The fine runs alone are kept after all."""
        self.found.way = ALONE
        self.process = self.said = self.itself = None


def put_over(latents: Latents, coarse: CoarseLatents, scale: float, seed: int, mixed: Sequence[int]) -> OverLevel:
    """A process of the level's runs and the `coarse` ones, chosen by the folds of `latents`; `scale`, m, is the level's unit."""
    turn = _Turn.of(latents)
    x = latents.inputs[:, 0, : latents.time_column].double().cpu().numpy()
    part = latents.part.cpu().numpy()
    own = part[: latents.own]
    folds = [(np.flatnonzero(own != k), np.flatnonzero(own == k)) for k in range(latents.folds)]
    known = latents.known.cpu().numpy()
    fine = turn.there(latents.values.cpu().numpy())

    def errors(runs: NDArray[np.int64], said: Courses3) -> NDArray[np.float64]:
        wrong = np.square(said - fine[runs], dtype=np.float64).sum(axis=2)
        distance = scale * np.sqrt(3.0 * (wrong + latents.lost)) * known[runs]
        return np.asarray(distance.sum(axis=1) / np.maximum(known[runs].sum(axis=1), 1))

    runs = FineRuns(
        x, fine, latents.own, folds, mixed, seed, lambda courses: courses.reshape(len(courses), -1).astype(np.float64),
        lambda places: known[places].astype(np.float64), errors,
    )  # fmt: skip
    found = put_beneath(runs, RunsBelow(coarse.inputs, turn.there(coarse.values), coarse.own, coarse.twin))
    if found.own is None or found.below is None:
        return OverLevel(found)
    time, device = latents.time.double().cpu().numpy(), latents.values.device

    def process(some: tuple[Gaussian, Courses3]) -> LatentProcess:
        return process_of(some[0], time, turn.back(some[1]))

    out = process(found.own)
    slopes = torch.from_numpy(turn.matrix(found.slopes)).float()
    beside = None if found.beside is None else process(found.beside)
    out.over = OverCoarse(process(found.below), beside, slopes, found.share)
    out.to(device)
    said = torch.empty(latents.folds + 1, *latents.values.shape, device=device)
    itself = torch.empty_like(latents.values[: latents.own])
    for place, one in enumerate(found.parts):
        said[place] = turn.tensor(_everywhere(found, one, x)).to(device)
        from_run = turn.tensor(found.itself(one)).to(device)
        for k, run in enumerate(one.held):
            itself[run] = from_run[k] if coarse.twin[run] >= 0 else said[place, run]
    with torch.no_grad():
        for run in range(len(x)):
            said[-1, run] = out(latents.inputs[run])
    found.parts = []  # they hold every fold's processes
    return OverLevel(found, out, said, itself)


def _everywhere(found: Beneath, part: Part, x: NDArray[np.float64]) -> Courses3:
    """What a fold says of all runs."""
    said = part.at(x)
    return said.over(found.way, part.slopes, said.far)


@dataclass(frozen=True)
class _Turn:
    """Between latent numbers and orthogonal directions of node movement, the strongest first."""

    sizes: NDArray[np.float64]
    axes: NDArray[np.float64]

    @classmethod
    def of(cls, latents: Latents) -> _Turn:
        sizes = latents.sizes.double().cpu().numpy()
        sizes = np.maximum(sizes, _FAINT * float(sizes.max(initial=0.0)) or 1.0)
        flat = latents.values.double().cpu().numpy().reshape(-1, len(sizes)) * sizes
        return cls(sizes, np.linalg.eigh(flat.T @ flat)[1][:, ::-1])

    def there(self, z: NDArray[np.float32]) -> Courses3:
        return np.asarray((z * self.sizes) @ self.axes, np.float32)

    def back(self, y: Courses3) -> NDArray[np.float64]:
        return np.asarray((y.astype(np.float64) @ self.axes.T) / self.sizes)

    def tensor(self, y: Courses3) -> Tensor:
        return torch.from_numpy(self.back(y)).float()

    def matrix(self, slopes: NDArray[np.float64]) -> NDArray[np.float64]:
        """(latent, latent): z of a coarse run -> what is taken over of it."""
        return np.asarray((self.axes * slopes) @ self.axes.T * self.sizes / self.sizes[:, None])
