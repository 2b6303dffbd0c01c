"""Trainers for several trainings of one model: the same runs, folds and physics, another seed each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from surrogates.errors import SurrogateError
from surrogates.models.average import Average
from surrogates.models.base import Network
from surrogates.record import Fit
from surrogates.surrogate import Surrogate
from surrogates.training.by_folds import FoldTrainer
from surrogates.training.loop import Epoch, Keeper
from surrogates.training.trainer import Trainer


@dataclass(frozen=True)
class _OfSeed:
    """A keeper that keeps each seed's levels apart."""

    keeper: Keeper
    seed: int

    def load(self, name: str) -> tuple[Mapping[str, Tensor], dict[str, Any]] | None:
        return self.keeper.load(self._named(name))

    def due(self, epoch: int) -> bool:
        return self.keeper.due(epoch)

    def save(self, name: str, tensors: dict[str, Tensor], about: dict[str, Any]) -> None:
        self.keeper.save(self._named(name), tensors, about)

    def _named(self, name: str) -> str:
        return f"seed {self.seed}, {name}"


def trainer_of(trainer: Trainer, place: int) -> Trainer:
    """The trainer of the training number `place`, counted from 0; validation runs, folds and data are those of all."""
    count, seed = trainer.settings.seeds, trainer.settings.seed + place
    if count == 1:
        return trainer
    report = trainer.report

    def told(epoch: Epoch) -> None:
        if report is not None:
            report(replace(epoch, name=f"{place + 1} of {count}, {epoch.name}"))

    more: dict[str, Any] = {"chosen": {}, "latents": {}} if isinstance(trainer, FoldTrainer) else {}
    return replace(
        trainer, settings=trainer.settings.model_copy(update={"seed": seed}), report=told,
        keeper=None if trainer.keeper is None else _OfSeed(trainer.keeper, seed), **more,
    )  # fmt: skip


def averaged(members: Sequence[tuple[Surrogate, Trainer]]) -> Average:
    """The mean of the networks of trained `members`."""
    networks = [member.core for member, _ in members]
    if not all(isinstance(network, Network) for network in networks):
        raise SurrogateError("only networks differ by their seed, and only they are averaged")
    return Average(networks, [trainer.settings.seed for _, trainer in members])  # type: ignore[arg-type]


def fits_together(members: Sequence[tuple[Surrogate, Trainer]], *, interrupted: bool) -> dict[int, Fit]:
    """For each level the first member's course, the seconds of all."""
    out = {}
    for number, first in members[0][0].record.fits.items():
        seconds = sum(member.record.fits[number].seconds for member, _ in members)
        out[number] = replace(first, seconds=seconds, status="interrupted" if interrupted else first.status)
    return out
