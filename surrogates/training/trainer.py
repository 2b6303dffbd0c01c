"""Training one level after the other, or all together, on the runs of one campaign."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogates.data.campaign import Campaign
from surrogates.data.graphs import Graphs
from surrogates.data.inputs import InputScaling
from surrogates.data.samples import LevelRuns, Notes, ValidationSplit, scale_of
from surrogates.models.cascade import Cascade, build_level
from surrogates.models.level import LevelNetwork
from surrogates.models.unified import Unified
from surrogates.record import Fit
from surrogates.reductions.reduction import LinearReduction, LinearStart, linear_part
from surrogates.regression.latent_process import mix_in
from surrogates.settings import LevelSettings, Settings
from surrogates.surrogate import Surrogate, level_name
from surrogates.training.loop import Epoch, Keeper, Objective, fit, set_up
from surrogates.training.objectives import CHUNK, LatentObjective, LevelObjective, Samples, UnifiedObjective, as_states
from surrogates.training.starts import pod_start, start_level, start_unified


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
        seed = self._seeded(number)
        runs = self.runs(number, graphs)
        level = build_level(number, self.settings, graphs, cascade)
        fixed = isinstance(level.reduction, LinearReduction) and level.coarse is None and not level.with_initial
        inputs, held_inputs = (self._inputs(cascade.inputs, part) for part in self._parts)
        make = self._on_coefficients if fixed else self._on_states
        objective = make(level, runs, inputs, held_inputs)
        cascade.add(number, level)
        own = self.settings.for_level(number, transferred=level.coarse is not None)
        fitted = self._fit(objective, own, level_name(self.settings, number), seed)
        mix_in(level, objective, own.regression, self.campaign.parameters.shape[1], len(self.campaign.time), seed)
        return fitted

    def unified(self, surrogate: Surrogate, numbers: tuple[int, ...], scaling: InputScaling) -> Fit:
        """Train levels `numbers` together, and put them on `surrogate`."""
        finest, graphs = numbers[-1], self.graphs
        seed = self._seeded(finest)
        network = surrogate.core = Unified(scaling, self.settings, graphs, numbers)
        runs = self.runs(finest, graphs)
        states, held = (runs.samples(part) for part in self._parts)
        network.scale = _divide_by_rms(states, held)
        start_unified(network, lambda: map(as_states, states.split(CHUNK)))
        network.to(self.device)
        inputs, held_inputs = (self._inputs(network.inputs, part) for part in self._parts)
        training, validation = (
            self._with_initial(Samples(x.to(self.device), y), len(part))
            if network.with_initial
            else Samples(x.to(self.device), y)
            for x, y, part in zip((states, held), (inputs, held_inputs), self._parts, strict=True)
        )
        objective = UnifiedObjective(network, training, validation)
        return self._fit(objective, self.settings.for_level(finest), "MH", seed)

    def runs(self, number: int, graphs: Graphs) -> LevelRuns:
        """The displacements of level `number` of `graphs`, which may hold fewer nodes than the hierarchy's level."""
        of_hierarchy, wanted = self.graphs.kept(number), graphs.kept(number)
        nodes = None if len(wanted) == len(of_hierarchy) else np.searchsorted(of_hierarchy, wanted)
        return LevelRuns(self.campaign, number, self.settings, self.notes, nodes)

    @property
    def _parts(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        return self.split.training, self.split.validation

    def _seeded(self, number: int) -> int:
        seed = self.settings.seed * 1000 + number
        set_up(seed, self.settings.precision)
        return seed

    def _fit(self, objective: Objective, settings: LevelSettings, name: str, seed: int) -> Fit:
        return fit(
            objective, settings, name=name, seed=seed, precision=self.settings.precision,
            report=self.report, keeper=self.keeper,
        )  # fmt: skip

    def _on_states(self, level: LevelNetwork, runs: LevelRuns, inputs: Tensor, held_inputs: Tensor) -> LevelObjective:
        states, held = (runs.samples(part) for part in self._parts)
        level.scale = _divide_by_rms(states, held)
        linear = linear_part(level.reduction)
        if linear is not None:
            start_level(level, linear, lambda: map(as_states, states.split(CHUNK)))
        level.to(self.device)
        training = self._samples(level, states, inputs, len(self.split.training))
        validation = self._samples(level, held, held_inputs, len(self.split.validation)) if len(held) else None
        return LevelObjective(level, training, validation)

    def _on_coefficients(
        self, level: LevelNetwork, runs: LevelRuns, inputs: Tensor, held_inputs: Tensor
    ) -> LatentObjective:
        """POD on fields that stay where they are but for one run; training then sees coefficients alone."""
        squares: list[float] = []

        def fields() -> Iterator[Tensor]:
            for run in self.split.training:
                values = runs.read(run)
                squares.append(float(np.square(values, dtype=np.float64).mean()))
                yield torch.from_numpy(values).transpose(0, 1)

        linear = level.reduction
        start = pod_start(fields(), level.latent, level.n_nodes)  # in metres
        level.scale = scale_of(float(np.mean(squares)))
        linear.start_at(LinearStart(start.encode * level.scale, start.decode / level.scale, start.offset))  # type: ignore[operator]
        training, rest = self._projected(level, runs, self.split.training)
        held, held_rest = self._projected(level, runs, self.split.validation)
        level.to(self.device)
        objective = LatentObjective(
            level, Samples(training.to(self.device), inputs), Samples(held.to(self.device), held_inputs),
            rest.to(self.device), held_rest.to(self.device),
        )  # fmt: skip
        return objective

    @torch.no_grad()
    def _samples(self, level: LevelNetwork, states: Tensor, inputs: Tensor, runs: int) -> Samples:
        """Samples on the device, with what the frozen levels say of them."""
        out = Samples(states.to(self.device), inputs)
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
        first = samples.states[::count]
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

    def _inputs(self, scaling: InputScaling, runs: NDArray[np.int64]) -> Tensor:
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
