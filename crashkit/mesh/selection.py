"""Which nodes a coarser level keeps: quadric half-edge contraction to exact counts, nested.

Garland and Heckbert (1997), restricted to contractions p -> q in which q keeps its place, so that the kept nodes are
a subset of the original ones. What is contracted is a graph with faces on it: when the last face of a thin tube
vanishes its edges stay, and the tube lives on as a chain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from crashkit.errors import MeshError
from crashkit.mesh.surface import Surface, unique_pairs

# Weights against the area-weighted squared distances to the planes of the faces (see docs/mesh.md for how the
# second was found): open and branching edges, and the distance of a contracted node from the one that stands for it.
BOUNDARY = 1.0
SPREAD = 0.02
# A contraction that turns faces over costs this much more for every face.
FLIP = 1.0


@dataclass(frozen=True)
class Selection:
    """The nodes one level keeps and the mesh between them, all as node numbers of level 0.

    kept    (n,) int64, increasing
    faces   (m, 3) int32, part (m,) int32
    edges   (e, 2) int32, i < j
    parts   (n, words) uint64: bit sets of the parts of each kept node
    into    (n of level 0,) int32: the kept node that stands for each node; -1 for nodes no face touches
    """

    kept: NDArray[np.int64]
    faces: NDArray[np.int32]
    part: NDArray[np.int32]
    edges: NDArray[np.int32]
    parts: NDArray[np.uint64]
    into: NDArray[np.int32]


def select_quadric(
    mesh: Surface,
    counts: list[int],
    pair_distance: float = 0.0,
    *,
    boundary: float = BOUNDARY,
    spread: float = SPREAD,
    flip: float = FLIP,
) -> list[Selection]:
    """One selection for each of `counts` (decreasing), every one a subset of the one before.

    `pair_distance`, m: nodes of one part closer than this may contract without sharing an edge.
    The result does not depend on the order of nodes or faces, up to nodes at the very same place.

    Raises MeshError if a count cannot be reached because every part must keep a node.
    """
    from crashkit.mesh import _contraction

    scale = mesh.diagonal or 1.0
    nodes, state = _canonical(mesh, scale)
    edge_faces, edge_face = _faces_of_edges(state.faces, state.edges)
    state.quadric = _contraction.quadrics(state.at, state.faces, state.edges, edge_faces, edge_face, boundary, spread)
    chain = np.full(mesh.n_nodes, -1, np.int32)
    chain[nodes] = np.arange(len(nodes))
    selections = []
    for count in counts:
        while len(nodes) > count:
            step = max(count, len(nodes) // 2)
            kept, into = _contract_to(state, step, pair_distance / scale, flip)
            if len(kept) == len(nodes):
                if state.join_parts:
                    raise MeshError(
                        f"{count} nodes were asked for, but parts without common nodes need at least {len(nodes)}, "
                        "one each; ask for more nodes"
                    )
                state.join_parts = True
            nodes = nodes[kept]
            chain = np.where(chain >= 0, into[chain], -1)
        selections.append(_selection(mesh, nodes, state, chain))
    return selections


@dataclass
class _State:
    """The mesh between contractions: vertices numbered 0 .. n, lengths divided by the diagonal of the mesh."""

    at: NDArray[np.float64]
    quadric: NDArray[np.float64]
    faces: NDArray[np.int32]
    part: NDArray[np.int32]
    edges: NDArray[np.int32]
    parts: NDArray[np.uint64]
    tie: NDArray[np.int64]
    join_parts: bool = False


def _canonical(mesh: Surface, scale: float) -> tuple[NDArray[np.int64], _State]:
    """Used nodes, sorted by place, and the mesh in that numbering: the order of the input is forgotten here."""
    nodes = np.flatnonzero(mesh.used)
    nodes = nodes[np.lexsort(mesh.position[nodes].T[::-1])]
    new = np.full(mesh.n_nodes, -1, np.int32)
    new[nodes] = np.arange(len(nodes), dtype=np.int32)
    faces = new[mesh.triangles]
    # Corners turn until the lowest is first, faces are sorted: sums over them come in one order.
    turn = faces.argmin(axis=1)
    faces = faces[np.arange(len(faces))[:, None], (turn[:, None] + np.arange(3)) % 3]
    order = np.lexsort((mesh.part, faces[:, 2], faces[:, 1], faces[:, 0]))
    at = mesh.position[nodes]
    at = (at - (at.max(axis=0) + at.min(axis=0)) / 2) / scale
    state = _State(
        at=at,
        quadric=np.empty((0, 10)),
        faces=np.ascontiguousarray(faces[order]),
        part=mesh.part[order],
        edges=unique_pairs(new[mesh.edges]),
        parts=mesh.node_parts[nodes],
        # Equal costs are decided by a fixed shuffle of the places, so that flat regions thin out evenly.
        tie=np.random.default_rng(0).permutation(len(nodes)),
    )
    return nodes, state


def _faces_of_edges(faces: NDArray[np.int32], edges: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """How many faces each edge has, and one of them (-1 where none)."""
    width = int(max(faces.max(), edges.max(initial=0))) + 1
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    side_keys = sides[:, 0] * width + sides[:, 1]
    keys = edges[:, 0].astype(np.int64) * width + edges[:, 1]
    order = np.argsort(side_keys, kind="stable")
    found = side_keys[order]
    low, high = np.searchsorted(found, keys, "left"), np.searchsorted(found, keys, "right")
    face = np.full(len(edges), -1, np.int32)
    face[high > low] = order[low[high > low]] // 3
    return (high - low).astype(np.int32), face


def _contract_to(
    state: _State, count: int, pair_distance: float, flip: float
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Contract towards `count` vertices; `state` becomes the smaller mesh.

    Returns the vertices kept, as numbers before, and where every vertex went, as numbers after.
    """
    from crashkit.mesh import _contraction

    pairs = _lone_vertices(state)
    edges = np.concatenate([state.edges, pairs])
    is_pair = np.arange(len(edges)) >= len(state.edges)
    into, face_lives, edge_lives = _contraction.contract(
        state.at, state.quadric, state.faces, state.part, edges, is_pair, state.parts, state.tie,
        np.zeros(len(state.at), bool), count, state.join_parts, flip,
    )  # fmt: skip
    kept = np.flatnonzero(into == np.arange(len(into)))
    new = np.full(len(into), -1, np.int32)
    new[kept] = np.arange(len(kept))
    state.at, state.quadric, state.parts, state.tie = (
        a[kept] for a in (state.at, state.quadric, state.parts, state.tie)
    )
    state.faces, state.part = new[state.faces[face_lives]], state.part[face_lives]
    state.edges = unique_pairs(new[edges[edge_lives & ~is_pair]])
    return kept, new[into]


def _lone_vertices(state: _State) -> NDArray[np.int32]:
    """Pairs of each vertex that has no edge left with the nearest other vertex of its parts."""
    n = len(state.at)
    alone = np.ones(n, bool)
    alone[state.edges] = False
    pairs = [np.empty((0, 2), np.int64)]
    for word, bit in np.argwhere(_bits(np.bitwise_or.reduce(state.parts[alone], axis=0))):
        members = np.flatnonzero(state.parts[:, word] >> np.uint64(bit) & np.uint64(1))
        lonely = members[alone[members]]
        if len(members) > 1:
            nearest = cKDTree(state.at[members]).query(state.at[lonely], k=2)[1]
            other = np.where(members[nearest[:, 0]] == lonely, nearest[:, 1], nearest[:, 0])
            pairs.append(np.column_stack([lonely, members[other]]))
    return unique_pairs(np.concatenate(pairs))


def _bits(words: NDArray[np.uint64]) -> NDArray[np.bool_]:
    return (words[:, None] >> np.arange(64, dtype=np.uint64) & np.uint64(1)).astype(bool)


def _selection(mesh: Surface, nodes: NDArray[np.int64], state: _State, chain: NDArray[np.int32]) -> Selection:
    """The state with the node numbers of level 0."""
    order = np.argsort(nodes)
    return Selection(
        kept=nodes[order],
        faces=nodes[state.faces].astype(np.int32),
        part=state.part.copy(),
        edges=unique_pairs(nodes[state.edges]),
        parts=state.parts[order],
        into=np.where(chain >= 0, nodes[chain], -1).astype(np.int32),
    )
