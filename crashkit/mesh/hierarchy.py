"""The levels of a mesh: select nodes, map between levels, check what was asked."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from crashkit.errors import MeshError
from crashkit.mesh.levels import Hierarchy
from crashkit.mesh.probe import coarse_cells, probe_map
from crashkit.mesh.selection import Selection, select_quadric
from crashkit.mesh.selection_vtk import select_vtk
from crashkit.mesh.surface import Surface, surface
from data_schema.levels import Level

SelectionName = Literal["quadric", "vtk"]
# A level of about 1/8 and two of 1/4, as in the paper.
DEFAULT_RATIOS = (8, 4, 4)
# Nodes of one part may contract without an edge between them when closer than this share of the mesh's diagonal.
PAIR_SHARE = 0.01


def build_hierarchy(
    position: ArrayLike,
    face_nodes: ArrayLike,
    counts: Sequence[int] | None = None,
    *,
    face_part: ArrayLike | None = None,
    selection: SelectionName = "quadric",
    pair_distance: float | None = None,
    extra_edges: ArrayLike | None = None,
) -> Hierarchy:
    """Nested coarse levels of a surface mesh with exact node counts, and the maps between them.

    Nodes that no face touches stay out of the graph and take the nearest kept node.

    Parameters
    ----------
    position
        (n, 3), m.
    face_nodes
        (m, 3 or 4), -1 in the last corner of a triangle among quadrilaterals.
    counts
        Nodes of level 1, 2, ..; decreasing. Default: n / 8, a quarter of that, a quarter of that.
    face_part
        (m,) part of each face, from 0; a node is mapped from coarse nodes of its own parts only.
    selection
        "quadric" (half-edge contraction) or "vtk" (vtkQuadricDecimation tied to nodes).
    pair_distance
        m; nodes of one part closer than this may contract without an edge. Default: 1 % of the diagonal.
    extra_edges
        (e, 2) further graph edges between nodes of faces.

    Raises
    ------
    MeshError
        Saying which count or number is wrong.
    """
    if selection not in ("quadric", "vtk"):
        raise MeshError(f"selection {selection!r} is not known; expected quadric or vtk")
    mesh = surface(position, face_nodes, face_part, extra_edges)
    wanted = check_counts(mesh, ratios_to_counts(mesh.n_nodes, DEFAULT_RATIOS) if counts is None else counts)
    if pair_distance is None:
        pair_distance = PAIR_SHARE * mesh.diagonal
    if not (np.isfinite(pair_distance) and pair_distance >= 0):
        raise MeshError(f"pair distance {pair_distance}; expected metres, 0 or more")
    selections = (select_vtk if selection == "vtk" else select_quadric)(mesh, wanted, pair_distance)
    return assemble(mesh, selections, {"selection": selection, "pair_distance": float(pair_distance), "counts": wanted})


def ratios_to_counts(n_nodes: int, ratios: Sequence[float]) -> list[int]:
    """Node counts when each level keeps 1 / ratio of the nodes of the finer one, rounded."""
    if len(ratios) == 0 or not all(np.isfinite(r) and r > 1 for r in ratios):
        raise MeshError(f"ratios {', '.join(map(str, ratios))}; expected numbers above 1, such as 8,4,4")
    sizes = n_nodes / np.cumprod(np.asarray(ratios, float))
    return [max(1, round(size)) for size in sizes]


def check_counts(mesh: Surface, counts: Sequence[int]) -> list[int]:
    """The counts as integers; raises MeshError if they are not decreasing or not below the nodes there are."""
    wanted = [int(c) for c in counts]
    said = ", ".join(map(str, wanted))
    if not wanted or any(c != d for c, d in zip(wanted, counts, strict=True)) or min(wanted) < 1:
        raise MeshError(f"node counts {said or 'missing'}; expected whole numbers of at least 1, such as 1165,292,73")
    available = int(mesh.used.sum())
    if wanted[0] > available:
        raise MeshError(f"{wanted[0]} nodes were asked for, but only {available} nodes lie on faces; ask for fewer")
    if any(a <= b for a, b in pairwise(wanted)):
        raise MeshError(f"node counts {said} do not decrease; expected each level smaller than the one before")
    return wanted


def assemble(mesh: Surface, selections: Sequence[Selection], settings: dict[str, object]) -> Hierarchy:
    """The hierarchy of nested selections: own numberings, D, U to the finer level and to level 0, distances."""
    finer = np.arange(mesh.n_nodes, dtype=np.int64)
    levels = []
    for index, chosen in enumerate(selections, 1):
        level = _level(mesh, index, chosen, finer)
        levels.append(level)
        finer = level.kept
    return Hierarchy(mesh.n_nodes, tuple(levels), settings)


def _level(mesh: Surface, index: int, chosen: Selection, finer: NDArray[np.int64]) -> Level:
    kept = chosen.kept
    own = np.full(mesh.n_nodes, -1, np.int64)
    own[kept] = np.arange(len(kept))
    faces, edges = own[chosen.faces], own[chosen.edges]
    cells = coarse_cells(faces, chosen.part, edges, chosen.parts, mesh.n_parts)
    into = np.where(chosen.into >= 0, own[chosen.into], -1)
    to_full, distance = probe_map(mesh.position, mesh.node_parts, into, mesh.position[kept], cells, edges, kept)
    in_finer = np.searchsorted(finer, kept)
    to_finer: sparse.csr_matrix = to_full if index == 1 else to_full[finer].tocsr()
    return Level(
        index=index,
        kept=kept,
        faces=faces.astype(np.int32),
        edges=edges.astype(np.int32),
        in_finer=in_finer,
        to_finer=to_finer,
        to_full=to_full,
        distance=distance,
        face_part=chosen.part,
    )
