"""Which nodes a coarser level keeps: quadric half-edge contraction to exact counts, nested.

Garland and Heckbert (1997), restricted to contractions p -> q in which q keeps its place, so that the kept nodes are
a subset of the original ones. What is contracted is a graph with faces on it: when the last face of a thin tube
vanishes its edges stay, and the tube lives on as a chain. Afterwards each kept node may change places with a
neighbour where that lowers a bound on the error of lifting (docs/mesh.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from crashkit.errors import MeshError
from crashkit.mesh.quadric import vertex_quadrics
from crashkit.mesh.surface import Surface
from data_schema.edges import adjacency, unique_pairs

if TYPE_CHECKING:
    from crashkit.mesh import _relocation

# Weights beside the area-weighted squared distances to the planes of the faces: planes across open and branching
# edges, and the squared distance of a contracted node from the one that stands for it. Found on training runs.
BOUNDARY = 10.0
SPREAD = 0.005
# A contraction costs this much more for every face it turns over.
FLIP = 10.0
# Assumed length scale of the field, as a share of the mesh's diagonal, when kept nodes change places.
CURVATURE = 0.2
ROUNDS = 3
# Close pairs: how much farther apart along the graph than through space, and how many neighbours are looked at.
_DETOUR = 4.0
_NEIGHBOURS = 16
# Nodes closer than this share of the diagonal lie at the same place.
_SAME_PLACE = 1e-6


@dataclass(frozen=True)
class Selection:
    """The nodes one level keeps and the mesh between them, all as node numbers of level 0.

    Attributes
    ----------
    kept
        (k,) int64, increasing.
    faces
        (m, 3) int32, part (m,) int32.
    edges
        (e, 2) int32, i < j.
    parts
        (k, words) uint64: bit sets of the parts of each kept node.
    into
        (n of level 0,) int32: the kept node that stands for each node; -1 for nodes no face touches.
    """

    kept: NDArray[np.int64]
    faces: NDArray[np.int32]
    part: NDArray[np.int32]
    edges: NDArray[np.int32]
    parts: NDArray[np.uint64]
    into: NDArray[np.int32]


def everything(mesh: Surface) -> Selection:
    """The selection that keeps all nodes of faces: where every contraction starts."""
    kept = np.flatnonzero(mesh.used)
    into = np.where(mesh.used, np.arange(mesh.n_nodes), -1).astype(np.int32)
    return Selection(kept, mesh.triangles, mesh.part, mesh.edges, mesh.node_parts[kept], into)


def select_quadric(
    mesh: Surface,
    counts: list[int],
    pair_distance: float = 0.0,
    *,
    boundary: float = BOUNDARY,
    spread: float = SPREAD,
    curvature: float = CURVATURE,
    rounds: int = ROUNDS,
) -> list[Selection]:
    """One selection for each of `counts` (decreasing), every one a subset of the one before.

    `pair_distance`, m: nodes of one part closer than this may contract without sharing an edge, see `_close_pairs`.
    The result does not depend on the order of nodes or faces, up to nodes at the very same place.

    Raises
    ------
    MeshError
        If a count cannot be reached because every part must keep a node.
    """
    base = everything(mesh)
    nodes, state = _start(mesh, base, boundary, spread)
    chain = np.full(mesh.n_nodes, -1, np.int32)
    chain[nodes] = np.arange(len(nodes))
    weight: NDArray[np.float64] = np.ones(len(nodes))
    selections = []
    for count in counts:
        finer = _Finer(state.at, state.parts, state.edges, weight)
        kept, into = _contract(state, count, pair_distance / _scale(mesh))
        # Where less than one triangle a node is left, tubes have become chains, and the search loses more than it gains.
        if len(state.faces) >= count:
            kept, into = _improve(state, kept, into, finer, mesh.n_parts, curvature, rounds)
        nodes, weight = nodes[kept], np.bincount(into, weight, minlength=count).astype(np.float64)
        chain = np.where(chain >= 0, into[chain], -1)
        selections.append(_selection(nodes, state, chain))
    return selections


def contract_onto(mesh: Surface, base: Selection, keep: NDArray[np.integer]) -> Selection:
    """The mesh that is left of `base` when exactly the nodes `keep` (numbers of level 0, some of its own) stay.

    Raises
    ------
    MeshError
        If a part, with those it shares nodes with, has no node in `keep`.
    """
    return _contract_base(mesh, base, np.isin(base.kept, keep), 0, 0.0)


def contract_to(mesh: Surface, base: Selection, count: int, pair_distance: float = 0.0) -> Selection:
    """The mesh that is left of `base` when it is contracted to `count` nodes, cheapest first."""
    return _contract_base(mesh, base, np.zeros(len(base.kept), bool), count, pair_distance)


def _contract_base(
    mesh: Surface, base: Selection, stays: NDArray[np.bool_], count: int, pair_distance: float
) -> Selection:
    nodes, state = _start(mesh, base, BOUNDARY, SPREAD)
    own = np.full(mesh.n_nodes, -1, np.int32)
    own[nodes] = np.arange(len(nodes))
    chain = np.where(base.into >= 0, own[base.into], -1)
    locked = np.zeros(len(nodes), bool)
    locked[own[base.kept[stays]]] = True
    kept, into = _contract(state, max(count, int(stays.sum())), pair_distance / _scale(mesh), locked)
    return _selection(nodes[kept], state, np.where(chain >= 0, into[chain], -1))


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


def _scale(mesh: Surface) -> float:
    return mesh.diagonal or 1.0


def _start(mesh: Surface, base: Selection, boundary: float, spread: float) -> tuple[NDArray[np.int64], _State]:
    """Nodes of `base` sorted by place, and its mesh in that numbering: the order of the input is forgotten here."""
    order = np.lexsort(mesh.position[base.kept].T[::-1])
    nodes = base.kept[order]
    new = np.full(mesh.n_nodes, -1, np.int32)
    new[nodes] = np.arange(len(nodes), dtype=np.int32)
    faces = new[base.faces]
    # Corners turn until the lowest is first, and faces are sorted, so that sums over them come in one order.
    turn = faces.argmin(axis=1)
    faces = faces[np.arange(len(faces))[:, None], (turn[:, None] + np.arange(3)) % 3]
    sorted_faces = np.lexsort((base.part, faces[:, 2], faces[:, 1], faces[:, 0]))
    faces = np.ascontiguousarray(faces[sorted_faces])
    # The diagonals of quadrilaterals join in: from here on everything is triangles.
    edges = unique_pairs(np.concatenate([new[base.edges], faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)]))
    at = mesh.position[nodes]
    at = (at - (at.max(axis=0) + at.min(axis=0)) / 2) / _scale(mesh)
    state = _State(
        at=at,
        quadric=vertex_quadrics(at, faces, edges, *_faces_of_edges(faces, edges), boundary, spread),
        faces=faces,
        part=base.part[sorted_faces],
        edges=edges,
        parts=base.parts[order],
        # Equal costs are decided by a fixed shuffle of the places, so that flat regions thin out evenly.
        tie=np.random.default_rng(0).permutation(len(nodes)),
    )
    return nodes, state


def _faces_of_edges(faces: NDArray[np.int32], edges: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """How many faces each edge has, and one of them (-1 where none)."""
    width = int(max(faces.max(initial=0), edges.max(initial=0))) + 1
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    side_keys = sides[:, 0] * width + sides[:, 1]
    keys = edges[:, 0].astype(np.int64) * width + edges[:, 1]
    order = np.argsort(side_keys, kind="stable")
    found = side_keys[order]
    low, high = np.searchsorted(found, keys, "left"), np.searchsorted(found, keys, "right")
    face = np.full(len(edges), -1, np.int32)
    face[high > low] = order[low[high > low]] // 3
    return (high - low).astype(np.int32), face


def _contract(
    state: _State, count: int, pair_distance: float, locked: NDArray[np.bool_] | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Contract to `count` vertices, never the locked ones; `state` becomes the smaller mesh.

    First only p -> q where q lies on all parts of p, so that borders between parts keep their course; where that
    leads no further, across shared nodes. Vertices without any edge may go into the nearest one of their part.
    Returns the vertices kept, as numbers before, and where every vertex went, as numbers after.
    """
    n = len(state.at)
    kept, into = np.arange(n), np.arange(n, dtype=np.int32)
    locked = np.zeros(n, bool) if locked is None else locked
    join_parts = False
    while len(kept) > count:
        # Halving again and again renews the close pairs while the mesh grows coarser.
        step_kept, step_into = _contract_once(state, max(count, len(kept) // 2), pair_distance, locked, join_parts)
        if len(step_kept) == len(kept):
            if join_parts:
                raise MeshError(
                    f"{count} nodes were asked for, but {len(kept)} parts or groups of parts have no node in common "
                    "and each must keep one; ask for more nodes"
                )
            join_parts = True
        kept, into, locked = kept[step_kept], step_into[into], locked[step_kept]
    return kept, into


def _contract_once(
    state: _State, count: int, pair_distance: float, locked: NDArray[np.bool_], join_parts: bool
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    from crashkit.mesh import _contraction

    pairs = np.concatenate([_lone_vertices(state), _close_pairs(state, pair_distance)])
    edges = np.concatenate([state.edges, unique_pairs(pairs)])
    is_pair = np.arange(len(edges)) >= len(state.edges)
    into, face_lives, edge_lives = _contraction.contract(
        state.at, state.quadric, state.faces, state.part, edges, is_pair, state.parts, state.tie,
        locked, count, join_parts, FLIP,
    )  # fmt: skip
    kept = np.flatnonzero(into == np.arange(len(into)))
    new = np.full(len(into), -1, np.int32)
    new[kept] = np.arange(len(kept))
    state.at, state.quadric = state.at[kept], state.quadric[kept]
    state.parts, state.tie = state.parts[kept], state.tie[kept]
    state.faces, state.part = new[state.faces[face_lives]], state.part[face_lives]
    state.edges = unique_pairs(new[edges[edge_lives & ~is_pair]])
    return kept, new[into]


@dataclass(frozen=True)
class _Finer:
    """The mesh a level was contracted from: positions, part sets, graph edges, nodes of level 0 each node stands for."""

    at: NDArray[np.float64]
    parts: NDArray[np.uint64]
    edges: NDArray[np.int32]
    weight: NDArray[np.float64]


def _improve(
    state: _State, kept: NDArray[np.int64], into: NDArray[np.int32], finer: _Finer, n_parts: int, curvature: float,
    rounds: int,
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:  # fmt: skip
    """Turns of two local searches for a lower bound on the lifting error: other nodes, and other diagonals.

    `kept` and `into` as `_contract` returns them; `state` and what is returned are the same after the search.
    """
    from crashkit.mesh import _relocation

    graph = adjacency(len(finer.at), finer.edges)
    chosen = kept.copy()
    compiled = _relocation.Finer(
        at=finer.at,
        weight=finer.weight,
        parts=finer.parts,
        kind=np.unique(finer.parts, axis=0, return_inverse=True)[1].ravel(),
        into=into.copy(),
        near_start=graph.indptr,
        near_list=graph.indices,
    )
    stirred = np.ones(len(kept), bool)
    for _ in range(rounds):
        coarse = _coarse(state, compiled.into, n_parts)
        closest = _relocation.closest_cells_around(compiled, coarse, curvature)
        moved = _relocation.relocate(compiled, coarse, chosen, stirred, curvature, *closest)
        state.at = finer.at[chosen]
        flipped = _flip(state, compiled, coarse, stirred | moved, curvature, closest)
        compiled.into[chosen] = np.arange(len(chosen))
        stirred = moved | flipped
        if not stirred.any():
            break
    return chosen, compiled.into


def _flip(
    state: _State, finer: _relocation.Finer, coarse: _relocation.Coarse, stirred: NDArray[np.bool_], curvature: float,
    closest: tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]],
) -> NDArray[np.bool_]:  # fmt: skip
    """Turn the common edge of two triangles of one part where that lowers the bound; returns the corners (k,) bool."""
    from crashkit.mesh import _relocation

    pairs, corners = _turnable(state)
    # The coarse cells hold the triangles part by part; here they are in the order of `state.faces`.
    place = np.empty(len(state.part), np.int64)
    place[np.argsort(state.part, kind="stable")] = np.flatnonzero(coarse.cells[:, 2] >= 0)
    room = coarse._replace(
        cells=np.concatenate([coarse.cells, np.full((2, 3), -1)]), cell_part=np.concatenate([coarse.cell_part, [0, 0]])
    )
    gains = _relocation.flip_gains(finer, room, place[pairs], corners, stirred, curvature, *closest)
    flipped = np.zeros(len(state.at), bool)
    chosen = []
    for k in np.argsort(-gains, kind="stable").tolist():
        if gains[k] <= 0:
            break
        if not flipped[corners[k]].any():
            flipped[corners[k]] = True
            chosen.append(k)
    a, b, c, d = corners[chosen].T
    state.faces[pairs[chosen, 0]] = np.stack([a, d, c], axis=1)
    state.faces[pairs[chosen, 1]] = np.stack([d, b, c], axis=1)
    width = len(state.at)
    keys = state.edges[:, 0].astype(np.int64) * width + state.edges[:, 1]
    gone = np.isin(keys, np.minimum(a, b).astype(np.int64) * width + np.maximum(a, b))
    state.edges = unique_pairs(np.concatenate([state.edges[~gone], np.stack([c, d], axis=1)]))
    return flipped


def _turnable(state: _State) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Pairs of triangles whose common edge may be turned, and their corners a, b, c, d (triangles a b c and b a d).

    Both are of one part, no third triangle touches the edge, the new edge is not there yet, and the two new triangles
    face the way the old ones do.
    """
    n = len(state.at)
    sides = state.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    keys = sides.min(axis=1) * n + sides.max(axis=1)
    order = np.argsort(keys, kind="stable")
    same = np.flatnonzero(np.diff(keys[order]) == 0)
    # Edges of exactly two triangles: the next side has the same key, the ones around have not.
    padded = np.concatenate([[-1], keys[order], [-1]])
    two = same[(padded[same] != padded[same + 1]) & (padded[same + 3] != padded[same + 1])]
    first, second = order[two], order[two + 1]
    pairs = np.stack([first, second], axis=1) // 3
    a, b = sides[first].T
    c = state.faces[pairs[:, 0]].sum(axis=1) - a - b
    d = state.faces[pairs[:, 1]].sum(axis=1) - a - b
    existing = state.edges[:, 0].astype(np.int64) * n + state.edges[:, 1]
    at = state.at
    old = np.cross(at[b] - at[a], at[c] - at[a])
    one, other = np.cross(at[d] - at[a], at[c] - at[a]), np.cross(at[b] - at[d], at[c] - at[d])
    good = (
        (state.part[pairs[:, 0]] == state.part[pairs[:, 1]])
        & (c != d)
        & ~np.isin(np.minimum(c, d) * n + np.maximum(c, d), existing)
        & ((one * old).sum(axis=1) > 0)
        & ((other * old).sum(axis=1) > 0)
    )
    return pairs[good], np.stack([a, b, c, d], axis=1)[good].astype(np.int32)


def _coarse(state: _State, into: NDArray[np.int32], n_parts: int) -> _relocation.Coarse:
    """The coarse mesh as the compiled searches want it."""
    from crashkit.mesh import _relocation
    from crashkit.mesh.probe import cells_of_nodes, coarse_cells

    n = len(state.at)
    cells = coarse_cells(state.faces, state.part, state.edges, state.parts, n_parts)
    cell_start, cell_list = cells_of_nodes(cells.nodes, n)
    graph = adjacency(n, state.edges)
    return _relocation.Coarse(
        at=state.at.copy(),
        cells=cells.nodes,
        cell_part=cells.part,
        cell_start=cell_start,
        cell_list=cell_list,
        near_start=graph.indptr,
        near_list=graph.indices,
        member_start=np.concatenate([[0], np.cumsum(np.bincount(into, minlength=n))]),
        member_list=np.argsort(into, kind="stable"),
    )


def _lone_vertices(state: _State) -> NDArray[np.int32]:
    """Pairs of each vertex that has no edge left with the nearest other vertex of its parts."""
    alone = np.ones(len(state.at), bool)
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


def _close_pairs(state: _State, distance: float) -> NDArray[np.int32]:
    """Pairs of vertices of one part without a common edge that may contract.

    They are closer than `distance` and than the edges around them, and belong together: at the very same place, or
    at most a few times as far apart along the graph. So the walls of a tube join, and sheets that only lie close
    (which may move apart) do not.
    """
    from crashkit.mesh import _contraction

    if distance <= 0 or len(state.at) < 2:
        return np.empty((0, 2), np.int32)
    i, j = state.edges.T
    length = np.linalg.norm(state.at[i] - state.at[j], axis=1)
    n = len(state.at)
    degree = np.bincount(i, minlength=n) + np.bincount(j, minlength=n)
    around = (np.bincount(i, length, n) + np.bincount(j, length, n)) / np.maximum(degree, 1)
    k = min(_NEIGHBOURS, n)
    apart, other = cKDTree(state.at).query(state.at, k=k, distance_upper_bound=distance)
    one = np.broadcast_to(np.arange(n)[:, None], other.shape)
    found = np.isfinite(apart) & (one < other)
    pairs = np.stack([one[found], other[found]], axis=1).astype(np.int32)
    apart = apart[found]
    reach = np.maximum(np.minimum(around[pairs[:, 0]], around[pairs[:, 1]]), _SAME_PLACE)
    common = (state.parts[pairs[:, 0]] & state.parts[pairs[:, 1]]).any(axis=1)
    graph = adjacency(n, state.edges)
    beside = graph[pairs[:, 0]].multiply(graph[pairs[:, 1]]).sum(axis=1).A1 > 0 if len(pairs) else common
    same_place = apart <= _SAME_PLACE
    keep = common & (same_place | (~beside & (apart <= reach)))
    pairs, apart, same_place = pairs[keep], apart[keep], same_place[keep]
    along = _contraction.graph_distances(pairs, apart * _DETOUR, state.at, graph.indptr, graph.indices)
    return np.asarray(pairs[same_place | ((along > apart * (1 + 1e-9)) & np.isfinite(along))])


def _bits(words: NDArray[np.uint64]) -> NDArray[np.bool_]:
    return (words[:, None] >> np.arange(64, dtype=np.uint64) & np.uint64(1)).astype(bool)


def _selection(nodes: NDArray[np.int64], state: _State, chain: NDArray[np.int32]) -> Selection:
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
