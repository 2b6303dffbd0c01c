"""The levels as VTP files, with the solver's node numbers and the probe maps as arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from crashkit.mesh.levels import Hierarchy
from crashkit.writers.paraview import write_paraview
from data_schema.edges import without_sides


def write_levels(
    folder: str | Path,
    hierarchy: Hierarchy,
    position: NDArray[np.float64],
    face_nodes: NDArray[np.integer],
    node_id: NDArray[np.integer],
    face_part_id: NDArray[np.integer] | None = None,
    part_id: NDArray[np.integer] | None = None,
) -> list[Path]:
    """Write `level_0.vtp`, `level_1.vtp`, .. into `folder`; returns their paths.

    position (n, 3), m, face_nodes (m, 3 or 4), node_id (n,), face_part_id (m,) of level 0; part_id: the solver's number
    of each part that `Level.face_part` counts. Every file holds for its points

    node, node_id               number in level 0, and the solver's
    coarsest_level              the coarsest level that keeps the node
    level_K_nodes, _weights     for each coarser level K: up to three of its points (-1 behind the last) and the
                                barycentric weights with which they stand for this point: its row of U
    level_K_distance            m, to the surface of level K

    and, for level 1 and coarser, edges without a face as lines.

    Raises
    ------
    OutputError
        If `folder` cannot be written.
    """
    folder = Path(folder)
    coarsest = np.zeros(len(position), np.int32)
    for level in hierarchy.levels:
        coarsest[level.kept] = level.index
    maps = {level.index: (*corner_weights(level.to_full), level.distance) for level in hierarchy.levels}
    written = []
    everything = np.arange(len(position))
    for index in range(len(hierarchy.levels) + 1):
        kept = everything if index == 0 else hierarchy[index].kept
        points: dict[str, Any] = {"node": kept, "node_id": node_id[kept], "coarsest_level": coarsest[kept]}
        for coarser, (nodes, weights, distance) in maps.items():
            if coarser > index:
                points[f"level_{coarser}_nodes"] = nodes[kept]
                points[f"level_{coarser}_weights"] = weights[kept]
                if distance is not None:
                    points[f"level_{coarser}_distance"] = distance[kept]
        lines = np.empty((0, 2), np.int64)
        cells: dict[str, Any] = {}
        faces: NDArray[np.integer] = face_nodes
        if index:
            faces = hierarchy[index].faces
            lines = without_sides(hierarchy[index].edges, faces)
            if part_id is not None and (of_face := hierarchy[index].face_part) is not None:
                cells["part_id"] = np.concatenate([part_id[of_face], np.full(len(lines), -1)])
        elif face_part_id is not None:
            cells["part_id"] = face_part_id
        written += write_paraview(
            folder / f"level_{index}.vtp", position[kept], faces, [0.0], points, cells, lines,
            {name: "m" for name in points if name.endswith("_distance")},
        )  # fmt: skip
    return written


def corner_weights(to_full: sparse.csr_matrix) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """A probe map as (n, 3) coarse nodes, -1 behind the last, and their (n, 3) weights."""
    count = np.diff(to_full.indptr)
    place = np.arange(to_full.nnz) - np.repeat(to_full.indptr[:-1], count)
    row = np.repeat(np.arange(to_full.shape[0]), count)
    nodes, weights = np.full((len(count), 3), -1, np.int32), np.zeros((len(count), 3))
    nodes[row, place], weights[row, place] = to_full.indices, to_full.data
    return nodes, weights
