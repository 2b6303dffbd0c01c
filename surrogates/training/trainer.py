"""Training one level after the other, or all together, on the runs of one campaign."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogates.data.campaign import Campaign
from surrogates.data.graphs import Graphs
from surrogates.data.samples import LevelRuns, Notes, ValidationSplit, scale_of
from surrogates.data.scaling import InputScaling
from surrogates.data.shelf import States, divide, moved
from surrogates.models.cascade import Cascade, build_level
from surrogates.models.level import LevelNetwork
from surrogates.models.unified import Unified
from surrogates.record import Fit
from surrogates.reductions.reduction import LinearReduction, LinearStart, linear_part
from surrogates.regression.latent_process import mix_in
from surrogates.regression.network import Course
from surrogates.settings import LevelSettings, Settings
from surrogates.surrogate import Surrogate, level_name
from surrogates.training.loop import Epoch, Keeper, Objective, set_up
from surrogates.training.loop import fit as run_epochs
from surrogates.training.objectives import LatentObjective, LevelObjective, Samples, UnifiedObjective, as_states, chunk
from surrogates.training.starts import pod_start, start_level, start_unified

_log = logging.getLogger(__name__)
# Share of the largest displacement below which a first state is undeformed.
UNDEFORMED = 1e-6


@dataclass
class Trainer:
    """Trains one level after the other on the same runs."""

    campaign: Campaign
    settings: Settings
    graphs: Graphs
    split: ValidationSplit
    notes: Notes
    device: torch.device
    report: Callable[[Epoch], None] | None
    keeper: Keeper | None

    def level(self, number: int, cascade: Cascade, graphs: Graphs) -> Fit:
        """Train level `number` and put it on top of `cascade`."""
        seed = self.seeded(number)
        runs = self.runs(number, graphs)
        level = build_level(number, self.settings, graphs, cascade)
        fixed = isinstance(level.reduction, LinearReduction) and level.coarse is None and not level.with_initial
        make = self._on_coefficients if fixed else self.on_states
        objective = make(level, runs, cascade.inputs, *self._parts)
        cascade.add(number, level)
        own = self.settings.for_level(number, transferred=level.coarse is not None)
        fitted = self.fit(objective, own, level_name(self.settings, number), seed)
        mix_in(level, objective, own.regression, self.campaign.parameters.shape[1], len(self.campaign.time), seed)
        level.settle()
        return fitted

    def unified(self, surrogate: Surrogate, numbers: tuple[int, ...], scaling: InputScaling) -> Fit:
        """Train levels `numbers` together, and put them on `surrogate`."""
        finest, graphs = numbers[-1], self.graphs
        seed = self.seeded(finest)
        network = surrogate.core = Unified(scaling, self.settings, graphs, numbers)
        runs = self.runs(finest, graphs)
        states, held = (runs.samples(part) for part in self._parts)
        network.scale = _divide_by_rms(states, held)
        start_unified(network, lambda: map(as_states, states.split(chunk(network.n_nodes))))
        network.to(self.device)
        inputs, held_inputs = (self.inputs(network.inputs, part) for part in self._parts)
        training, validation = (
            self._with_initial(Samples(x.to(self.device), y), len(part))
            if network.with_initial
            else Samples(x.to(self.device), y)
            for x, y, part in zip((states, held), (inputs, held_inputs), self._parts, strict=True)
        )
        objective = UnifiedObjective(network, training, validation)
        return self.fit(objective, self.settings.for_level(finest), "MH", seed)

    @property
    def judged_campaign(self) -> Campaign:
        """The runs that errors are measured on."""
        return self.campaign

    def judged(self, number: int, graphs: Graphs) -> LevelRuns:
        """As `runs`, of the campaign that errors are measured on."""
        return self.runs(number, graphs, self.judged_campaign)

    def runs(self, number: int, graphs: Graphs, campaign: Campaign | None = None) -> LevelRuns:
        """The displacements of level `number` of `graphs`, which may hold fewer nodes than the hierarchy's level."""
        of_hierarchy, wanted = self.graphs.kept(number), graphs.kept(number)
        nodes = None if len(wanted) == len(of_hierarchy) else np.searchsorted(of_hierarchy, wanted)
        return LevelRuns(campaign or self.campaign, number, self.settings, self.notes, nodes)

    @property
    def _parts(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        return self.split.training, self.split.validation

    def seeded(self, number: int) -> int:
        """The seed of a level's training, which torch is given."""
        seed = self.settings.seed * 1000 + number
        set_up(seed, self.settings.precision)
        return seed

    def fit(self, objective: Objective, settings: LevelSettings, name: str, seed: int) -> Fit:
        """Run the training loop."""
        found = run_epochs(
            objective, settings, name=name, seed=seed, precision=self.settings.precision,
            report=self.report, keeper=self.keeper,
        )  # fmt: skip
        _log.info(
            "%s is trained and is judged now", name
        )  # it may have ended early, and judging takes as long at times
        return found

    def on_states(
        self,
        level: LevelNetwork,
        runs: LevelRuns,
        scaling: InputScaling,
        training: NDArray[np.int64],
        validation: NDArray[np.int64],
        *,
        alone: bool = False,
    ) -> LevelObjective:
        """The level on the states of the runs `training`, judged on those of `validation`; its linear part is started.

        alone  the reduction is trained without the regression
        """
        keep, keep_held = (self._known(part) for part in (training, validation))
        states, seen = runs.gathered(training, keep)
        held, _ = runs.gathered(validation, keep_held)
        level.scale = scale_of(seen.mean_square)
        for some in (states, held):
            divide(some, level.scale)
        first, largest, course = (
            torch.tensor(of, dtype=torch.float32) for of in (seen.first, seen.largest, seen.course)
        )
        self._rest(level, scaling, first / level.scale, largest / level.scale, course)
        linear = linear_part(level.reduction)
        if linear is not None:
            start_level(level, linear, lambda: map(as_states, states.split(chunk(level.n_nodes))))
        level.to(self.device)
        if alone:
            level.regressor.requires_grad_(False)
        inputs, held_inputs = (self.inputs(scaling, part) for part in (training, validation))
        if keep is not None and keep_held is not None:
            inputs, held_inputs = (
                x[torch.from_numpy(of.ravel()).to(x.device)] for x, of in ((inputs, keep), (held_inputs, keep_held))
            )
        samples = self._samples(level, states, inputs, len(training))
        held_samples = self._samples(level, held, held_inputs, len(validation)) if len(held) else None
        return LevelObjective(level, samples, held_samples, reduction_alone=alone)

    def _known(self, runs: NDArray[np.int64]) -> NDArray[np.bool_] | None:
        """(run, state) states that were computed, where not all were."""
        return None if self.campaign.known is None else np.asarray(self.campaign.known)[runs]

    def _rest(self, level: LevelNetwork, scaling: InputScaling, first: Tensor, largest: Tensor, course: Tensor) -> None:
        """Where all runs start undeformed, as their `first` displacements say, predictions will.

        course  (state,) RMS displacement over the runs: before training, how far they have come apart
        """
        if self.settings.level.first_state == "kept" and first <= UNDEFORMED * largest:
            level.at_rest = True
            time = self.inputs(scaling, np.zeros(1, np.int64))[:, scaling.time_column].cpu()
            level.course = Course.of(time, torch.zeros(len(time), level.latent), course)

    def start_fixed(
        self, level: LevelNetwork, runs: LevelRuns, scaling: InputScaling, training: NDArray[np.int64]
    ) -> None:
        """POD of the runs `training`, one at a time, as the reduction of a level that is not trained further."""
        squares: list[Tensor] = []
        first = largest = torch.zeros(())

        def fields() -> Iterator[Tensor]:
            nonlocal first, largest
            for run in training:
                values = torch.from_numpy(runs.read(run))
                squares.append(values.double().square().mean(dim=(1, 2)))
                first, largest = torch.maximum(first, values[0].abs().max()), torch.maximum(largest, values.abs().max())
                yield values.transpose(0, 1)

        linear = level.reduction
        start = pod_start(fields(), level.latent, level.n_nodes)  # in metres
        course = torch.stack(squares).mean(dim=0)
        level.scale = scale_of(float(course.mean()))
        self._rest(level, scaling, first, largest, course.sqrt().float())
        linear.start_at(LinearStart(start.encode * level.scale, start.decode / level.scale, start.offset))  # type: ignore[operator]

    def _on_coefficients(
        self,
        level: LevelNetwork,
        runs: LevelRuns,
        scaling: InputScaling,
        training: NDArray[np.int64],
        validation: NDArray[np.int64],
    ) -> LatentObjective:
        """POD on fields that stay where they are but for one run; training then sees coefficients alone."""
        self.start_fixed(level, runs, scaling, training)
        projected, rest = self._projected(level, runs, training)
        held, held_rest = self._projected(level, runs, validation)
        level.to(self.device)
        inputs, held_inputs = (self.inputs(scaling, part) for part in (training, validation))
        return LatentObjective(
            level, Samples(projected.to(self.device), inputs), Samples(held.to(self.device), held_inputs),
            rest.to(self.device), held_rest.to(self.device),
        )  # fmt: skip

    @torch.no_grad()
    def _samples(self, level: LevelNetwork, states: States, inputs: Tensor, runs: int) -> Samples:
        """Samples on the device, with what the frozen levels say of them."""
        out = Samples(moved(states, self.device), inputs)
        if level.with_initial:
            out = self._with_initial(out, runs)
        if level.coarse is None:
            return out
        encoded, regressed = [], []
        for index in out.chunks():
            x, batch, _, initial = out.batch(index)
            encoded.append(level.coarse.encode(level.restrict(x)))
            regressed.append(level.coarse.regress(batch, None, None if initial is None else level.restrict(initial)))
        return replace(out, encoded=torch.cat(encoded), regressed=torch.cat(regressed))

    def _with_initial(self, samples: Samples, runs: int) -> Samples:
        """`samples` with the first state of every run, once where all runs start alike."""
        count = len(self.campaign.time)
        first = samples.states[::count].to(self.device)
        alike = bool((first == first[:1]).all())
        run = torch.arange(runs, device=self.device).repeat_interleave(count)
        return replace(samples, initial=first[:1] if alike else first, run=run)

    @torch.no_grad()
    def _projected(self, level: LevelNetwork, runs: LevelRuns, chosen: NDArray[np.int64]) -> tuple[Tensor, Tensor]:
        """Latent vectors (sample, 1, latent) and mean squares (sample,) that the modes leave, in the level's unit."""
        z, rest = [torch.empty(0, level.latent)], [torch.empty(0)]
        for run in chosen:
            x = torch.from_numpy(runs.read(run)).transpose(0, 1) / level.scale
            z.append(level.encode(x))
            rest.append((x - level.decode(z[-1])).square().mean(dim=(0, 2)))
        return torch.cat(z)[:, None], torch.cat(rest)

    def inputs(self, scaling: InputScaling, runs: NDArray[np.int64]) -> Tensor:
        """(run * state, inputs) on the device; computed in float64, which some devices lack."""
        count = len(self.campaign.time)
        at = torch.from_numpy(np.repeat(self.campaign.parameters[runs].astype(np.float64), count, axis=0))
        time = torch.from_numpy(np.tile(self.campaign.time.astype(np.float64), len(runs)))
        result: Tensor = scaling(at, time).to(self.device)
        return result


def _divide_by_rms(states: Tensor, held: Tensor) -> float:
    """Divide both in place by the RMS of `states`, and give it, m."""
    scale = scale_of(float(torch.stack([row.double().square().mean() for row in states]).mean()))
    states /= scale
    held /= scale
    return scale
