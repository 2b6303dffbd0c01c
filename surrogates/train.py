"""From a campaign to a surrogate: the way each kind of model is fitted."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogates.cascade import CHUNK, Cascade, LatentObjective, LevelObjective, Samples, as_states, build_level
from surrogates.config import Settings
from surrogates.data import Campaign
from surrogates.errors import Diverged
from surrogates.graphs import Graphs
from surrogates.inputs import InputScaling, Ranges
from surrogates.level import Level
from surrogates.model import Record, Surrogate, level_name
from surrogates.pod_regression import fit_pod_regression
from surrogates.reduction import LinearReduction, LinearStart, linear_part
from surrogates.samples import Notes, Runs, Split, check, scale_of, split
from surrogates.starts import pod_start, start_linear_part
from surrogates.training import Epoch, Fit, Keeper, Objective, device_of, fit, set_up


def train(
    campaign: Campaign,
    settings: Settings,
    *,
    device: str = "cpu",
    report: Callable[[Epoch], None] | None = None,
    keeper: Keeper | None = None,
) -> Surrogate:
    """Fit the surrogate that `settings` describe to the runs of `campaign`.

    report  told after every epoch
    keeper  where the state of the training is kept between epochs, to go on from after an interruption

    Interrupted (KeyboardInterrupt), it returns what there is: the finished levels, and the one in training with its
    best weights. Raises Diverged, with that surrogate on it, and SurrogateError for data nothing can be learnt from.
    """
    notes = Notes()
    check(campaign, settings, notes)
    parts = split(campaign, settings, notes)
    graphs = Graphs.of(campaign)
    ranges = Ranges.of(
        campaign.parameter_names, campaign.parameter_units, campaign.parameters[parts.training], campaign.time
    )
    record = Record.of(campaign, settings, ranges, parts)
    if settings.model in ("pod-gpr", "pod-rbf"):
        started = time.perf_counter()
        core, _, choice = fit_pod_regression(campaign, settings, parts, notes)
        record.fits[0] = Fit(seconds=time.perf_counter() - started)
        record.choice = {"inputs": choice.inputs, "modes": choice.modes}
        record.errors |= choice.errors
        record.notes = notes.lines
        return Surrogate(settings, record, graphs, core, campaign.points, campaign.faces)
    trainer = _Trainer(campaign, settings, graphs, parts, notes, device_of(device), report, keeper)
    cascade = Cascade(_scaling(settings, ranges))
    surrogate = Surrogate(settings, record, graphs, cascade, campaign.points, campaign.faces)
    try:
        for number in level_numbers(settings, graphs):
            trained = trainer.level(number, cascade)
            record.fits[number] = trained
            if trained.status == "interrupted":
                break
    except KeyboardInterrupt:
        if not cascade.numbers:
            raise
    except Diverged as error:
        if error.fit is not None and error.fit.best_epoch:
            record.fits[cascade.numbers[-1]] = error.fit
        else:
            cascade.drop_finest()
        if cascade.numbers:
            error.surrogate = surrogate
        raise
    finally:
        record.notes = notes.lines
        cascade.cpu()
    record.errors = validation_errors(surrogate, campaign, parts, notes)
    return surrogate


def validation_errors(surrogate: Surrogate, campaign: Campaign, parts: Split, notes: Notes) -> dict[str, float]:
    """e2 (m) over the validation runs on each level's own nodes: of the prediction, and of reduction alone."""
    out: dict[str, float] = {}
    if not len(parts.validation):
        return out
    for name, number in surrogate.level_names.items():
        runs = Runs(campaign, number, surrogate.settings, notes)
        predicted, reduced = [], []
        for run in parts.validation:
            truth = runs.read(run)
            predicted.append(_distance(surrogate.predict(campaign.parameters[run], campaign.time, number), truth))
            reduced.append(_distance(surrogate.reconstruct(truth, number), truth))
        out[name] = float(np.mean(predicted))
        out[f"{name}, reduction alone"] = float(np.mean(reduced))
    return out


def _distance(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    return float(np.linalg.norm(a - b, axis=-1).mean())


def level_numbers(settings: Settings, graphs: Graphs) -> tuple[int, ...]:
    """The levels that are trained, coarsest first; raises SurrogateError for one the hierarchy does not have."""
    chosen = settings.levels or tuple(range(len(graphs.levels), 0, -1))
    for number in chosen:
        graphs.n_nodes(number)
    return chosen


def _scaling(settings: Settings, ranges: Ranges) -> InputScaling:
    return InputScaling(ranges, products=settings.inputs.products, angles=settings.inputs.angles)


@dataclass
class _Trainer:
    """Trains one level after the other on the same runs."""

    campaign: Campaign
    settings: Settings
    graphs: Graphs
    split: Split
    notes: Notes
    device: torch.device
    report: Callable[[Epoch], None] | None
    keeper: Keeper | None

    def level(self, number: int, cascade: Cascade) -> Fit:
        """Train level `number` and put it on top of `cascade`."""
        seed = self.settings.seed * 1000 + number
        set_up(seed, self.settings.precision)
        runs = Runs(self.campaign, number, self.settings, self.notes)
        level = build_level(number, self.settings, self.graphs, cascade)
        fixed = isinstance(level.reduction, LinearReduction) and level.coarse is None and not level.with_initial
        inputs, held_inputs = self._inputs(cascade, self.split.training), self._inputs(cascade, self.split.validation)
        make = self._on_coefficients if fixed else self._on_states
        objective = make(level, runs, inputs, held_inputs)
        cascade.add(number, level)
        return fit(
            objective, self.settings.for_level(number), name=level_name(self.settings, number), seed=seed,
            precision=self.settings.precision, report=self.report, keeper=self.keeper,
        )  # fmt: skip

    def _on_states(self, level: Level, runs: Runs, inputs: Tensor, held_inputs: Tensor) -> Objective:
        states, held = runs.samples(self.split.training), runs.samples(self.split.validation)
        level.scale = scale_of(float(torch.stack([row.double().square().mean() for row in states]).mean()))
        states /= level.scale
        held /= level.scale
        linear = linear_part(level.reduction)
        if linear is not None:
            start_linear_part(level, linear, lambda: map(as_states, states.split(CHUNK)))
        level.to(self.device)
        training = self._samples(level, states, inputs, len(self.split.training))
        validation = self._samples(level, held, held_inputs, len(self.split.validation)) if len(held) else None
        return LevelObjective(level, training, validation)

    def _on_coefficients(self, level: Level, runs: Runs, inputs: Tensor, held_inputs: Tensor) -> Objective:
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
    def _samples(self, level: Level, states: Tensor, inputs: Tensor, runs: int) -> Samples:
        """Samples on the device, with what the frozen levels say of them."""
        out = Samples(states.to(self.device), inputs)
        if level.with_initial:
            count = len(self.campaign.time)
            first = out.states[::count]
            out.initial = first[:1] if (first == first[:1]).all() else first
            out.run = torch.arange(runs, device=self.device).repeat_interleave(count)
        if level.coarse is None:
            return out
        encoded, regressed = [], []
        for index in out.chunks():
            x, batch, _, initial = out.batch(index)
            encoded.append(level.coarse.encode(level.restrict(x)))
            regressed.append(level.coarse.regress(batch, None, None if initial is None else level.restrict(initial)))
        return replace(out, encoded=torch.cat(encoded), regressed=torch.cat(regressed))

    @torch.no_grad()
    def _projected(self, level: Level, runs: Runs, chosen: NDArray[np.int64]) -> tuple[Tensor, Tensor]:
        """Latent vectors (sample, 1, latent) and mean squares (sample,) that the modes leave, in the level's unit."""
        z, rest = [torch.empty(0, level.latent)], [torch.empty(0)]
        for run in chosen:
            x = torch.from_numpy(runs.read(run)).transpose(0, 1) / level.scale
            z.append(level.encode(x))
            rest.append((x - level.decode(z[-1])).square().mean(dim=(0, 2)))
        return torch.cat(z)[:, None], torch.cat(rest)

    def _inputs(self, cascade: Cascade, runs: NDArray[np.int64]) -> Tensor:
        """(run * state, inputs) on the device."""
        parameters = torch.from_numpy(self.campaign.parameters[runs]).to(torch.float64)
        count = len(self.campaign.time)
        at = parameters.repeat_interleave(count, dim=0)
        time = torch.from_numpy(self.campaign.time).to(torch.float64).repeat(len(runs))
        return cascade.inputs.cpu()(at, time).to(self.device)
