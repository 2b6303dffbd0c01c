"""Give a dataset its mesh hierarchy."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from crashkit.display import watched
from data_schema.progress import Progress

if TYPE_CHECKING:
    import xarray as xr

    from crashkit.mesh.levels import Hierarchy
    from crashkit.selection import WhichRuns


def coarsen(
    dataset: str | Path | xr.Dataset,
    nodes: Sequence[int] | None = None,
    ratios: Sequence[float] | None = None,
    *,
    selection: Literal["quadric", "vtk"] = "quadric",
    pair_distance: float | None = None,
    test: WhichRuns | None = None,
    report: Progress | None = None,
    progress: bool | Literal["auto"] = "auto",
) -> Hierarchy:
    """Build the mesh hierarchy of a dataset, and write it into the dataset where that is given by its path.

    Parts that have no faces (beams, particles) are named in a `UserWarning`, since their nodes take their displacements
    from other parts.

    Parameters
    ----------
    dataset
        Path of a crash dataset: the hierarchy is stored in it, with the displacements of level 1, and an older one
        is replaced once the new one is complete. Or the dataset in hand: then nothing is written; pass what is returned
        to `crashkit.train(dataset, hierarchy=...)`.
    nodes
        Exact number of nodes of level 1, 2, ...
    ratios
        Instead: how many times fewer nodes each level has than the finer one. Default: 8, 4, 4.
    selection
        How nodes are selected: quadric (half-edge contraction) or vtk (vtkQuadricDecimation).
    pair_distance
        m; see `crashkit.mesh.build_hierarchy`.
    test
        Runs held out for testing, as in `crashkit.train`: the interpolation errors that are stored do not see them.
    report
        Called with (what, runs done, runs, note) in the pass over the runs.
    progress
        Show a line of progress in a notebook; "auto": where this is one.

    Raises
    ------
    MeshError
        For numbers of nodes that cannot be had.
    DataError, ReadError, OutputError
        For the files, and for `test` runs that are not there.
    """
    import xarray as xr

    from crashkit.dataset import open_dataset
    from crashkit.errors import MeshError
    from crashkit.mesh.hierarchy import build_hierarchy, ratios_to_counts
    from crashkit.mesh.store import mesh_of, open_mesh, parts_without_faces, write_hierarchy
    from crashkit.selection import runs_of

    if nodes is not None and ratios is not None:
        raise MeshError("both node counts and ratios were given; give one of them")
    in_hand = isinstance(dataset, xr.Dataset)
    held: list[int] = []
    if test is not None and not isinstance(dataset, xr.Dataset):
        with open_dataset(dataset, chunks=None) as opened:
            held = runs_of([str(name) for name in opened["sim"].values], test)
    mesh = mesh_of(dataset) if isinstance(dataset, xr.Dataset) else open_mesh(Path(dataset))
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
        raise MeshError(f"{'the dataset' if in_hand else dataset}: {error}") from error
    if not isinstance(dataset, xr.Dataset):
        for text in parts_without_faces(Path(dataset)):
            warnings.warn(text, stacklevel=2)
        write_hierarchy(dataset, hierarchy, test=held, report=watched(report, progress))
    return hierarchy
