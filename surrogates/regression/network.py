"""Fully connected networks: the regression from parameters and time, and the dense autoencoder."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

_ACTIVATIONS: dict[str, type[nn.Module]] = {"elu": nn.ELU, "gelu": nn.GELU, "silu": nn.SiLU, "tanh": nn.Tanh}


def fully_connected(sizes: Sequence[int], activation: str = "elu", *, linear_end: bool = True) -> nn.Sequential:
    """Linear layers between `sizes`, an activation behind each, behind the last only without `linear_end`."""
    layers: list[nn.Module] = []
    for a, b in pairwise(sizes):
        layers += [nn.Linear(a, b), _ACTIVATIONS[activation]()]
    return nn.Sequential(*(layers[:-1] if linear_end else layers))


class Regressor(nn.Module):
    """(b, inputs [+ coarse latent]) -> z (b, latent): mlp(mu, t), or mlp*(mu, t, mlp_l(mu, t)) of section 3.4.

    residual  the coarse latent vector is also added to the result (to its first entries), and the last layer starts
              at zero, so that training starts at what the coarser level says
    """

    def __init__(
        self,
        inputs: int,
        latent: int,
        widths: Sequence[int],
        activation: str,
        *,
        coarse: int = 0,
        residual: bool = False,
    ) -> None:
        super().__init__()
        self.network = fully_connected((inputs + coarse, *widths, latent), activation)
        self.residual = residual and coarse > 0
        if self.residual:
            last = self.network[-1]
            nn.init.zeros_(last.weight)  # type: ignore[arg-type]
            nn.init.zeros_(last.bias)  # type: ignore[arg-type]

    def forward(self, inputs: Tensor, coarse: Tensor | None = None) -> Tensor:
        if coarse is None:
            alone: Tensor = self.network(inputs)
            return alone
        out: Tensor = self.network(torch.cat([inputs, coarse], dim=1))
        if not self.residual:
            return out
        return out + nn.functional.pad(coarse, (0, out.shape[1] - coarse.shape[1]))
