"""Adaptive refinement: a level that is fine only where the error is large (paper, section on adaptive refinement).

Faulty nodes, those whose error exceeds a tolerance, and their neighbours in the finer graph are added to a level. The
refined level takes the place of the next finer one, so a cascade trains on it as on any other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crashkit.errors import MeshError
from crashkit.mesh.hierarchy import assemble
from crashkit.mesh.levels import Hierarchy
from crashkit.mesh.selection import Selection, contract_onto, everything
from crashkit.mesh.surface import Surface, part_sets
from data_schema.edges import adjacency
from data_schema.levels import Level


def refine(
    mesh: Surface,
    hierarchy: Hierarchy,
    index: int,
    error: ArrayLike,
    *,
    tolerance: float | None = None,
    nodes: int | None = None,
) -> Hierarchy:
    """The hierarchy with level `index` refined where `error` is large.

    Faulty nodes and their neighbours in the graph of the next finer level join the nodes of level `index`. The result
    stands in place of that finer level (for index 1 it becomes a new level 1), with new D, U and adjacency; the other
    levels keep their nodes.

    Parameters
    ----------
    mesh
        The surface the hierarchy was built from.
    error
        (n of level 0,), m: such as the mean error of a surrogate on validation runs, lifted to level 0 (errors on
        the nodes of a level are lifted by its `to_full`).
    tolerance
        m: nodes of the next finer level with a larger error are faulty; or instead.
    nodes
        How many nodes the refined level shall have: faulty nodes are added, worst first, each with its neighbours,
        until they are that many.

    Raises
    ------
    MeshError
        If error, tolerance or nodes make no sense, or no node is faulty.
    """
    coarse = hierarchy[index]
    values = np.asarray(error, np.float64)
    if values.shape != (hierarchy.n_nodes,) or not np.isfinite(values).all():
        raise MeshError(
            f"the error has shape {values.shape}; expected a finite number for each of the {hierarchy.n_nodes} nodes of "
            "level 0 (lift errors of a level with its to_full)"
        )
    if (tolerance is None) == (nodes is None):
        raise MeshError("refinement needs either a tolerance or a number of nodes, and not both")
    finer = everything(mesh) if index == 1 else selection_of(mesh, hierarchy[index - 1])
    order = _worst_first(finer, values, coarse.kept, tolerance)
    if nodes is None:
        keep = np.concatenate([coarse.kept, order])
    else:
        if not coarse.n_nodes < nodes <= len(finer.kept):
            raise MeshError(
                f"{nodes} nodes were asked for; level {index} has {coarse.n_nodes} and the next finer one "
                f"{len(finer.kept)}, expected a number between"
            )
        keep = np.concatenate([coarse.kept, order[: nodes - coarse.n_nodes]])
    if len(keep) == coarse.n_nodes:
        raise MeshError(f"no node has an error above {tolerance} m (largest {values.max():.3g}); nothing to refine")
    refined = contract_onto(mesh, finer, keep)
    others = [selection_of(mesh, level) for level in hierarchy.levels]
    chosen = [*others[: max(0, index - 2)], refined, *others[index - 1 :]]
    settings = {**hierarchy.settings, "refined_level": max(1, index - 1), "counts": [len(s.kept) for s in chosen]}
    return assemble(mesh, chosen, settings)


def selection_of(mesh: Surface, level: Level) -> Selection:
    """What was selected for `level`, in node numbers of level 0; each node goes where its map weighs most."""
    part = np.zeros(len(level.faces), np.int32) if level.face_part is None else level.face_part
    faces = level.kept[level.faces].astype(np.int32)
    parts = mesh.node_parts[level.kept] | part_sets(mesh.n_nodes, faces, part, mesh.n_parts)[level.kept]
    heaviest = np.asarray(level.to_full.argmax(axis=1)).ravel()
    into = np.where(mesh.used, level.kept[heaviest], -1).astype(np.int32)
    edges = np.sort(level.kept[level.edges], axis=1).astype(np.int32)
    return Selection(level.kept, faces, part, edges, parts, into)


def _worst_first(
    finer: Selection, error: NDArray[np.float64], have: NDArray[np.int64], tolerance: float | None
) -> NDArray[np.int64]:
    """Nodes to add, as numbers of level 0: each faulty node, worst first, followed by its neighbours, worst first."""
    own = np.full(len(error), -1)
    own[finer.kept] = np.arange(len(finer.kept))
    graph = adjacency(len(finer.kept), own[finer.edges].astype(np.int32))
    here = error[finer.kept]
    worst = np.argsort(-here, kind="stable")
    if tolerance is not None:
        worst = worst[here[worst] > tolerance]
    added = np.zeros(len(finer.kept), bool)
    added[own[have]] = True
    out: list[int] = []
    for node in worst.tolist():
        around = graph.indices[graph.indptr[node] : graph.indptr[node + 1]]
        for new in (node, *around[np.argsort(-here[around], kind="stable")].tolist()):
            if not added[new]:
                added[new] = True
                out.append(new)
    return finer.kept[np.array(out, np.int64)]
