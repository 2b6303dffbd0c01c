"""The graphs a surrogate works on, by level number, and the maps between any two of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from data_schema.levels import Level
from surrogates.data.campaign import Campaign
from surrogates.errors import SurrogateError


@dataclass(frozen=True)
class Graphs:
    """Level 0 is the full mesh with `n_full` nodes; `levels` holds the coarser ones, level 1 first."""

    n_full: int
    levels: tuple[Level, ...] = ()
    full_edges: NDArray[np.int32] | None = None

    @classmethod
    def of(cls, campaign: Campaign) -> Graphs:
        """The graphs of a campaign, checked against each other."""
        graphs = cls(campaign.n_nodes, tuple(campaign.levels), campaign.full_edges)
        for k, level in enumerate(graphs.levels, 1):
            finer, n = graphs.n_nodes(k - 1), level.n_nodes
            if level.to_finer.shape != (finer, n) or len(level.in_finer) != n or level.in_finer.max() >= finer:
                raise SurrogateError(
                    f"level {k} maps {level.to_finer.shape}; expected {n} nodes on {finer} of level {k - 1}. Coarsen the dataset again"
                )
        return graphs

    def __getitem__(self, number: int) -> Level:
        if not 1 <= number <= len(self.levels):
            has = f"levels 1 to {len(self.levels)}" if self.levels else "no coarse level"
            raise SurrogateError(f"level {number} was asked for; the mesh hierarchy has {has}")
        return self.levels[number - 1]

    def n_nodes(self, number: int) -> int:
        return self.n_full if number == 0 else self[number].n_nodes

    def edges(self, number: int) -> NDArray[np.int32] | None:
        """(e, 2); None on the full mesh where the data has none."""
        return self[number].edges if number else self.full_edges

    def kept(self, number: int) -> NDArray[np.int64]:
        """Nodes of the level as nodes of level 0."""
        return np.arange(self.n_full) if number == 0 else self[number].kept

    def to_full(self, number: int) -> sparse.csr_matrix:
        """U from the level straight to level 0."""
        return sparse.identity(self.n_full, format="csr") if number == 0 else self[number].to_full

    def places(self, coarse: int, fine: int) -> NDArray[np.int64]:
        """D: places of the coarse level's nodes among those of the finer one."""
        out = self[coarse].in_finer
        for number in range(coarse - 1, fine, -1):
            out = self[number].in_finer[out]
        return out

    def upsampling(self, coarse: int, fine: int) -> sparse.csr_matrix:
        """U from a coarse level to a finer one."""
        out = self[coarse].to_finer
        for number in range(coarse - 1, fine, -1):
            out = self[number].to_finer @ out
        return sparse.csr_matrix(out)
