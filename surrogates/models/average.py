"""The mean of several trainings of one network that differ by their seed alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from surrogates.models.base import Network

# States over which the spread of the members is taken, at most: they hang together.
_STATES = 8


class Average(Network):
    """Predicts, reconstructs and is stored as its members are; every answer is the mean of theirs.

    members  networks on the same levels, each with its own weights
    seeds    (member,) what each was trained with
    floor    m: what is added, as the root of squares, to how far the members lie apart, so that a band that follows it
             is nowhere zero
    """

    def __init__(self, members: Sequence[Network], seeds: Sequence[int], floor: float = 1.0) -> None:
        super().__init__(members[0].inputs)
        self.members = nn.ModuleList(members)
        self.seeds = tuple(seeds)
        self.floor = floor

    @property
    def networks(self) -> list[Network]:
        """The members."""
        return list(self.members)  # type: ignore[arg-type]

    @property
    def numbers(self) -> tuple[int, ...]:
        return self.networks[0].numbers

    @property
    def scales(self) -> dict[int, float]:
        return self.networks[0].scales

    def latent(self, number: int) -> int:
        return sum(member.latent(number) for member in self.networks)

    def forward(self, parameters: Tensor, time: Tensor, number: int) -> Tensor:
        return _mean([member(parameters, time, number) for member in self.networks])

    def from_coarse(self, parameters: Tensor, time: Tensor, number: int, seen: Tensor) -> Tensor:
        parts = seen.split([member.latent(number) for member in self.networks], dim=1)
        return _mean([m.from_coarse(parameters, time, number, z) for m, z in zip(self.networks, parts, strict=True)])

    def takes_coarse(self, number: int) -> bool:
        return any(member.takes_coarse(number) for member in self.networks)

    def encode_metres(self, x: Tensor, number: int) -> Tensor:
        """The latent vectors of the members side by side."""
        return torch.cat([member.encode_metres(x, number) for member in self.networks], dim=1)

    def reconstruct(self, x: Tensor, number: int) -> Tensor:
        return _mean([member.reconstruct(x, number) for member in self.networks])

    def n_parameters(self, number: int) -> int:
        return sum(member.n_parameters(number) for member in self.networks)

    def tensors(self) -> dict[str, dict[str, Tensor]]:
        """Files named by seed, such as seed_3.level_2."""
        named = zip(self.seeds, self.networks, strict=True)
        return {f"seed_{seed}.{stem}": kept for seed, member in named for stem, kept in member.tensors().items()}

    def deviation(self, spread: NDArray[np.float64]) -> NDArray[np.float64]:
        """What a band follows, m, where the members lie `spread` (run,), m, apart."""
        return np.hypot(spread, self.floor)


def _mean(states: Sequence[Tensor]) -> Tensor:
    out = states[0]
    for more in states[1:]:
        out = out + more
    return out / len(states)


def some_states(count: int) -> NDArray[np.int64]:
    """Places of the states, of `count`, over which the spread of members is taken."""
    return np.unique(np.linspace(0, count - 1, _STATES).astype(int))


def spread_of(said: Sequence[NDArray[np.float32]]) -> float:
    """RMS distance, m, of what members say (state, node, 3) from their mean, over members, states and nodes."""
    values = np.stack(said)
    return float(np.sqrt(np.square(values - values.mean(axis=0)).sum(axis=-1, dtype=np.float64).mean()))
