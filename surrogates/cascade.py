"""The cascade: levels from coarse to fine, each trained on top of the frozen ones below it (section 3.4).

PODNN, AENN and GAENN are cascades of one level on the full mesh with another reduction.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from surrogates.config import Settings
from surrogates.errors import SurrogateError
from surrogates.graphs import Graphs
from surrogates.inputs import InputScaling
from surrogates.level import Known, Level
from surrogates.networks import Regressor
from surrogates.reduction import linear_part, make_reduction
from surrogates.training import Objective
from surrogates.upsampling import Upsampling

# Samples handled at once outside training.
CHUNK = 512


class Cascade(nn.Module):
    """Trained levels by number, on one input scaling. `add` puts a finer one on top and freezes those below."""

    def __init__(self, inputs: InputScaling) -> None:
        super().__init__()
        self.inputs = inputs
        self.levels: dict[int, Level] = {}
        self.finest: Level | None = None

    def add(self, number: int, level: Level) -> None:
        self.levels[number] = level
        self.finest = level

    def drop_finest(self) -> None:
        """Forget the finest level."""
        self.levels.popitem()
        self.finest = next(reversed(self.levels.values()), None)

    @property
    def numbers(self) -> tuple[int, ...]:
        return tuple(self.levels)

    def latent(self, number: int) -> int:
        return self.levels[number].latent

    def forward(self, parameters: Tensor, time: Tensor, number: int, initial: Tensor | None = None) -> Tensor:
        """Displacements (node, b, 3), m, for parameters (b, p) and time (b,); `initial` (node, 1, 3), m."""
        level = self.levels[number]
        start = None if initial is None else initial / level.scale
        return level.decode(level.regress(self.inputs(parameters, time), initial=start)) * level.scale

    def reconstruct(self, x: Tensor, number: int) -> Tensor:
        """Encode and decode displacements (node, b, 3), m."""
        level = self.levels[number]
        return level.decode(level.encode(x / level.scale)) * level.scale

    def n_parameters(self, number: int) -> int:
        """Numbers of the level and of all below it that it needs."""
        return sum(sum(v.parameter_counts().values()) for k, v in self.levels.items() if k >= number)

    def tensors(self) -> dict[str, dict[str, Tensor]]:
        """What has to be stored: for each level its own tensors."""
        return {f"level_{k}": v.own_state() for k, v in self.levels.items()}

    def load(self, tensors: dict[str, dict[str, Tensor]]) -> None:
        for number, level in self.levels.items():
            level.load_own_state(tensors[f"level_{number}"])


def build_level(number: int, settings: Settings, graphs: Graphs, cascade: Cascade) -> Level:
    """An untrained level `number` on top of what `cascade` holds; coarser levels are frozen by it."""
    own = settings.for_level(number)
    coarse_number = cascade.numbers[-1] if cascade.numbers else None
    coarse = None if coarse_number is None else cascade.levels[coarse_number]
    concat = settings.transfer.encoder == "concat" and coarse is not None
    below = 0 if coarse is None else coarse.latent
    latent = own.latent + (below if concat else 0)
    needs_graph = own.reduction == "gcn"
    edges = graphs.edges(number) if needs_graph else None
    reduction = make_reduction(own, edges, graphs.n_nodes(number), latent)
    extra = latent if settings.inputs.initial_state else 0
    regressor = Regressor(
        cascade.inputs.size + extra, latent, own.mlp.widths, own.mlp.activation,
        coarse=below, residual=settings.transfer.mlp == "residual",
    )  # fmt: skip
    more: dict[str, Any] = {}
    if coarse is not None and coarse_number is not None:
        more = {
            "coarse": coarse,
            "upsampling": Upsampling(graphs.upsampling(coarse_number, number), settings.transfer.upsampling),
            "in_finer": graphs.places(coarse_number, number),
        }
    return Level(
        reduction, regressor, n_nodes=graphs.n_nodes(number), latent=latent, concat=concat,
        with_initial=settings.inputs.initial_state, **more,
    )  # fmt: skip


@dataclass
class Samples:
    """Samples of one level on a device.

    states     (sample, 3, node), in the level's unit
    inputs     (sample, inputs)
    encoded    (sample, coarse latent) and regressed likewise: what the frozen levels say, or None
    initial    (run, 3, node) first states and `run` (sample,), where the regression reads them
    """

    states: Tensor
    inputs: Tensor
    encoded: Tensor | None = None
    regressed: Tensor | None = None
    initial: Tensor | None = None
    run: Tensor | None = None

    def __len__(self) -> int:
        return len(self.inputs)

    def batch(self, index: Tensor) -> tuple[Tensor, Tensor, Known, Tensor | None]:
        """States (node, b, 3), inputs, what is known, and first states (node, b, 3) of samples `index`."""
        known = Known(
            None if self.encoded is None else self.encoded[index],
            None if self.regressed is None else self.regressed[index],
        )
        initial = None
        if self.initial is not None and self.run is not None:
            which = self.run[index] if len(self.initial) > 1 else torch.zeros(1, dtype=torch.int64)
            initial = as_states(self.initial[which.to(self.initial.device)])
        return as_states(self.states[index]), self.inputs[index], known, initial

    def chunks(self) -> Iterator[Tensor]:
        """Sample numbers, a few hundred at a time."""
        return iter(torch.arange(len(self), device=self.inputs.device).split(CHUNK))


def as_states(rows: Tensor) -> Tensor:
    """(b, 3, node) -> (node, b, 3), laid out as [channel, node, batch], which convolutions take without a copy."""
    return rows.permute(1, 2, 0).contiguous().permute(1, 2, 0)


class LevelObjective(Objective):
    """mean((x - dec(mlp))^2) and mean((x - dec(enc(x)))^2) of one level; both decoded in one pass (equation 8)."""

    def __init__(self, level: Level, training: Samples, validation: Samples | None) -> None:
        super().__init__()
        self.level = level
        self.training_samples, self.validation_samples = training, validation
        self.size = len(training)

    def networks(self) -> dict[str, nn.Module]:
        return {"level": self.level}

    def forward(self, index: Tensor) -> Tensor:
        return self._losses(self.training_samples, index)

    def validation(self) -> Tensor | None:
        return _averaged(self._losses, self.validation_samples)

    def _losses(self, samples: Samples, index: Tensor) -> Tensor:
        x, inputs, known, initial = samples.batch(index)
        z = torch.cat([self.level.regress(inputs, known, initial), self.level.encode(x, known)])
        difference = self.level.decode(z).unflatten(1, (2, len(index))) - x[:, None]
        return difference.square().mean(dim=(0, 2, 3)).float()


class LatentObjective(Objective):
    """The losses of a level with fixed orthogonal modes, from coefficients alone: |x - D z|^2 = rest + |c - s z|^2.

    samples.states holds the scaled coefficients c / s as (sample, 1, latent); `rest` (sample,) what the modes leave.
    """

    def __init__(
        self, level: Level, training: Samples, validation: Samples, rest: Tensor, validation_rest: Tensor
    ) -> None:
        super().__init__()
        self.level = level
        self.training_samples, self.validation_samples = training, validation
        self.rest, self.validation_rest = rest, validation_rest
        self.size = len(training)
        modes = linear_part(level.reduction)
        if modes is None:
            raise SurrogateError("training on coefficients needs a linear reduction")
        # Modes are orthogonal, so a wrong latent number costs its mode's square and nothing mixes.
        self.weight = modes.decode_matrix.detach().square().sum(dim=0) / (3 * level.n_nodes)

    def networks(self) -> dict[str, nn.Module]:
        return {"level": self.level}

    def forward(self, index: Tensor) -> Tensor:
        return self._losses(self.training_samples, index, self.rest)

    def validation(self) -> Tensor | None:
        return _averaged(lambda s, k: self._losses(s, k, self.validation_rest), self.validation_samples)

    def _losses(self, samples: Samples, index: Tensor, rest: Tensor) -> Tensor:
        known = Known()
        z = self.level.regress(samples.inputs[index], known)
        wrong = ((samples.states[index, 0] - z).square() @ self.weight).mean()
        left = rest[index].mean()
        return torch.stack([left + wrong, left]).float()


def _averaged(losses: Callable[[Samples, Tensor], Tensor], samples: Samples | None) -> Tensor | None:
    if samples is None or not len(samples):
        return None
    total = sum(losses(samples, index) * len(index) for index in samples.chunks())
    return total / len(samples)  # type: ignore[operator,return-value]
