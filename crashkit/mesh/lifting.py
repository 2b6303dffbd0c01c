"""What a level costs: fine displacements restricted to the kept nodes and lifted back, U D u against u."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crashkit.mesh.levels import Hierarchy
from data_schema.blocks import split_states
from data_schema.finite import all_finite
from data_schema.levels import lift

# Bytes of displacement lifted at once.
_BUDGET = 32 << 20
# Nodes whose distances are worked out at once.
_NODES = 1 << 11


@dataclass(frozen=True)
class LiftingError:
    """|U D u - u|, m: mean over nodes, states and runs, the largest value, and the mean over the nodes of each part."""

    mean: float
    largest: float
    parts: tuple[float, ...] = ()


class LiftingMeter:
    """Adds up the lifting errors of all levels from blocks of displacements, so that runs can be streamed.

    Parameters
    ----------
    parts
        Node numbers of each part; a node that two parts share counts in both.
    """

    def __init__(self, hierarchy: Hierarchy, parts: Sequence[NDArray[np.integer]] = ()) -> None:
        self._levels, self._parts = hierarchy.levels, parts
        self._of_nodes = np.zeros((2, len(self._levels), hierarchy.n_nodes))  # sums, and how many are in them
        self._sum = np.zeros(len(self._levels))
        self._count = np.zeros(len(self._levels))
        self._largest = np.zeros(len(self._levels))

    def add(self, displacement: NDArray[np.floating]) -> None:
        """Take in displacements (state, node of level 0, 3), m. Nodes that are NaN before or after are left out."""
        for begin, end in split_states(len(displacement), displacement.shape[1], _BUDGET):
            block = displacement[begin:end]
            for k, level in enumerate(self._levels):
                error = _distances(lift(level.to_full, block[:, level.kept]), block)
                there = None if all_finite(error) else np.isfinite(error)
                living = error if there is None else error[there]
                if len(self._parts):
                    known = error if there is None else np.where(there, error, 0)
                    self._of_nodes[0, k] += known.sum(axis=0, dtype=np.float64)
                    self._of_nodes[1, k] += len(error) if there is None else there.sum(axis=0)
                self._sum[k] += living.sum(dtype=np.float64)
                self._count[k] += living.size
                self._largest[k] = max(self._largest[k], living.max(initial=0.0))

    @property
    def errors(self) -> list[LiftingError]:
        """One for each level, level 1 first; NaN where nothing was added."""
        counts = np.where(self._count > 0, self._count, np.nan)
        return [
            LiftingError(float(s / c), float(m) if c == c else float("nan"), self._of_parts(k))
            for k, (s, c, m) in enumerate(zip(self._sum, counts, self._largest, strict=True))
        ]

    def _of_parts(self, level: int) -> tuple[float, ...]:
        total, count = self._of_nodes[:, level]
        sums = ((total[nodes].sum(), count[nodes].sum()) for nodes in self._parts)
        return tuple(float(s / c) if c else float("nan") for s, c in sums)


def _distances(lifted: NDArray[np.floating], displacement: NDArray[np.floating]) -> NDArray[np.floating]:
    """(state, node) between fields (state, node, 3), of which the first lies node by node in memory.

    Some nodes at a time, which are put state by state within the processor's cache: a quarter of the time.
    """
    out = np.empty(lifted.shape[:2], np.result_type(lifted, displacement))
    for first in range(0, out.shape[1], _NODES):
        nodes = slice(first, first + _NODES)
        apart = np.array(lifted[:, nodes], out.dtype, order="C")
        apart -= displacement[:, nodes]
        out[:, nodes] = np.sqrt(np.einsum("snx,snx->sn", apart, apart))
    return out
