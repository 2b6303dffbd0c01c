"""Errors of one field of a run, gathered a few states at a time, so that no second run is ever in memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from data_schema.blocks import split_states
from evaluation.measures.distance import (
    Peak,
    compared,
    group_means,
    largest_node_error,
    masked_mean,
    mean_node_error,
    peak_error,
    quantile_node_error,
)

Groups = Mapping[str, Sequence[NDArray[np.integer]]]

# Bytes of one float32 field handled at once; a few arrays of its size come and go.
_BLOCK = 16 << 20


def state_blocks(states: int, nodes: int) -> Iterator[slice]:
    """Slices of states that are small enough to work on in one piece."""
    return (slice(first, end) for first, end in split_states(states, nodes, _BLOCK))


@dataclass(frozen=True)
class Gathering:
    """Groups as the maps that take the mean of each: made once, used for every block of every field.

    Attributes
    ----------
    means
        Grouping -> csr (group, node), rows sum to one.
    """

    groups: Groups
    means: Mapping[str, sparse.csr_matrix]

    @classmethod
    def of(cls, groups: Groups, n_nodes: int) -> Gathering:
        """The maps of groups of the numbers of `n_nodes` nodes."""
        return cls(groups, {name: _mean_map(nodes, n_nodes) for name, nodes in groups.items()})

    def only(self, *names: str) -> Gathering:
        """Some of the groupings."""
        return Gathering({n: self.groups[n] for n in names}, {n: self.means[n] for n in names})

    def of_distance(self, distance: NDArray[np.float64], whole: bool) -> dict[str, NDArray[np.float64]]:
        """Grouping -> (state, group) m: the mean of `distance` (state, node) in each; `whole`: no node is gone."""
        if not whole:
            return {name: group_means(distance, nodes) for name, nodes in self.groups.items()}
        out = {name: np.stack([means @ row for row in distance]) for name, means in self.means.items()}
        for name, values in out.items():
            values[:, [len(nodes) == 0 for nodes in self.groups[name]]] = np.nan
        return out


def _mean_map(groups: Sequence[NDArray[np.integer]], n_nodes: int) -> sparse.csr_matrix:
    sizes = np.array([len(nodes) for nodes in groups], np.int64)
    columns = np.concatenate([np.asarray(nodes, np.int64) for nodes in groups]) if len(groups) else np.zeros(0, int)
    weights = np.repeat(1 / np.maximum(sizes, 1), sizes)
    return sparse.csr_matrix((weights, columns, np.append(0, np.cumsum(sizes))), (len(groups), n_nodes))


@dataclass
class Tally:
    """Feed blocks of states with `add`; every number is that of the whole run (see
    evaluation.comparison.scoring.RunScore).

    Attributes
    ----------
    groups
        Grouping -> node numbers of each group, or these as they were gathered once.
    brief
        Leave out what takes sorting: the quantile.
    """

    groups: Groups | Gathering
    n_nodes: int
    brief: bool = False
    _rows: dict[str, list[NDArray[np.float64]]] = field(default_factory=dict)
    _squares: float = 0.0
    _sizes: float = 0.0
    _states: int = 0
    _peak: Peak | None = None

    def __post_init__(self) -> None:
        self._gathering = self.groups if isinstance(self.groups, Gathering) else Gathering.of(self.groups, self.n_nodes)
        self.node_sum = np.zeros(self.n_nodes)
        self.node_count = np.zeros(self.n_nodes, np.int64)

    def add(self, truth: NDArray[np.floating], prediction: NDArray[np.floating]) -> NDArray[np.float64]:
        """The next states: (state, node, 3) displacements, m; gives their distances (state, node), m."""
        distance, squares, sizes = compared(truth, prediction)
        whole = not bool(np.isnan(distance.sum()))
        rows = {
            "e2": distance.mean(axis=1) if whole else mean_node_error(distance),
            "largest": distance.max(axis=1) if whole else largest_node_error(distance),
            **{f"group {name}": rows for name, rows in self._gathering.of_distance(distance, whole).items()},
        }
        if not self.brief:
            rows["q95"] = quantile_node_error(distance, 0.95)
        for name, values in rows.items():
            self._rows.setdefault(name, []).append(values)
        if whole or not np.isnan(distance).all():
            peak = peak_error(distance)
            if self._peak is None or peak.value > self._peak.value:
                self._peak = Peak(peak.value, peak.state + self._states, peak.node)
        self._squares += squares
        self._sizes += sizes
        self.node_sum += distance.sum(axis=0) if whole else np.nansum(distance, axis=0)
        self.node_count += len(distance) if whole else (~np.isnan(distance)).sum(axis=0)
        self._states += len(truth)
        return distance

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
