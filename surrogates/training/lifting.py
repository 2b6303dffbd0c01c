"""The map from a level to the full mesh, learnt from training runs where folds show that it is better than the static one.

The static map U gives a node the corners of the triangle it lies on. A learnt row is a weighted sum of the level's nodes
around that triangle. Its weights sum to one, so that a translation stays one, and are the least squares over the
training runs, drawn to the static ones:

    min over w of  sum over states and xyz of (u_i - w' u_near)^2 + pull * size^2 * |w - U_i|^2,  sum of w = 1

How strongly they are drawn is chosen by runs left out, for all nodes of a level alike. A kept node is itself in both.
All sums are taken once for each fold, so that a choice costs no further reading.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from surrogates.data.graphs import Graphs
from surrogates.data.samples import LevelRuns

_log = logging.getLogger(__name__)

# How many level nodes a row may have, and within how many edges of the static ones they lie.
_NEAR, _RINGS = 16, 2
# Strengths that are tried, as shares of the mean square displacement.
PULLS = (1e-4, 1e-3, 1e-2, 1e-1)
# What is left of the static map's error at most, for a learnt one to be kept.
_WORTH_IT = 0.95
# Nodes of the full mesh and of a level up to which it is tried: what a finer level has to gain is small.
_LARGEST, _LARGEST_LEVEL = 100_000, 1536
# States of a run that are read, fewest runs, nodes handled at once, and by how many nodes a strength is chosen.
_STATES, _FEWEST, _ROWS, _JUDGED = 34, 4, 4096, 4096


@dataclass(frozen=True)
class Lifts:
    """Maps (node of the full mesh, node of a level) by level number.

    Attributes
    ----------
    maps
        Of the levels whose learnt map is kept.
    left_out
        Of these, without the runs of each fold.
    errors
        Of every level that was tried: RMS distance, m, over runs left out, of the static map and of the learnt one.
    part
        (run,) the fold that leaves a run out; -1: none, as for runs that nothing was learnt from.
    """

    maps: dict[int, sparse.csr_matrix]
    left_out: dict[int, list[sparse.csr_matrix]]
    errors: dict[int, tuple[float, float]]
    part: NDArray[np.int64]

    def without(self, run: int, number: int) -> sparse.csr_matrix | None:
        """The map of a level that was learnt without a run; None where the static one is kept."""
        if number not in self.maps:
            return None
        return self.maps[number] if self.part[run] < 0 else self.left_out[number][self.part[run]]

    def put_on(self, graphs: Graphs) -> Graphs:
        """The graphs with the learnt maps."""
        levels = [
            replace(level, to_full=self.maps[level.index]) if level.index in self.maps else level
            for level in graphs.levels
        ]
        return replace(graphs, levels=tuple(levels))

    def told(self, number: int) -> str:
        """What was chosen for a level, in words; empty where nothing was tried."""
        if number not in self.errors:
            return ""
        static, learnt = (100 * e for e in self.errors[number])
        kept = "learnt" if number in self.maps else "barycentric"
        return (
            f"{kept} map to the full mesh (RMS on runs left out: barycentric {static:.3f} cm, learnt {learnt:.3f} cm)"
        )


def learn_lifts(
    full: LevelRuns,
    graphs: Graphs,
    numbers: Sequence[int],
    part: NDArray[np.int64],
    training: NDArray[np.int64],
    points: NDArray[np.float64],
    known: NDArray[np.bool_] | None = None,
) -> Lifts:
    """Learn the maps of levels `numbers` to the full mesh.

    Parameters
    ----------
    full
        The displacements of the full mesh; each training run is read once.
    part, training
        (run,) the fold that leaves a run out, -1 for none; and the runs to learn from.
    points
        (node, 3) of the full mesh, m.
    known
        (run, state) which states were computed; None: all.
    """
    tried = [k for k in numbers if k > 0 and graphs.n_nodes(k) <= _LARGEST_LEVEL and graphs.n_full <= _LARGEST]
    folds = [training[part[training] == k] for k in range(int(part[training].max(initial=-1)) + 1)]
    if not tried or len(training) < _FEWEST or sum(map(bool, map(len, folds))) < 2:
        return Lifts({}, {}, {}, part)
    _log.info("maps from the levels to the full mesh")
    searches = {k: _Search(graphs, k, points) for k in tried}
    rest = training[part[training] < 0]  # never left out: behind the folds, and in every map
    for runs in [*folds, rest]:
        for search in searches.values():
            search.begin()
        for rows in _states(full, runs, known):
            for search in searches.values():
                search.add(rows)
    maps, left_out, errors = {}, {}, {}
    for k, search in searches.items():
        errors[k], pull = search.chosen()
        if errors[k][1] < _WORTH_IT * errors[k][0]:
            maps[k], left_out[k] = search.map(pull), [search.map(pull, without=f) for f in range(len(folds))]
    return Lifts(maps, left_out, errors, part)


def _states(full: LevelRuns, runs: NDArray[np.int64], known: NDArray[np.bool_] | None) -> Iterator[NDArray[np.float32]]:
    """Of each run (3 * state, node): some of its states, one direction after the other."""
    for run in runs:
        values = full.read(int(run))
        there = np.arange(len(values)) if known is None else np.flatnonzero(known[run])
        some = there[np.unique(np.linspace(0, len(there) - 1, min(_STATES, len(there))).round().astype(int))]
        yield np.ascontiguousarray(values[some].transpose(0, 2, 1)).reshape(-1, values.shape[1])


class _Search:
    """The sums of one level by fold: squares of the nodes, products with their neighbours, and of level nodes."""

    def __init__(self, graphs: Graphs, number: int, points: NDArray[np.float64]) -> None:
        level = graphs[number]
        self.kept, self.static = level.kept, sparse.csr_matrix(level.to_full)
        self.near, self.start = _around(self.static, level.adjacency, points, points[level.kept])
        # A kept node is itself, to the last digit.
        self.near[self.kept, 1:], self.start[self.kept, 1:] = -1, 0.0
        self.near[self.kept, 0], self.start[self.kept, 0] = np.arange(len(self.kept)), 1.0
        self.squares: list[NDArray[np.float64]] = []
        self.with_near: list[NDArray[np.float64]] = []
        self.among: list[NDArray[np.float64]] = []
        self.count: list[int] = []

    def begin(self) -> None:
        kept = len(self.kept)
        self.squares.append(np.zeros(len(self.near)))
        self.with_near.append(np.zeros(self.near.shape))
        self.among.append(np.zeros((kept, kept)))
        self.count.append(0)

    def add(self, rows: NDArray[np.float32]) -> None:
        on_level = np.ascontiguousarray(rows[:, self.kept].T)
        self.squares[-1] += np.square(rows, dtype=np.float64).sum(axis=0)
        self.among[-1] += on_level @ on_level.T
        self.count[-1] += len(rows)
        for first in range(0, len(self.near), _ROWS):
            some = slice(first, first + _ROWS)
            place = np.maximum(self.near[some], 0)
            self.with_near[-1][some] += (on_level @ rows[:, some])[place, np.arange(len(place))[:, None]]

    def chosen(self) -> tuple[tuple[float, float], float]:
        """RMS distances over the folds of the static map and of the best learnt one, and the strength of that; by some nodes."""
        nodes = np.unique(np.linspace(0, len(self.near) - 1, min(_JUDGED, len(self.near))).astype(int))
        folds = [k for k in range(len(self.count) - 1) if self.count[k]]
        static = sum(self._missed(self.start[nodes], nodes, k) for k in folds)
        missed = {pull: sum(self._missed(self._weights(pull, nodes, k), nodes, k) for k in folds) for pull in PULLS}
        best = min(missed, key=lambda pull: missed[pull])
        states = sum(self.count[k] for k in folds) / 3 * len(nodes)
        return (np.sqrt(static / states), np.sqrt(missed[best] / states)), best

    def map(self, pull: float, without: int | None = None) -> sparse.csr_matrix:
        """The learnt map from all runs, or without those of a fold."""
        weights = self._weights(pull, np.arange(len(self.near)), without)
        there = self.near >= 0
        row = np.repeat(np.arange(len(self.near)), there.sum(axis=1))
        out = sparse.csr_matrix((weights[there], (row, self.near[there])), shape=self.static.shape)
        out.eliminate_zeros()
        return out

    def _weights(self, pull: float, nodes: NDArray[np.int64], without: int | None) -> NDArray[np.float64]:
        """(node, near) of least squares for some nodes over all runs but those of the fold `without`."""
        used = [k for k in range(len(self.count)) if k != without]
        among = np.sum([self.among[k] for k in used], axis=0)
        draw = pull * float(np.trace(among)) / len(among)
        out = self.start[nodes]
        if draw <= 0:
            return out
        for first in range(0, len(nodes), _ROWS):
            some = nodes[first : first + _ROWS]
            products = np.sum([self.with_near[k][some] for k in used], axis=0)
            out[first : first + _ROWS] += _change(self.near[some], self.start[some], among, products, draw)
        return out

    def _missed(self, weights: NDArray[np.float64], nodes: NDArray[np.int64], fold: int) -> float:
        """Squares of what a map misses on the runs of a fold, summed over nodes, states and directions, m^2."""
        place = np.maximum(self.near[nodes], 0)
        inner = np.einsum("ij,ijk,ik->i", weights, self.among[fold][place[:, :, None], place[:, None, :]], weights)
        missed = self.squares[fold][nodes] - 2 * (weights * self.with_near[fold][nodes]).sum(axis=1) + inner
        return float(np.maximum(missed, 0.0).sum())


def _change(
    near: NDArray[np.int64], start: NDArray[np.float64], among: NDArray[np.float64], with_near: NDArray[np.float64],
    draw: float,
) -> NDArray[np.float64]:  # fmt: skip
    """(row, near): what the weights gain on the static ones; its sum over a row is zero."""
    there, place = near >= 0, np.maximum(near, 0)
    both = there[:, :, None] & there[:, None, :]
    inner = np.where(both, among[place[:, :, None], place[:, None, :]], 0.0)
    count = near.shape[1]
    system = np.zeros((len(near), count + 1, count + 1))
    system[:, :count, :count] = inner + draw * np.eye(count)
    system[:, count, :count] = system[:, :count, count] = draw * there  # in the size of the others, for the solver
    right = np.zeros((len(near), count + 1, 1))
    right[:, :count, 0] = np.where(there, with_near - np.einsum("ijk,ik->ij", inner, start), 0.0)
    return np.asarray(np.linalg.solve(system, right)[:, :count, 0] * there)


def _around(
    static: sparse.csr_matrix, adjacency: sparse.csr_matrix, points: NDArray[np.float64], on_level: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(node, near) level nodes of each node, -1 where it has fewer, and the static weights of these.

    Those of the static map come first, then the nearest within some edges of them: a part is not left where the static map
    and the graph do not leave it.
    """
    reach = (static != 0).astype(np.int32)
    step = (adjacency + sparse.identity(adjacency.shape[0])).astype(np.int32)
    for _ in range(_RINGS):
        reach = ((reach @ step) != 0).astype(np.int32)
    reach = sparse.csr_matrix(reach + (static != 0).astype(np.int32))
    row = np.repeat(np.arange(reach.shape[0]), np.diff(reach.indptr))
    away = np.linalg.norm(points[row] - on_level[reach.indices], axis=1)
    own = np.asarray(static[row, reach.indices]).ravel()
    order = np.lexsort((away, own == 0, row))
    place = np.arange(len(row)) - np.repeat(reach.indptr[:-1], np.diff(reach.indptr))
    width = max(_NEAR, int(np.diff(static.indptr).max(initial=1)))
    kept = place < width
    near = np.full((reach.shape[0], min(width, int(place.max(initial=0)) + 1)), -1, np.int64)
    start = np.zeros(near.shape)
    near[row[kept], place[kept]] = reach.indices[order][kept]
    start[row[kept], place[kept]] = own[order][kept]
    return near, start
