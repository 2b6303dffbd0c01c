"""What a batch costs: the two losses of section 3.3 for one level, for fixed modes, and for all levels together."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from surrogates.data.shelf import States
from surrogates.errors import SurrogateError
from surrogates.models.level import Known, LevelNetwork
from surrogates.models.unified import Unified
from surrogates.operators.stacks import gradients_in_place
from surrogates.reductions.reduction import DenseReduction, GraphReduction, SumReduction, linear_part
from surrogates.training.loop import Objective

# Samples handled at once outside training, and how many nodes they may have together: the widest convolution holds some
# seventy numbers for each, a gradient some three hundred.
_CHUNK, _NODES, _NODES_IN_TRAINING = 512, 1 << 17, 1 << 18
# Bytes of trained weights above which, on a CPU, their gradients are not to be in memory together.
_LARGE = 64 << 20


def chunk(n_nodes: int) -> int:
    """How many samples of `n_nodes` nodes are handled at once outside training."""
    return max(1, min(_CHUNK, _NODES // n_nodes))


def pieces(batch: int, n_nodes: int) -> int:
    """Into how many pieces a batch is cut, so that what a gradient needs stays small."""
    return max(1, min(batch, -(-batch * n_nodes // _NODES_IN_TRAINING)))


@dataclass
class Samples:
    """Samples of one level on a device.

    states     (sample, 3, node), in the level's unit; read from a file where they are many
    inputs     (sample, inputs)
    encoded    (sample, coarse latent) and regressed likewise: what the frozen levels say, or None
    initial    (run, 3, node) first states and `run` (sample,), where the regression reads them
    """

    states: States
    inputs: Tensor
    encoded: Tensor | None = None
    regressed: Tensor | None = None
    initial: Tensor | None = None
    run: Tensor | None = None

    def __len__(self) -> int:
        return len(self.inputs)

    @property
    def in_place(self) -> bool:
        """Whether the states lie on the device of the inputs."""
        return isinstance(self.states, Tensor) and self.states.device == self.inputs.device

    @property
    def in_memory(self) -> Tensor:
        """The states as a tensor.

        Raises
        ------
        SurrogateError
            Where they are in a file.
        """
        if not isinstance(self.states, Tensor):
            raise SurrogateError("these states are in a file, and are read a batch at a time; expected few enough")
        return self.states

    def batch(self, index: Tensor) -> tuple[Tensor, Tensor, Known, Tensor | None]:
        """States (node, b, 3), inputs, what is known, and first states (node, b, 3) of samples `index`."""
        known = Known(
            None if self.encoded is None else self.encoded[index],
            None if self.regressed is None else self.regressed[index],
        )
        initial = None
        if self.initial is not None and self.run is not None:
            initial = as_states(self.initial if len(self.initial) == 1 else self.initial[self.run[index]])
        return as_states(self.states[index].to(self.inputs.device)), self.inputs[index], known, initial

    def chunks(self) -> Iterator[Tensor]:
        """Sample numbers, a few hundred at a time, or fewer where states are large."""
        nodes = 1 if isinstance(self.states, Tensor) and self.states.ndim < 3 else self.states[:1].shape[-1]
        return iter(torch.arange(len(self), device=self.inputs.device).split(chunk(nodes)))


def as_states(rows: Tensor) -> Tensor:
    """(b, 3, node) -> (node, b, 3), laid out as [channel, node, batch], which convolutions take without a copy."""
    return rows.permute(1, 2, 0).contiguous().permute(1, 2, 0)


class LevelObjective(Objective):
    """mean((x - dec(mlp))^2) and mean((x - dec(enc(x)))^2) of one level; both decoded in one pass (equation 8).

    With `reduction_alone` the regression is left for later, and both are the latter.
    """

    def __init__(
        self, level: LevelNetwork, training: Samples, validation: Samples | None, *, reduction_alone: bool = False
    ) -> None:
        super().__init__()
        self.level, self.reduction_alone = level, reduction_alone
        self.training_samples, self.validation_samples = training, validation
        self.size = len(training)

    @property
    def in_place(self) -> bool:
        return self.training_samples.in_place

    @property
    def scale(self) -> float:
        return self.level.scale

    def networks(self) -> dict[str, nn.Module]:
        return {"level": self.level}

    def pieces(self, batch: int) -> int:
        return pieces((2 if self.staged else 1) * batch, self.level.n_nodes)

    @property
    def staged(self) -> bool:
        trained = [p for p in self.level.parameters() if p.requires_grad]
        large = sum(4 * p.numel() for p in trained if p.device.type == "cpu") > _LARGE
        return large and not self.level.with_initial and _parts_apart(self.level.reduction)

    def stages(self, indices: Tensor, weights: Tensor, pieces: int) -> Iterator[Tensor]:
        """First regression and decoder, from latent vectors that were encoded beforehand, then the encoder."""
        parts = indices.tensor_split(pieces)
        batches = [self.training_samples.batch(part) for part in parts]
        with torch.no_grad():
            encoded = [self.level.encode(x, known) for x, _, known, _ in batches]
        losses = torch.zeros_like(weights)
        for part, batch, z in zip(parts, batches, encoded, strict=True):
            with gradients_in_place():
                of_part = self._decoded(*batch, z.requires_grad_()) * (len(part) / len(indices))
            (of_part * weights).sum().backward()
            losses += of_part.detach()
        yield losses
        for (x, _, known, _), z in zip(batches, encoded, strict=True):
            with gradients_in_place():
                again = self.level.encode(x, known)
            again.backward(z.grad)
        yield torch.zeros_like(losses)

    def forward(self, index: Tensor) -> Tensor:
        return self._losses(self.training_samples, index)

    def validation(self) -> Tensor | None:
        return _averaged(self._losses, self.validation_samples)

    def latents(self) -> tuple[Tensor, Tensor]:
        """Inputs (sample, ..) and encoded states (sample, latent) of the training runs."""
        samples = self.training_samples
        batches = (samples.batch(index) for index in samples.chunks())
        return samples.inputs, torch.cat([self.level.encode(x, known) for x, _, known, _ in batches])

    def latent_sizes(self) -> Tensor:
        """(latent,) RMS movement of the nodes for a latent number that moves by one, about the mean latent vector."""
        z = self.latents()[1]
        middle, spread = z.mean(dim=0), z.std(dim=0).clamp_min(1e-6)
        moved = self.level.decode(torch.cat([middle[None], middle + torch.diag(spread)]))
        return (moved[:, 1:] - moved[:, :1]).square().mean(dim=(0, 2)).sqrt() / spread

    def _losses(self, samples: Samples, index: Tensor) -> Tensor:
        x, inputs, known, initial = samples.batch(index)
        return self._decoded(x, inputs, known, initial, self.level.encode(x, known))

    def _decoded(self, x: Tensor, inputs: Tensor, known: Known, initial: Tensor | None, encoded: Tensor) -> Tensor:
        """The losses (2,) of states that are `encoded`."""
        if self.reduction_alone:
            lost = (self.level.decode(encoded) - x).square().mean().float()
            return torch.stack([lost, lost])
        z = torch.cat([self.level.regress(inputs, known, initial), encoded])
        difference = self.level.decode(z).unflatten(1, (2, len(encoded))) - x[:, None]
        result: Tensor = difference.square().mean(dim=(0, 2, 3)).float()
        return result


class LatentObjective(Objective):
    """The losses of a level with fixed orthogonal modes, from coefficients alone: |x - D z|^2 = rest + |c - s z|^2.

    samples.states holds the scaled coefficients c / s as (sample, 1, latent); `rest` (sample,) what the modes leave.
    """

    def __init__(
        self, level: LevelNetwork, training: Samples, validation: Samples, rest: Tensor, validation_rest: Tensor
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

    @property
    def in_place(self) -> bool:
        return self.training_samples.in_place

    @property
    def scale(self) -> float:
        return self.level.scale

    def networks(self) -> dict[str, nn.Module]:
        return {"level": self.level}

    def forward(self, index: Tensor) -> Tensor:
        return self._losses(self.training_samples, index, self.rest)

    def validation(self) -> Tensor | None:
        return _averaged(lambda s, k: self._losses(s, k, self.validation_rest), self.validation_samples)

    def latents(self) -> tuple[Tensor, Tensor]:
        """As in `LevelObjective`."""
        return self.training_samples.inputs, self.training_samples.in_memory[:, 0]

    def latent_sizes(self) -> Tensor:
        """As in `LevelObjective`."""
        return self.weight.sqrt()

    def _losses(self, samples: Samples, index: Tensor, rest: Tensor) -> Tensor:
        known = Known()
        z = self.level.regress(samples.inputs[index], known)
        wrong = ((samples.in_memory[index, 0] - z).square() @ self.weight).mean()
        left = rest[index].mean()
        return torch.stack([left + wrong, left]).float()


class UnifiedObjective(Objective):
    """The two losses, each averaged over the levels."""

    def __init__(self, network: Unified, training: Samples, validation: Samples | None) -> None:
        super().__init__()
        self.network = network
        self.training_samples, self.validation_samples = training, validation
        self.size = len(training)

    @property
    def in_place(self) -> bool:
        return self.training_samples.in_place

    @property
    def scale(self) -> float:
        return self.network.scale

    def networks(self) -> dict[str, nn.Module]:
        return {"levels": self.network}

    def forward(self, index: Tensor) -> Tensor:
        return self._losses(self.training_samples, index)

    def validation(self) -> Tensor | None:
        return _averaged(self._losses, self.validation_samples)

    def _losses(self, samples: Samples, index: Tensor) -> Tensor:
        x, inputs, _, initial = samples.batch(index)
        z = torch.cat([self.network.regress(inputs, initial), self.network.encode(x)])
        losses = []
        for number, states in self.network.decode_all(z).items():
            difference = states.unflatten(1, (2, len(index))) - self.network.restrict(x, number)[:, None]
            losses.append(difference.square().mean(dim=(0, 2, 3)))
        return torch.stack(losses).mean(dim=0).float()


def _parts_apart(reduction: nn.Module) -> bool:
    """Whether encoder and decoder are known to share no weights."""
    if isinstance(reduction, SumReduction):
        return _parts_apart(reduction.remainder)
    return type(reduction) in (GraphReduction, DenseReduction)


def _averaged(losses: Callable[[Samples, Tensor], Tensor], samples: Samples | None) -> Tensor | None:
    if samples is None or not len(samples):
        return None
    return torch.stack([losses(samples, index) * len(index) for index in samples.chunks()]).sum(dim=0) / len(samples)
