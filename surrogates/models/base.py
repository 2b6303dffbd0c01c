"""What all surrogates made of networks have in common."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from surrogates.data.scaling import InputScaling
from surrogates.errors import SurrogateError


class Network(nn.Module):
    """Displacements of several levels from parameters and time; subclasses say how.

    States in and out are (node, b, 3), m.
    """

    def __init__(self, inputs: InputScaling) -> None:
        super().__init__()
        self.inputs = inputs

    @property
    def numbers(self) -> tuple[int, ...]:
        """Mesh levels it predicts on, coarsest first."""
        raise NotImplementedError

    @property
    def scales(self) -> dict[int, float]:
        """The unit of each level's states, m."""
        raise NotImplementedError

    def latent(self, number: int) -> int:
        """Length of the level's latent vector."""
        raise NotImplementedError

    def forward(self, parameters: Tensor, time: Tensor, number: int) -> Tensor:
        """Displacements of level `number` for parameters (b, p) and time (b,), s."""
        raise NotImplementedError

    def from_coarse(self, parameters: Tensor, time: Tensor, number: int, seen: Tensor) -> Tensor:
        """As `forward`, from a coarse run of the query: `seen` (b, latent) is what it encodes as on the level."""
        raise NotImplementedError

    def takes_coarse(self, number: int) -> bool:
        """Whether level `number` takes anything from a coarse run of the query."""
        return False

    def encode_metres(self, x: Tensor, number: int) -> Tensor:
        """States of level `number`, m -> latent vectors (b, latent)."""
        raise NotImplementedError

    def reconstruct(self, x: Tensor, number: int) -> Tensor:
        """Encode and decode."""
        raise NotImplementedError

    def n_parameters(self, number: int) -> int:
        """Numbers behind a prediction of the level, those of the coarser ones it needs included."""
        raise NotImplementedError

    def tensors(self) -> dict[str, dict[str, Tensor]]:
        """What has to be stored, by file."""
        raise NotImplementedError


def in_metres(states: Tensor, scale: float) -> Tensor:
    """`states` times `scale`, in place where no gradient is wanted: a run of the full mesh is not held twice."""
    return states * scale if torch.is_grad_enabled() else states.mul_(scale)


def take_over(mine: Mapping[str, Tensor], given: Mapping[str, Tensor]) -> None:
    """Copy `given` into the live tensors `mine`; raises SurrogateError naming one that is missing or of another shape."""
    for name in sorted(mine.keys() | given.keys()):
        if name not in given:
            raise SurrogateError(f"tensor {name} is missing from the stored weights")
        if name not in mine:
            raise SurrogateError(f"tensor {name} is in the stored weights, but the model has none of that name")
        if mine[name].shape != given[name].shape:
            raise SurrogateError(
                f"tensor {name} is stored as {tuple(given[name].shape)}; the model needs {tuple(mine[name].shape)}"
            )
    with torch.no_grad():
        for name, tensor in mine.items():
            tensor.copy_(given[name])
