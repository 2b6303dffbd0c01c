"""Give a dataset its mesh hierarchy."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from crashkit.mesh.levels import Hierarchy


def coarsen(
    path: str | Path,
    nodes: Sequence[int] | None = None,
    ratios: Sequence[float] | None = None,
    *,
    selection: Literal["quadric", "vtk"] = "quadric",
    pair_distance: float | None = None,
    report: Callable[[int, int], None] | None = None,
) -> Hierarchy:
    """Build the mesh hierarchy of the dataset at `path` and write it into it, with the displacements of level 1.

    `nodes` are the exact node counts of level 1, 2, ..; or `ratios` by how much each level has fewer nodes than the
    finer one (default 8, 4, 4). `pair_distance`, m: see `crashkit.mesh.build_hierarchy`. `report(done, runs)` follows
    the pass over the runs. An older hierarchy is replaced once the new one is complete. Parts that have no faces (beams,
    particles) are named in a `UserWarning`, since their nodes take their displacements from other parts.

    Raises
    ------
    MeshError
        For counts that cannot be had.
    DataError, ReadError, OutputError
        For the files.
    """
    from crashkit.errors import MeshError
    from crashkit.mesh.hierarchy import build_hierarchy, ratios_to_counts
    from crashkit.mesh.store import open_mesh, parts_without_faces, write_hierarchy

    if nodes is not None and ratios is not None:
        raise MeshError("both node counts and ratios were given; give one of them")
    mesh = open_mesh(Path(path))
    try:
        hierarchy = build_hierarchy(
            mesh.position,
            mesh.face_nodes,
            nodes if ratios is None else ratios_to_counts(len(mesh.position), ratios),
            face_part=mesh.face_part,
            selection=selection,
            pair_distance=pair_distance,
        )
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error
    for text in parts_without_faces(Path(path)):
        warnings.warn(text, stacklevel=2)
    write_hierarchy(path, hierarchy, progress=report)
    return hierarchy
