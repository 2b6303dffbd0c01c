"""Training where choices are made by folds of the training runs, and what is kept has seen them all.

For each level: the reduction is computed, and a process on it shows how wrong regressions are. Where what a training can
take away of the reduction's own loss on left-out runs matters beside that, it is trained without one fold, to see how many
epochs are good for runs left out, then again on all runs for so many. The regression is chosen on the encoded runs
(`surrogates.training.regression`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from data_schema.memory import give_back
from surrogates.data.campaign import Campaign
from surrogates.data.graphs import Graphs
from surrogates.data.samples import FEWEST_TO_SPLIT, LevelRuns
from surrogates.models.base import in_metres
from surrogates.models.cascade import Cascade, build_level
from surrogates.models.level import LevelNetwork
from surrogates.physics.clock import between
from surrogates.physics.registration import Registration
from surrogates.record import Fit
from surrogates.reductions.reduction import LinearReduction
from surrogates.settings import LevelSettings, Settings
from surrogates.surrogate import level_name
from surrogates.training.coarse_latents import CoarseFields
from surrogates.training.latents import CoarseLatents, Latents
from surrogates.training.loop import Objective
from surrogates.training.objectives import LevelObjective, chunk
from surrogates.training.regression import Chosen, choose_regression, left_out_by_process
from surrogates.training.trainer import Trainer

# Mean square of what a reduction loses on left-out runs, beside that of their wrongly said latent vectors, which matters.
_MATTERS = 0.02
# Share of what a start at POD loses (mean square) that training takes away at most: on the kart's levels it was a quarter,
# after half an hour.
_GAINED = 0.5
# Trainings of so many epochs begin with a trial of this share of them.
_LONG, _TRIAL = 100, 0.25
# Levels of more nodes go through this share of the states in an epoch, where the level below loses no more by it than this.
_MANY_NODES, _FEWER, _NO_WORSE = 10_000, 0.25, 1.01
# Sizes of latent numbers: at so many latent vectors, by this share of their spread.
_PLACES, _STEP = 8, 0.25


def chooses_by_folds(settings: Settings, campaign: Campaign) -> bool:
    """Whether regressions can be chosen by folds: they are no part of the reduction's training, and no runs are named."""
    apart = [settings.for_level(k) for k in (*settings.at, *settings.levels, -1)]
    return (
        settings.model not in ("pod-gpr", "pod-rbf")
        and settings.validation.measure == "runs"
        and not settings.validation.runs
        and not settings.unified
        and not settings.inputs.initial_state
        and len(campaign.parameters) >= FEWEST_TO_SPLIT
        and all(level.regression != "network" or level.reduction == "pod" for level in apart)
    )


@dataclass(kw_only=True)
class FoldTrainer(Trainer):
    """A trainer that leaves out one part of the runs after the other.

    original      the campaign as it is, and `registration` what made `campaign` of it
    part          (run,) the fold that leaves a run out, the same for a run and its image; images stand behind the runs
    chosen        what was chosen for each level, and `latents` what from
    fewer         whether a level below lost nothing by epochs of fewer states
    below         runs on a coarser mesh, which may help
    """

    original: Campaign
    registration: Registration
    part: NDArray[np.int64]
    chosen: dict[int, Chosen] = field(default_factory=dict)
    latents: dict[int, Latents] = field(default_factory=dict)
    fewer: bool = False
    below: CoarseFields | None = None

    def level(self, number: int, cascade: Cascade, graphs: Graphs) -> Fit:
        started = time.perf_counter()
        name, runs = level_name(self.settings, number), self.runs(number, graphs)
        settings = self.settings.for_level(number, transferred=bool(cascade.numbers))
        level, epochs, interrupted = self._reduced(number, cascade, graphs, runs, settings)
        settings = settings.model_copy(update={"states": 1.0})
        level.settle()
        latents = self._encoded(level, runs, cascade)
        if self.below is not None:
            coarse = self._coarse(level, graphs.kept(number), cascade, self.below)
            under = any(cascade.takes_coarse(k) for k in cascade.numbers)
            latents = replace(latents, coarse=coarse, coarse_below=under)
        chosen = choose_regression(
            level, latents, "process" if interrupted else settings.regression,
            lambda objective: self.fit(objective, settings, name, self.seeded(number)), self.settings.seed,
            self.registration.inputs.mixed, self._trial(settings, name, number),
        )  # fmt: skip
        for note in chosen.notes:
            self.notes.add(f"{name}: {note}" if not note.startswith(name) else note)
        if interrupted:
            chosen.fit.status = "interrupted"
        chosen.reduction_epochs = epochs
        chosen.fit.seconds = time.perf_counter() - started
        self.chosen[number], self.latents[number] = chosen, latents
        return chosen.fit

    def _trial(self, settings: LevelSettings, name: str, number: int) -> Callable[[Objective], Fit] | None:
        """A short training of networks, with its own schedule; None where the whole one is short or is never to end early."""
        if not settings.patience or settings.epochs < _LONG:
            return None
        short = settings.model_copy(update={"epochs": round(_TRIAL * settings.epochs)})
        return lambda objective: self.fit(objective, short, f"{name} trial", self.seeded(number))

    @property
    def own(self) -> int:
        """How many runs were computed; the others are images."""
        return len(self.original.parameters)

    @property
    def judged_campaign(self) -> Campaign:
        return self.original

    def left_out(self, number: int, level: LevelNetwork, *, from_coarse: bool = False) -> Iterator[NDArray[np.float32]]:
        """For each run as computed, (state, node, 3), m: what is said of it without it, at its own times.

        Parameters
        ----------
        from_coarse
            From its own coarse run, where the level takes something from one.
        """
        chosen = self.chosen[number]
        itself = chosen.itself if from_coarse else None
        z = (chosen.left_out(self.latents[number]) if itself is None else itself).cpu().numpy()
        grid = self.campaign.time
        for run, course in enumerate(z):

            def said(
                _: NDArray[np.float64], time: NDArray[np.float64], course: NDArray[np.float32] = course
            ) -> NDArray[np.float32]:
                at = torch.from_numpy(between(course, grid, time))
                with torch.no_grad():
                    parts = [
                        in_metres(level.decode(some), level.scale).transpose(0, 1)
                        for some in at.split(chunk(level.n_nodes))
                    ]
                return torch.cat(parts)[None].numpy()

            yield self.registration.undo(said, self.original.parameters[run : run + 1], self.original.time)[0]

    def _reduced(
        self, number: int, cascade: Cascade, graphs: Graphs, runs: LevelRuns, settings: LevelSettings
    ) -> tuple[LevelNetwork, int, bool]:
        """The level with its reduction trained, for how many epochs, and whether that was interrupted."""
        everyone = np.arange(len(self.part))
        level = self._fresh(number, cascade, graphs)
        if isinstance(level.reduction, LinearReduction) and level.coarse is None:
            self.start_fixed(level, runs, cascade.inputs, everyone)
            level.to(self.device)
            return level, 0, False
        started = settings.start == "pod"
        self._alone(level, runs, cascade, everyone)
        wrong = self._wrong(level, runs, cascade) if started else 0.0
        held = np.flatnonzero(self.part[: self.own] == 0)
        if not any(parameter.requires_grad for parameter in level.parameters()):
            return level, 0, False
        del level  # one at a time: on a large level it is most of what is in memory
        level = self._fresh(number, cascade, graphs)
        objective = self._alone(level, runs, cascade, everyone[self.part != 0], held)
        matters = _MATTERS * wrong / level.scale**2
        with torch.no_grad():
            measured = objective.validation()
        untrained = float("inf") if measured is None or not started else float(measured[0])
        epochs = 0
        name = level_name(self.settings, number)
        if settings.states == "auto":
            share = _FEWER if self.fewer and level.n_nodes > _MANY_NODES else 1.0
            settings = settings.model_copy(update={"states": share})
        may_gain = (_GAINED if started else 1.0) * untrained > matters
        if may_gain and settings.states != 1:
            told = f"an epoch goes through {100 * float(settings.states):g} % of the states"
            self.notes.add(f"{name}: {told}{', as the coarser level was no worse so' if self.fewer else ''}")
        asked = self._for_the_next(number, graphs)
        if may_gain or asked:
            tried = self.fit(objective, settings, f"{name} reduction", self.seeded(number))
            if tried.status == "interrupted":
                return level, tried.epochs, True
            best = tried.best / (settings.weight_approximation + settings.weight_reconstruction)
            epochs = tried.best_epoch if may_gain and untrained - best > matters else 0
            if asked:
                del level, objective
                level = self._fresh(number, cascade, graphs)
                objective = self._alone(level, runs, cascade, everyone[self.part != 0], held)
                some = settings.model_copy(update={"states": _FEWER})
                few = self.fit(objective, some, f"{name} reduction, fewer states", self.seeded(number))
                if few.status == "interrupted":
                    return level, few.epochs, True
                self.fewer = few.best <= _NO_WORSE * tried.best
        del level, objective
        level = self._fresh(number, cascade, graphs)
        objective = self._alone(level, runs, cascade, everyone)
        if not epochs:
            return level, 0, False
        short = settings.model_copy(update={"epochs": epochs, "patience": 0.0})
        again = self.fit(objective, short, f"{name} reduction, all runs", self.seeded(number))
        return level, epochs, again.status == "interrupted"

    def _for_the_next(self, number: int, graphs: Graphs) -> bool:
        """Whether level `number` shall show if fewer states do: the next finer one is the first of many nodes, and wants to know."""
        finer = [k for k in self.settings.levels or range(1, len(graphs.levels) + 1) if k < number]
        if not finer or self.settings.for_level(max(finer)).states != "auto":
            return False
        return graphs.n_nodes(number) <= _MANY_NODES < graphs.n_nodes(max(finer))

    def _alone(
        self,
        level: LevelNetwork,
        runs: LevelRuns,
        cascade: Cascade,
        training: NDArray[np.int64],
        held: NDArray[np.int64] | None = None,
    ) -> LevelObjective:
        """The reduction of `level`, started and ready to be trained on the runs `training`, and judged on `held`."""
        none = training[:0] if held is None else held
        return self.on_states(level, runs, cascade.inputs, training, none, alone=True)

    def _wrong(self, level: LevelNetwork, runs: LevelRuns, cascade: Cascade) -> float:
        """Mean square, m^2, of what processes say wrongly of latent vectors of runs left out."""
        latents = self._encoded(level, runs, cascade)
        left = left_out_by_process(latents, self.settings.seed, self.registration.inputs.mixed)
        if left is None:
            return 0.0
        return level.scale**2 * float(latents.wrong(left)[latents.known[: latents.own]].mean())

    def _fresh(self, number: int, cascade: Cascade, graphs: Graphs) -> LevelNetwork:
        """An untrained level on top of `cascade`, in the place of one of that number."""
        self.seeded(number)
        if number in cascade.levels:
            cascade.drop_finest()
        give_back()
        level = build_level(number, self.settings, graphs, cascade)
        cascade.add(number, level)
        return level

    @torch.no_grad()
    def _encoded(self, level: LevelNetwork, runs: LevelRuns, cascade: Cascade) -> Latents:
        count = len(self.campaign.time)
        everyone = np.arange(len(self.part))
        inputs = self.inputs(cascade.inputs, everyone).unflatten(0, (len(everyone), count))
        known = torch.ones(len(everyone), count, dtype=torch.bool, device=self.device)
        if self.campaign.known is not None:
            known = torch.from_numpy(np.asarray(self.campaign.known)).to(self.device)
        z, lost, states = [], 0.0, 0
        for run in everyone:
            encoded = []
            for some, counts in zip(
                torch.from_numpy(runs.read(int(run))).split(chunk(level.n_nodes)),
                known[run].split(chunk(level.n_nodes)), strict=True,
            ):  # fmt: skip
                x = (some.transpose(0, 1) / level.scale).to(self.device)
                encoded.append(level.encode(x))
                wrong = (x - level.decode(encoded[-1])).square().mean(dim=(0, 2))[counts]
                lost, states = lost + float(wrong.sum()), states + len(wrong)
            z.append(torch.cat(encoded))
        values = torch.stack(z)
        below = None
        if level.coarse is not None:
            coarse = next(number for number, other in cascade.levels.items() if other is level.coarse)
            below = self.chosen[coarse].said
        return Latents(
            inputs, values, known, _sizes(level, values[known]), lost / max(states, 1),
            torch.from_numpy(self.part).to(self.device), self.own, cascade.inputs.time_column, below,
        )  # fmt: skip

    @torch.no_grad()
    def _coarse(
        self, level: LevelNetwork, nodes: NDArray[np.int64], cascade: Cascade, below: CoarseFields
    ) -> CoarseLatents:
        """The coarse runs, encoded as the level's own."""

        def encode(states: NDArray[np.float32]) -> NDArray[np.float32]:
            parts = torch.from_numpy(states).split(chunk(level.n_nodes))
            return (
                torch.cat([level.encode((x.transpose(0, 1) / level.scale).to(self.device)) for x in parts])
                .cpu()
                .numpy()
            )

        inputs = torch.from_numpy(below.inputs)
        scaled = cascade.inputs(inputs, torch.zeros(len(inputs)))[:, : cascade.inputs.time_column]
        values, twin = below.courses(nodes, encode), below.twin(self.original.parameters)
        return CoarseLatents(scaled.double().numpy(), values, len(below.keep), twin)


def _sizes(level: LevelNetwork, z: torch.Tensor) -> torch.Tensor:
    """(latent,) RMS movement of the nodes for a latent number that moves by one, about some of `z` (sample, latent)."""
    step = _STEP * z.std(dim=0).clamp_min(1e-6)
    squares = []
    for middle in z[torch.linspace(0, len(z) - 1, _PLACES).long()]:
        of_middle = []
        for steps in torch.diag(step).split(max(1, chunk(level.n_nodes) - 1)):
            moved = level.decode(torch.cat([middle[None], middle + steps]))
            of_middle.append((moved[:, 1:] - moved[:, :1]).square().mean(dim=(0, 2)))
        squares.append(torch.cat(of_middle))
    return torch.stack(squares).mean(dim=0).sqrt() / step
