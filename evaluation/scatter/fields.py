"""Mean, deviation and probability of every node over many draws, of which a few are in memory at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class FieldTally:
    """Sums over draws about a nominal field, so that small differences of large numbers stay exact.

    Attributes
    ----------
    nominal
        (state, node, 3), m: what is taken off first.
    count
        Draws so far.
    """

    def __init__(self, nominal: NDArray[np.floating]) -> None:
        self.nominal = np.asarray(nominal, np.float32)
        self.count = 0
        self._sum = np.zeros(self.nominal.shape)
        self._squares = np.zeros(self.nominal.shape[:2])

    def add(self, states: NDArray[np.floating]) -> None:
        """Further draws (draw, state, node, 3), m."""
        for one in states:
            away = one - self.nominal
            self._sum += away
            self._squares += np.einsum("snx,snx->sn", away, away)
        self.count += len(states)

    @property
    def mean(self) -> NDArray[np.float32]:
        """(state, node, 3) m."""
        return np.asarray(self.nominal + self._sum / max(self.count, 1), np.float32)

    @property
    def deviation(self) -> NDArray[np.float32]:
        """(state, node) m: root of the mean squared distance from the mean."""
        n = max(self.count, 1)
        shift = self._sum / n
        variance = self._squares / n - np.einsum("snx,snx->sn", shift, shift)
        return np.asarray(np.sqrt(np.maximum(variance, 0) * n / max(n - 1, 1)), np.float32)


class Exceedance:
    """How often each node breaks a limit, by state and at any time.

    Attributes
    ----------
    nodes
        Nodes that the limit speaks of; None: all.
    """

    def __init__(self, states: int, size: int, nodes: NDArray[np.int64] | None = None) -> None:
        self.size, self.nodes, self.count = size, nodes, 0
        self._broken = np.zeros((states, size if nodes is None else len(nodes)), np.int64)
        self._ever = np.zeros(self._broken.shape[1], np.int64)

    def add(self, broken: NDArray[np.bool_]) -> None:
        """Further draws (draw, state, node) of which the limit is broken."""
        self._broken += broken.sum(axis=0)
        self._ever += broken.any(axis=1).sum(axis=0)
        self.count += len(broken)

    @property
    def probability(self) -> NDArray[np.float32]:
        """(state, node of the mesh); NaN where the limit says nothing."""
        return self._placed(self._broken / max(self.count, 1))

    @property
    def ever(self) -> NDArray[np.float32]:
        """(node of the mesh,): that it is broken at any time."""
        return np.asarray(self._placed(self._ever[None] / max(self.count, 1))[0])

    def _placed(self, values: Floats) -> NDArray[np.float32]:
        if self.nodes is None:
            return np.asarray(values, np.float32)
        out = np.full((len(values), self.size), np.nan, np.float32)
        out[:, self.nodes] = values
        return out
