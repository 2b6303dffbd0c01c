"""Adaptive refinement: a finer level only where the coarser one is wrong (section 3.5).

The coarse nodes with the largest validation error are faulty. The next level keeps all coarse nodes and adds, around
the faulty ones, their neighbours in the finer graph. Elsewhere the finer mesh is interpolated from the coarse nodes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from data_schema.edges import adjacency
from data_schema.levels import Level
from surrogates.data.graphs import Graphs
from surrogates.errors import SurrogateError


@dataclass(frozen=True)
class Refined:
    """Graphs whose levels finer than `number` are still those of the hierarchy.

    Attributes
    ----------
    places
        (node of level `number`,) where its nodes stand among those of the hierarchy's level.
    spread
        csr (node of the hierarchy's level, node of level `number`): interpolation to all of them.
    """

    hierarchy: Graphs
    graphs: Graphs
    number: int
    places: NDArray[np.int64]
    spread: sparse.csr_matrix

    @classmethod
    def start(cls, hierarchy: Graphs, number: int) -> Refined:
        """Nothing refined yet: the coarsest level is the hierarchy's own."""
        n = hierarchy.n_nodes(number)
        return cls(hierarchy, hierarchy, number, np.arange(n), sparse.identity(n, format="csr"))

    def finer(self, error: NDArray[np.float64], share: float, rings: int) -> Refined:
        """Refine the next finer level around the nodes of level `number` with the largest error (node,)."""
        if self.number < 2:
            raise SurrogateError("adaptive refinement ends on level 1; leave level 0 out of levels")
        fine = self.hierarchy[self.number - 1]
        here = self.hierarchy[self.number].in_finer[self.places]
        worst = np.argsort(-error, kind="stable")[: max(1, round(share * len(error)))]
        chosen = np.union1d(here, _around(fine.edges, fine.n_nodes, here[worst], rings))
        place = np.full(fine.n_nodes, -1)
        place[chosen] = np.arange(len(chosen))
        interpolated = sparse.csr_matrix(self.hierarchy[self.number].to_finer @ self.spread)
        spread = _keeping(interpolated, here, chosen, place)
        coarse = replace(self.graphs[self.number], in_finer=place[here], to_finer=interpolated[chosen])
        finer = Level(
            index=fine.index,
            kept=fine.kept[chosen],
            faces=_joined(place[fine.faces], place[here][coarse.faces], place[here[worst]]),
            edges=_joined(place[fine.edges], place[here][coarse.edges]),
            in_finer=fine.in_finer[chosen],
            to_finer=sparse.csr_matrix(fine.to_finer @ spread),
            to_full=sparse.csr_matrix(fine.to_full @ spread),
        )
        levels = list(self.graphs.levels)
        levels[self.number - 1], levels[self.number - 2] = coarse, finer
        graphs = replace(self.graphs, levels=tuple(levels))
        return Refined(self.hierarchy, graphs, self.number - 1, chosen, spread)


def _around(edges: NDArray[np.int32], n_nodes: int, nodes: NDArray[np.int64], rings: int) -> NDArray[np.int64]:
    """`nodes` and all within `rings` edges of them."""
    step = adjacency(n_nodes, edges)
    reached = np.zeros(n_nodes)
    reached[nodes] = 1.0
    for _ in range(rings):
        reached = reached + step @ reached
    return np.flatnonzero(reached)


def _keeping(
    interpolated: sparse.csr_matrix, here: NDArray[np.int64], chosen: NDArray[np.int64], place: NDArray[np.int64]
) -> sparse.csr_matrix:
    """(finer node, chosen node): chosen nodes are themselves, the others interpolated from the coarse ones."""
    coo = interpolated.tocoo()
    dropped = place[coo.row] < 0
    rows = np.concatenate([coo.row[dropped], chosen])
    columns = np.concatenate([place[here][coo.col[dropped]], np.arange(len(chosen))])
    weights = np.concatenate([coo.data[dropped], np.ones(len(chosen))])
    return sparse.csr_matrix((weights, (rows, columns)), shape=(interpolated.shape[0], len(chosen)))


def _joined(
    fine: NDArray[np.int64], coarse: NDArray[np.int64], replaced: NDArray[np.int64] | None = None
) -> NDArray[np.int32]:
    """Edges or faces among chosen nodes: fine ones that are complete, and coarse ones but those between `replaced`."""
    kept = coarse if replaced is None else coarse[~np.isin(coarse, replaced).all(axis=1)]
    both = np.concatenate([fine[(fine >= 0).all(axis=1)], kept])
    _, first = np.unique(np.sort(both, axis=1), axis=0, return_index=True)
    return both[np.sort(first)].astype(np.int32)
