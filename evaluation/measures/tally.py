"""Errors of one field of a run, gathered a few states at a time, so that no second run is ever in memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from evaluation.measures.distance import (
    Peak,
    group_means,
    largest_node_error,
    masked_mean,
    mean_node_error,
    node_distance,
    peak_error,
    quantile_node_error,
)

Groups = Mapping[str, Sequence[NDArray[np.integer]]]

# Bytes of one float32 field handled at once; a dozen float64 arrays of its size come and go.
_BLOCK = 24 << 20


def state_blocks(states: int, nodes: int) -> Iterator[slice]:
    """Slices of states that are small enough to work on in one piece."""
    step = max(1, _BLOCK // (12 * nodes))
    for first in range(0, states, step):
        yield slice(first, min(first + step, states))


@dataclass
class Tally:
    """Feed blocks of states with `add`; every number is that of the whole run (see
    evaluation.comparison.scoring.RunScore).

    Attributes
    ----------
    groups
        Grouping -> node numbers of each group.
    """

    groups: Groups
    n_nodes: int
    _rows: dict[str, list[NDArray[np.float64]]] = field(default_factory=dict)
    _squares: float = 0.0
    _sizes: float = 0.0
    _states: int = 0
    _peak: Peak | None = None

    def __post_init__(self) -> None:
        self.node_sum = np.zeros(self.n_nodes)
        self.node_count = np.zeros(self.n_nodes, np.int64)

    def add(self, truth: NDArray[np.floating], prediction: NDArray[np.floating]) -> None:
        """The next states: (state, node, 3) displacements, m."""
        distance = node_distance(truth, prediction)
        there = ~np.isnan(distance)
        rows = {
            "e2": mean_node_error(distance),
            "q95": quantile_node_error(distance, 0.95),
            "largest": largest_node_error(distance),
            **{f"group {name}": group_means(distance, nodes) for name, nodes in self.groups.items()},
        }
        for name, values in rows.items():
            self._rows.setdefault(name, []).append(values)
        if there.any():
            peak = peak_error(distance)
            if self._peak is None or peak.value > self._peak.value:
                self._peak = Peak(peak.value, peak.state + self._states, peak.node)
        self._squares += float(np.square(distance[there]).sum())
        self._sizes += sum(float(np.square(truth[..., k], dtype=np.float64)[there].sum()) for k in range(3))
        self.node_sum += np.where(there, distance, 0).sum(axis=0)
        self.node_count += there.sum(axis=0)
        self._states += len(truth)

    def over_time(self, name: str) -> NDArray[np.float64]:
        """(state,) m: "e2", "q95" or "largest"."""
        return np.concatenate(self._rows[name])

    def of_groups(self, name: str) -> NDArray[np.float64]:
        """(group,) m: mean over time of the mean node error within each group (measures.group_error)."""
        return masked_mean(np.concatenate(self._rows[f"group {name}"]), axis=0)

    @property
    def relative(self) -> float:
        """measures.relative_error of the run."""
        return float(np.sqrt(self._squares / self._sizes)) if self._sizes > 0 else float("nan")

    @property
    def peak(self) -> Peak:
        """measures.peak_error of the run; NaN at -1 where no node was ever there."""
        return self._peak or Peak(float("nan"), -1, -1)
