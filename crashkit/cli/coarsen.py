"""`crashkit coarsen`: give a dataset its mesh hierarchy, and say what each level costs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from crashkit.api.coarsen import coarsen
from crashkit.cli._console import print_json, progress, say, table
from evaluation.drawing.levels import draw_levels

if TYPE_CHECKING:
    from crashkit.mesh.levels import Hierarchy
    from crashkit.mesh.store import MeshArrays


def command(
    path: Annotated[Path, typer.Argument(help="Dataset (.zarr or .nc) that gets the hierarchy.", show_default=False)],
    nodes: Annotated[str, typer.Option(help="Exact nodes of each level, finest first: 1165,292,73.")] = "",
    ratios: Annotated[
        str, typer.Option(help="Instead: how many times fewer nodes than one level finer.", show_default="8,4,4")
    ] = "",
    selection: Annotated[
        str, typer.Option(help="quadric (half-edge contraction) or vtk (vtkQuadricDecimation).")
    ] = "quadric",
    pair_distance: Annotated[
        float | None,
        typer.Option(help="Nodes closer than this, m, may join without an edge.", show_default="1 % of the size"),
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="Draw all levels side by side into this PNG.")] = None,
    vtp: Annotated[
        Path | None, typer.Option(help="Write each level as VTP, with the probe maps, into this folder.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Select the nodes of ever coarser meshes and store them in the dataset, with the maps between them."""
    from crashkit.extras import need
    from crashkit.mesh.store import open_mesh, summarize_hierarchy

    if picture is not None:
        need("--picture", "report")
    if selection not in ("quadric", "vtk"):
        raise typer.BadParameter(f"{selection!r}; expected quadric or vtk", param_hint="--selection")
    counts = [int(n) for n in _numbers(nodes, "--nodes", "1165,292,73", whole=True)]
    factors = _numbers(ratios, "--ratios", "8,4,4")
    if counts and factors:
        raise typer.BadParameter("give either --nodes or --ratios", param_hint="--ratios")
    say(f"{path}: selecting nodes, then one pass over the runs")
    with progress(quiet=json) as bar:
        task = bar.add_task("reading runs", total=None, note="")

        def report(done: int, runs: int) -> None:
            bar.update(task, completed=done, total=runs)

        hierarchy = coarsen(
            path,
            counts or None,
            factors or None,
            selection="vtk" if selection == "vtk" else "quadric",
            pair_distance=pair_distance,
            report=report,
        )
    levels = summarize_hierarchy(path)
    mesh = open_mesh(path)
    files = [] if vtp is None else _write_levels(vtp, hierarchy, mesh)
    drawn = picture is not None and _draw(picture, hierarchy, mesh, levels)
    if json:
        print_json(
            {
                "path": path,
                "settings": hierarchy.settings,
                "levels": levels,
                "vtp": files,
                "picture": picture if drawn else None,
            }
        )
        return
    table(
        f"Mesh hierarchy of {path}",
        ("level", "nodes", "faces", "edges", "distance mean / max (cm)", "lifting error mean / max (cm)"),
        (
            (
                row["level"],
                row["nodes"],
                row["faces"],
                row["edges"],
                f"{100 * row['distance_mean']:.3f} / {100 * row['distance_max']:.2f}",
                f"{100 * row['lifting_error_mean']:.3f} / {100 * row['lifting_error_max']:.2f}",
            )
            for row in levels
        ),
    )
    if files:
        say(f"levels as VTP: {vtp}")
    if drawn:
        say(f"picture: {picture}")


def _numbers(text: str, option: str, example: str, whole: bool = False) -> list[float]:
    """The numbers of a list such as "8,4,4"."""
    try:
        return [int(piece) if whole else float(piece) for piece in text.split(",")] if text else []
    except ValueError as error:
        kind = "whole numbers" if whole else "numbers"
        raise typer.BadParameter(
            f"{text!r}; expected {kind} with commas between them, such as {example}", param_hint=option
        ) from error


def _write_levels(folder: Path, hierarchy: Hierarchy, mesh: MeshArrays) -> list[Path]:
    from crashkit.mesh.export import write_levels

    return write_levels(
        folder,
        hierarchy,
        mesh.position,
        mesh.face_nodes,
        mesh.node_id,
        mesh.part_id[mesh.face_part],
        mesh.part_id,
    )


def _draw(picture: Path, hierarchy: Hierarchy, mesh: MeshArrays, levels: list[dict[str, Any]]) -> bool:
    """Draw the picture; where this machine cannot, say so and go on, since the hierarchy is what was asked for."""
    from evaluation.drawing.rendering import rendering_problem

    problem = rendering_problem()
    if problem is not None:
        say(f"{picture}: {problem}")
        return False
    draw_levels(picture, hierarchy, mesh.position, mesh.face_nodes, [row["lifting_error_mean"] for row in levels])
    return True
