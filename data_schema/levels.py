"""One coarse level of a mesh hierarchy as plain arrays: what meshes, surrogates and evaluation share.

Index convention, used everywhere: level 0 is the full mesh, level 1 the finest coarse one, higher is coarser.
Node numbers of a level are positions in its own `kept` array; `kept` itself holds node numbers of level 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from data_schema.edges import adjacency

if TYPE_CHECKING:
    from scipy import sparse


@dataclass(frozen=True)
class Level:
    """One coarse level (index >= 1) of a hierarchy.

    Attributes
    ----------
    kept
        (n,) int64, increasing: the level's nodes as node numbers of level 0.
    faces
        (m, 3) int32 triangles in the level's own numbering.
    edges
        (e, 2) int32 undirected graph edges (i < j), own numbering; includes lone edges without a face.
    in_finer
        (n,) int64: position of each node among the nodes of the next finer level (D: x[in_finer]).
    to_finer
        csr (n of next finer level, n): U one level up; rows sum to 1, >= 0.
    to_full
        csr (n of level 0, n): U straight to level 0.
    distance
        (n of level 0,) float64, m: distance of each fine node to the coarse surface; None where no mesh was at hand, as in
        a stored surrogate.
    face_part
        (m,) int32: part of each face as in the dataset; None where the mesh was given without parts.
    """

    index: int
    kept: NDArray[np.int64]
    faces: NDArray[np.int32]
    edges: NDArray[np.int32]
    in_finer: NDArray[np.int64]
    to_finer: sparse.csr_matrix
    to_full: sparse.csr_matrix
    distance: NDArray[np.float64] | None = None
    face_part: NDArray[np.int32] | None = None

    @property
    def n_nodes(self) -> int:
        return len(self.kept)

    @cached_property
    def adjacency(self) -> sparse.csr_matrix:
        """Symmetric 0/1 adjacency (n, n) of `edges`, without loops."""
        return adjacency(self.n_nodes, self.edges)


def lift(to_full: sparse.csr_matrix, states: NDArray[np.floating]) -> NDArray[np.floating]:
    """`states` (state, node of a level, 3) on level 0: (state, node, 3), in their precision.

    The static upsampling of the paper (section 3.2), the same for every model, so that levels can be compared. The result
    is a view whose memory lies node by node: one sparse product serves all states, and transposing costs more than that.

    Raises
    ------
    ValueError
        If the map is one from another number of nodes.
    """
    count, nodes, _ = states.shape
    if to_full.shape[1] != nodes:
        raise ValueError(
            f"the upsampling takes {to_full.shape[1]} nodes and the field has {nodes}; expected those of its level"
        )
    rows = to_full.astype(states.dtype, copy=False) @ states.transpose(1, 2, 0).reshape(nodes, -1)
    return np.asarray(rows.reshape(-1, 3, count).transpose(2, 0, 1))
