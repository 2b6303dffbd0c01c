"""Fully connected networks: the regression from parameters and time, and the dense autoencoder."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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


class Team(nn.Module):
    """Several networks of one shape, each with its own weights, computed in one pass: (member or 1, b, in) -> (member, b, out).

    weight_0 (member, in, out) and bias_0 (member, 1, out) are the first layer's, and so on; started as torch.nn.Linear.
    """

    def __init__(self, members: int, sizes: Sequence[int], activation: str = "elu") -> None:
        super().__init__()
        self.members, self.depth = members, len(sizes) - 1
        self.activation = _ACTIVATIONS[activation]()
        for k, (a, b) in enumerate(pairwise(sizes)):
            bound = 1 / math.sqrt(a)
            for name, shape in ((f"weight_{k}", (members, a, b)), (f"bias_{k}", (members, 1, b))):
                self.register_parameter(name, nn.Parameter(torch.empty(shape).uniform_(-bound, bound)))

    def forward(self, x: Tensor, some: slice = slice(None)) -> Tensor:
        """`some`: the members that are asked; all by default."""
        for k in range(self.depth):
            weight, bias = self.get_parameter(f"weight_{k}")[some], self.get_parameter(f"bias_{k}")[some]
            x = torch.baddbmm(bias, x.expand(len(weight), -1, -1), weight)
            if k < self.depth - 1:
                x = self.activation(x)
        return x

    def end_at_zero(self) -> None:
        """Give zero, until training moves it."""
        for name in (f"weight_{self.depth - 1}", f"bias_{self.depth - 1}"):
            nn.init.zeros_(self.get_parameter(name))

    def first(self, other: Team, start: int) -> None:
        """Take over the weights of as many networks of `other`, from `start` on."""
        with torch.no_grad():
            for name, mine in self.named_parameters():
                mine.copy_(other.get_parameter(name)[start : start + self.members])


class Course(nn.Module):
    """What every run goes through, and how far runs have come apart by then, by the scaled time.

    With it a regression gives z = mean(t) + growth(t) * network: what all training runs do is known without training, and
    where they all start alike (growth 0), as from rest, so does every prediction.

    time    (state,) scaled, increasing
    mean    (state, latent); growth (state,), from 0 or more to 1. Linear in between, held outside
    """

    time: Tensor
    mean: Tensor
    growth: Tensor

    def __init__(self, states: int, latent: int) -> None:
        super().__init__()
        for name, shape in (("time", (states,)), ("mean", (states, latent)), ("growth", (states,))):
            self.register_buffer(name, torch.zeros(shape))

    def forward(self, time: Tensor) -> tuple[Tensor, Tensor]:
        """Mean (b, latent) and growth (b, 1) at scaled times (b,)."""
        if len(self.time) == 1:
            return self.mean.expand(len(time), -1), self.growth.expand(len(time))[:, None]
        time = time.clamp(self.time[0], self.time[-1])
        place = (time[:, None] >= self.time[1:-1]).sum(dim=1)
        start, end = self.time[place], self.time[place + 1]
        share = ((time - start) / (end - start))[:, None]
        growth = self.growth[:, None]
        return torch.lerp(self.mean[place], self.mean[place + 1], share), torch.lerp(
            growth[place], growth[place + 1], share
        )

    @classmethod
    def of(cls, time: Tensor, mean: Tensor, spread: Tensor) -> Course:
        """From the mean course (state, latent), and how far runs are apart from it in each state (state,)."""
        out = cls(len(time), mean.shape[1])
        growth = torch.cummax(spread, dim=0).values
        top = float(growth[-1])
        out.time.copy_(time)
        out.mean.copy_(mean)
        out.growth.copy_(torch.where(growth > _APART * top, growth / (top or 1.0), torch.zeros_like(growth)))
        return out

    @classmethod
    def like(cls, tensors: Mapping[str, Tensor]) -> Course:
        """An empty one with room for stored `tensors`."""
        return cls(*tensors["mean"].shape)


# Share of their largest distance below which runs are alike: rounding.
_APART = 1e-6


class Regressor(nn.Module):
    """(b, inputs [+ coarse latent]) -> z (b, latent): mlp(mu, t), or mlp*(mu, t, mlp_l(mu, t)) of section 3.4.

    residual  the coarse latent vector is also added to the result (to its first entries), and the last layer starts
              at zero, so that training starts at what the coarser level says
    members   networks whose mean it is; they start differently, and their errors partly cancel
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
        members: int = 1,
    ) -> None:
        super().__init__()
        self.members, self.latent = members, latent
        self.sizes, self.activation = (inputs + coarse, *widths, latent), activation
        self.network = fully_connected(self.sizes, activation) if members == 1 else self.team(members)
        self.residual = residual and coarse > 0
        if self.residual and isinstance(self.network, Team):
            self.network.end_at_zero()
        elif self.residual:
            for parameter in self.network[-1].parameters():  # type: ignore[index]
                nn.init.zeros_(parameter)

    def team(self, members: int) -> Team:
        """Untrained networks of the same shape."""
        return Team(members, self.sizes, self.activation)

    def take(self, team: Team, start: int) -> None:
        """Take over the weights of the networks `start`, `start` + 1, .. of a team of the same shape."""
        if isinstance(self.network, Team):
            self.network.first(team, start)
            return
        layers = [layer for layer in self.network if isinstance(layer, nn.Linear)]
        with torch.no_grad():
            for k, layer in enumerate(layers):
                layer.weight.copy_(team.get_parameter(f"weight_{k}")[start].T)
                layer.bias.copy_(team.get_parameter(f"bias_{k}")[start, 0])

    def forward(
        self, inputs: Tensor, coarse: Tensor | None = None, course: tuple[Tensor, Tensor] | None = None
    ) -> Tensor:
        """`course`: mean and growth of a `Course` at the samples' times."""
        x = inputs if coarse is None else torch.cat([inputs, coarse], dim=1)
        out: Tensor = self.network(x[None]).mean(dim=0) if isinstance(self.network, Team) else self.network(x)
        if course is not None:
            mean, growth = course
            out = torch.addcmul(mean, growth, out)
        if coarse is None or not self.residual:
            return out
        return out + nn.functional.pad(coarse, (0, self.latent - coarse.shape[1]))
