"""Give a dataset its mesh hierarchy."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from crashkit.display import watched
from data_schema.progress import Progress, silent

if TYPE_CHECKING:
    import xarray as xr

    from crashkit.mesh.levels import Hierarchy
    from crashkit.mesh.store import MeshArrays
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

    from crashkit.dataset import opened_dataset
    from crashkit.errors import MeshError
    from crashkit.mesh.hierarchy import build_hierarchy, ratios_to_counts
    from crashkit.mesh.store import mesh_of, open_mesh, parts_without_faces, write_hierarchy
    from crashkit.selection import runs_of

    if nodes is not None and ratios is not None:
        raise MeshError("both node counts and ratios were given; give one of them")
    in_hand = isinstance(dataset, xr.Dataset)
    held: list[int] = []
    if test is not None and not isinstance(dataset, xr.Dataset):
        with opened_dataset(dataset) as opened:
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


@dataclass(frozen=True)
class CoarsenedDataset:
    """A dataset on disk that has got its hierarchy, and what was drawn and written of it.

    Attributes
    ----------
    path
        The dataset.
    settings
        Those of the hierarchy.
    levels
        As `crashkit.mesh.store.summarize_hierarchy` gives them.
    interpolation_errors_over
        The runs over which they were measured, in words.
    vtp
        The levels as files.
    picture
        All levels side by side; None where none was asked for or this machine cannot draw.
    parts_without_faces
        What to know of them, a sentence each.
    problem
        Why no picture was drawn; empty where there is none.
    replaced
        Numbers of nodes of an earlier hierarchy that gave way to this one; empty where there was none or the same.
    """

    path: Path
    settings: dict[str, Any]
    levels: list[dict[str, Any]]
    interpolation_errors_over: str
    vtp: list[Path]
    picture: Path | None
    parts_without_faces: list[str]
    problem: str = ""
    replaced: tuple[int, ...] = ()


def coarsen_with_files(
    path: str | Path,
    nodes: Sequence[int] | None = None,
    ratios: Sequence[float] | None = None,
    *,
    picture: str | Path | None = None,
    vtp: str | Path | None = None,
    selection: Literal["quadric", "vtk"] = "quadric",
    pair_distance: float | None = None,
    test: WhichRuns | None = None,
    overwrite: bool = False,
    report: Progress | None = None,
) -> CoarsenedDataset:
    """Give the dataset at `path` its mesh hierarchy, and draw and write the levels.

    Parameters
    ----------
    picture
        Draw all levels side by side into this file. Where this machine cannot draw, the hierarchy is made all the same.
    vtp
        Write each level as VTP, with its maps, into this folder.
    overwrite
        Replace a picture, and VTP files in that folder, that are there.
    nodes, ratios, selection, pair_distance, test, report
        As for `crashkit.coarsen`, as are the errors.
    """
    from crashkit.extras import need
    from crashkit.mesh.export import write_levels
    from crashkit.mesh.store import lifting_errors_over, open_mesh, parts_without_faces, summarize_hierarchy
    from crashkit.output import refuse_there

    if picture is not None:
        need("--picture", "report")
    path = Path(path)
    refuse_there([Path(p) for p in (picture, vtp) if p is not None], overwrite)
    before = _nodes_of_levels(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # parts without faces are in what is returned
        hierarchy = coarsen(
            path, nodes, ratios, selection=selection, pair_distance=pair_distance, test=test, report=report
        )
    tell = report or silent
    if picture is not None or vtp is not None:
        tell("drawing and writing the levels", 0, 0, "")
    levels, mesh = summarize_hierarchy(path), open_mesh(path)
    files = (
        []
        if vtp is None
        else write_levels(
            vtp, hierarchy, mesh.position, mesh.face_nodes, mesh.node_id, mesh.part_id[mesh.face_part], mesh.part_id
        )
    )
    problem = "" if picture is None else _draw(Path(picture), hierarchy, mesh, levels)
    return CoarsenedDataset(
        path, hierarchy.settings, levels, lifting_errors_over(path), files,
        None if picture is None or problem else Path(picture), parts_without_faces(path), problem,
        before if before != tuple(row["nodes"] for row in levels) else (),
    )  # fmt: skip


def _nodes_of_levels(path: Path) -> tuple[int, ...]:
    """Nodes of the levels that a dataset has already; none where it has none, or where it cannot be read."""
    from crashkit.errors import CrashkitError
    from crashkit.mesh.store import has_hierarchy, summarize_hierarchy

    try:
        return tuple(row["nodes"] for row in summarize_hierarchy(path)) if has_hierarchy(path) else ()
    except (CrashkitError, OSError):  # said by what reads it next
        return ()


def _draw(picture: Path, hierarchy: Hierarchy, mesh: MeshArrays, levels: list[dict[str, Any]]) -> str:
    """Draw the levels; gives the reason where this machine cannot."""
    from evaluation.drawing.levels import draw_levels
    from evaluation.drawing.rendering import rendering_problem

    problem = rendering_problem()
    if problem is None:
        draw_levels(picture, hierarchy, mesh.position, mesh.face_nodes, [row["lifting_error_mean"] for row in levels])
    return problem or ""
