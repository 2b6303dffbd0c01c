"""The regression of one level, chosen by cross-validation on its encoded training runs.

Encoding is done once; after that a run is a course of a few latent numbers, and a network or a Gaussian process on them
costs little. So networks are trained for every part of the runs that is left out in turn, and for all runs, side by side
in one pass. What they and the processes say of left-out runs chooses the epoch and the mixture; the networks and the
process of all runs, which are kept, need no training of their own afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from surrogates.models.level import LevelNetwork
from surrogates.record import Fit
from surrogates.regression.beneath import WORTH_IT
from surrogates.regression.latent_process import LatentProcess, Wish, fit_process
from surrogates.regression.network import Course, Regressor, Team
from surrogates.training.latents import Latents
from surrogates.training.loop import Diverged, Objective
from surrogates.training.over_coarse import OverLevel, put_over

# Shares of the process to choose from.
SHARES: Mapping[Wish, tuple[float, ...]] = {
    "network": (0.0,), "process": (1.0,), "mean": (0.5,), "auto": (0.0, 0.25, 0.5, 0.75, 1.0),
}  # fmt: skip


# Networks that are so many times as wrong as the process after their trial bring a mixture of both a percent at most.
_HOPELESS = 1.25
# What is said behind the name of a mixture with a process over coarse runs.
_OVER = " over coarse runs"


def named(share: float) -> str:
    """What a share of the process is called."""
    return {0.0: "network", 1.0: "process"}.get(share, f"{100 * share:g} % process")


@dataclass
class Chosen:
    """What became of the choice.

    said      (fold + 1, run, state, latent) latent vectors by the regressions without each part of the runs, and of all
    errors    RMS distance of nodes, m, on left-out runs by what was tried, such as "network" or "process 0.75"
    coarse    what folds said of coarse runs; None without any
    itself    (own run, state, latent) of left-out runs, from the coarse run of each; where there is none, as `left_out`
    """

    said: Tensor
    share: float
    fit: Fit
    errors: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    reduction_epochs: int = 0
    coarse: OverLevel | None = None
    itself: Tensor | None = None

    @property
    def told(self) -> str:
        """The mixture in words."""
        over = _OVER if self.coarse is not None and self.coarse.process is not None else ""
        return named(self.share) + over

    def left_out(self, latents: Latents) -> Tensor:
        """(run, state, latent) of the own runs, each by the regression without it."""
        own = torch.arange(latents.own, device=self.said.device)
        return self.said[latents.part[: latents.own], own]


class FoldedNetworks(Objective):
    """Networks for each fold and for all runs, trained side by side; validation is on what each fold left out."""

    def __init__(self, regressor: Regressor, courses: Sequence[Course], latents: Latents, scale: float) -> None:
        """`courses`: of the runs without each fold, and of all."""
        super().__init__()
        self.latents, self.unit = latents, scale
        self.members, self.residual = regressor.members, regressor.residual
        self.regressor: Team = regressor.team(self.members * (latents.folds + 1)).to(latents.values.device)
        if self.residual:
            self.regressor.end_at_zero()
        told = [course(latents.time) for course in courses]
        self.mean, self.growth = (torch.stack(some) for some in zip(*told, strict=True))
        places = latents.known.nonzero()
        self.run, self.state = places[:, 0], places[:, 1]
        self.size = len(places)
        fold = torch.arange(latents.folds + 1, device=places.device).repeat_interleave(self.members)
        self.trains = (fold[:, None] != latents.part[None]).float()

    @property
    def scale(self) -> float:
        return self.unit

    def networks(self) -> dict[str, nn.Module]:
        return {"regressor": self.regressor}

    def forward(self, index: Tensor) -> Tensor:
        run, state = self.run[index], self.state[index]
        wrong = (self._said(run, state) - self.latents.values[run, state]).square() @ self.latents.sizes.square()
        trains = self.trains[:, run]
        lost = self.latents.lost
        return torch.stack([(wrong * trains).sum() / trains.sum() + lost, wrong.new_tensor(lost)])

    def validation(self) -> Tensor | None:
        latents = self.latents
        own = torch.arange(len(latents.part), device=latents.part.device) < latents.own
        total, count = latents.values.new_zeros(()), 0
        for fold in range(latents.folds):
            held = (own & (latents.part == fold)).nonzero()[:, 0]
            known = latents.known[held]
            wrong = (self.said(fold, held) - latents.values[held]).square() @ latents.sizes.square()
            total, count = total + wrong[known].sum(), count + int(known.sum())
        left = total / max(count, 1) + latents.lost
        return torch.stack([left, left.new_tensor(latents.lost)])

    @torch.no_grad()
    def said(self, fold: int, runs: Tensor) -> Tensor:
        """(run, state, latent) by the networks without `fold`, or by those of all runs for the fold behind the last."""
        states = self.latents.values.shape[1]
        some = slice(fold * self.members, (fold + 1) * self.members)
        run = runs.repeat_interleave(states)
        state = torch.arange(states, device=runs.device).repeat(len(runs))
        said: Tensor = self._said(run, state, some, slice(fold, fold + 1)).mean(dim=0).unflatten(0, (len(runs), states))
        return said

    def _said(self, run: Tensor, state: Tensor, some: slice = slice(None), folds: slice = slice(None)) -> Tensor:
        """(network, sample, latent) at samples of the runs and states given."""
        x = self.latents.inputs[run, state][None]
        below = self.latents.below
        if below is not None:
            coarse = below[folds][:, run, state].repeat_interleave(self.members, dim=0)
            x = torch.cat([x.expand(len(coarse), -1, -1), coarse], dim=2)
        mean, growth = (t[folds][:, state].repeat_interleave(self.members, dim=0) for t in (self.mean, self.growth))
        out = torch.addcmul(mean, growth, self.regressor(x, some))
        if below is None or not self.residual:
            return out
        return out + nn.functional.pad(coarse, (0, out.shape[2] - coarse.shape[2]))


def course_of(latents: Latents, fold: int, *, residual: bool, at_rest: bool) -> Course:
    """The mean course of the runs that `fold` does not leave out (those of all for the fold behind the last).

    With `residual` it is that of what they add to the coarse level's; growth is 1 unless `at_rest`.
    """
    trains = latents.part != fold
    values = latents.values[trains]
    if residual and latents.below is not None:
        coarse = latents.below[fold][trains]
        values = values - nn.functional.pad(coarse, (0, values.shape[2] - coarse.shape[2]))
    mean = values.mean(dim=0)
    spread = ((values - mean).square() @ latents.sizes.square()).mean(dim=0).sqrt()
    return Course.of(latents.time, mean, spread if at_rest else torch.ones_like(spread))


def choose_regression(
    level: LevelNetwork,
    latents: Latents,
    wish: Wish,
    train: Callable[[Objective], Fit],
    seed: int,
    mixed: Sequence[int] = (),
    trial: Callable[[Objective], Fit] | None = None,
) -> Chosen:
    """Train and choose the regression of `level`, and put it in place.

    train  runs the training loop on an objective
    trial  the same for a share of the epochs; networks that are far from the process after it are trained no further
    mixed  parameters whose lengths form a full matrix, see `regression.gaussian.Gaussian`
    """
    regressor = level.regressor
    courses = [
        course_of(latents, fold, residual=regressor.residual, at_rest=level.at_rest).to(latents.values.device)
        for fold in range(latents.folds + 1)
    ]
    shares = SHARES[wish] if latents.differ else (0.0,)
    notes: list[str] = []
    networks: Tensor | None = None
    fitted = Fit()
    processes, process = _processes(latents, shares, seed, mixed)
    over = None
    if processes is not None and latents.coarse is not None:
        over = put_over(latents, latents.coarse, level.scale, seed, mixed)
    best_process = processes if over is None or over.said is None else over.said
    if shares != (1.0,):
        objective = FoldedNetworks(regressor, courses, latents, level.scale)
        try:
            if trial is not None and best_process is not None and len(shares) > 1:
                fitted = trial(objective)
                behind = _behind(objective, best_process, latents)
                if fitted.status == "finished" and behind > _HOPELESS:
                    notes.append(
                        f"after a trial of {fitted.epochs} epochs the network is {behind:.1f} times as wrong as the process on "
                        "runs left out, and is trained no further"
                    )
                elif fitted.status == "finished":
                    objective = FoldedNetworks(regressor, courses, latents, level.scale)
                    fitted = train(objective)
            else:
                fitted = train(objective)
        except Diverged as error:
            if wish != "auto" or not latents.differ:
                error.fit = None  # the level has no regression yet
                raise
            fitted, shares = error.fit or Fit(status="diverged"), (1.0,)
            notes.append(f"{error}; the process alone is used")
        else:
            networks = _networks(objective, latents)
            regressor.take(objective.regressor, latents.folds * regressor.members)
    said, errors = _tried(networks, processes, shares, latents, level.scale)
    best = min(errors, key=lambda share: errors[share])
    told = {named(share): error for share, error in errors.items()}
    itself = None
    if over is not None and over.said is not None:
        more = _tried(networks, over.said, [share for share in shares if share > 0], latents, level.scale)
        told |= {f"{named(share)}{_OVER}": error for share, error in more[1].items()}
        of_them = min(more[1], key=lambda share: more[1][share])
        over.tell(told, lambda z: level.scale * _error(z, latents))
        # A network may rest on a level below that takes coarse runs already; then both do, and this one alone can start from
        # a coarse run of the query.
        margin = WORTH_IT if latents.coarse_below else -WORTH_IT
        if more[1][of_them] < (1 + margin) * errors[best]:
            said, best, process = more[0], of_them, over.process
            itself = over.from_runs(Chosen(said[best], best, fitted).left_out(latents), best, latents)
        else:
            over.reject()
            notes.append("a process over coarse runs brings nothing beside the network, and is left out")
    level.course = courses[-1] if best < 1 else None
    level.process = process if best > 0 else None
    if level.process is not None:
        level.process.share.fill_(best)
    return Chosen(said[best], best, fitted, told, notes, coarse=over, itself=itself)


def _tried(
    networks: Tensor | None, processes: Tensor | None, shares: Sequence[float], latents: Latents, scale: float
) -> tuple[dict[float, Tensor], dict[float, float]]:
    """What mixtures say (fold + 1, run, state, latent), and their errors, m, on left-out runs, by the share of the process."""
    said = {share: _mixed(networks, processes, share) for share in shares}
    return said, {
        share: scale * _error(Chosen(some, share, Fit()).left_out(latents), latents) for share, some in said.items()
    }


def _networks(objective: FoldedNetworks, latents: Latents) -> Tensor:
    """(fold + 1, run, state, latent): what the networks without each fold, and of all runs, say."""
    everyone = torch.arange(len(latents.part), device=latents.part.device)
    return torch.stack([objective.said(fold, everyone) for fold in range(latents.folds + 1)])


def _behind(objective: FoldedNetworks, processes: Tensor, latents: Latents) -> float:
    """The networks' error on runs left out over that of the processes."""
    network, process = (
        _error(Chosen(said, 0.0, Fit()).left_out(latents), latents)
        for said in (_networks(objective, latents), processes)
    )
    return network / process if process else 1.0


def left_out_by_process(latents: Latents, seed: int, mixed: Sequence[int] = ()) -> Tensor | None:
    """(run, state, latent) of the own runs, each by a process without it; None where runs do not differ."""
    said, _ = _processes(latents, (1.0,), seed, mixed)
    return None if said is None else Chosen(said, 1.0, Fit()).left_out(latents)


def _error(z: Tensor, latents: Latents) -> float:
    """RMS distance of nodes, in the level's unit, averaged over the known states of the own runs."""
    known = latents.known[: latents.own]
    return float((3.0 * (latents.wrong(z) + latents.lost)).sqrt()[known].mean())


def _mixed(networks: Tensor | None, processes: Tensor | None, share: float) -> Tensor:
    if processes is None or share == 0:
        assert networks is not None
        return networks
    return processes if networks is None or share == 1 else torch.lerp(networks, processes, share)


def _processes(
    latents: Latents, shares: Sequence[float], seed: int, mixed: Sequence[int]
) -> tuple[Tensor | None, LatentProcess | None]:
    """What processes without each fold, and of all runs, say (fold + 1, run, state, latent); and the one of all runs."""
    if shares == (0.0,) or not latents.differ:
        return None, None
    parameters = latents.inputs[:, 0, : latents.time_column].double().cpu().numpy()
    time, sizes = latents.time.double().cpu().numpy(), latents.sizes.double().cpu().numpy()
    values, part = latents.values.double().cpu().numpy(), latents.part.cpu().numpy()
    out = torch.empty(latents.folds + 1, *values.shape, device=latents.values.device)
    process: LatentProcess | None = None
    for fold in range(latents.folds + 1):
        train: NDArray[np.bool_] = part != fold
        process = fit_process(parameters[train], time, values[train], sizes, seed, mixed).to(out.device)
        with torch.no_grad():
            for run in range(len(values)):
                out[fold, run] = process(latents.inputs[run])
    return out, process
