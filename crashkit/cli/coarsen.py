"""`crashkit coarsen`: give a dataset its mesh hierarchy, and say what each level costs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from crashkit.api.coarsen import coarsen
from crashkit.cli._console import numbers, print_json, say, table, what_next
from crashkit.cli._progress import Progress
from evaluation.drawing.levels import draw_levels

if TYPE_CHECKING:
    from crashkit.mesh.levels import Hierarchy
    from crashkit.mesh.store import MeshArrays


def command(
    path: Annotated[
        Path, typer.Argument(help="Dataset (.zarr or .nc) to which the hierarchy is added.", show_default=False)
    ],
    nodes: Annotated[
        str, typer.Option(help="Number of nodes of each level, finest first: 1165,292,73.", show_default=False)
    ] = "",
    ratios: Annotated[
        str,
        typer.Option(help="Instead: reduction of each level, 8,4,4 = 1/8, then 1/4 of that, ...", show_default="8,4,4"),
    ] = "",
    selection: Annotated[
        str, typer.Option(help="How nodes are selected: quadric (edge contraction) or vtk (vtkQuadricDecimation).")
    ] = "quadric",
    pair_distance: Annotated[
        float | None,
        typer.Option(
            help="Merge nodes closer than this (m) even if no edge connects them.", show_default="1 % of the size"
        ),
    ] = None,
    test: Annotated[
        str,
        typer.Option(
            help="Runs held out for testing, as for crashkit train: interpolation errors are measured without them.",
            show_default="none",
        ),
    ] = "",
    picture: Annotated[
        Path | None, typer.Option(help="Also draw all levels side by side: levels.png.", show_default="none")
    ] = None,
    vtp: Annotated[
        Path | None,
        typer.Option(help="Also write each level as VTP, with its maps, into this folder.", show_default="none"),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Build coarser meshes (subsets of the nodes) and store them in the dataset, with the maps between them."""
    import warnings

    from crashkit.extras import need
    from crashkit.mesh.store import lifting_errors_over, open_mesh, summarize_hierarchy

    if picture is not None:
        need("--picture", "report")
    if selection not in ("quadric", "vtk"):
        raise typer.BadParameter(f"{selection!r}; expected quadric or vtk", param_hint="--selection")
    counts = [int(n) for n in numbers(nodes, "--nodes", "1165,292,73", whole=True)]
    factors = numbers(ratios, "--ratios", "8,4,4")
    if counts and factors:
        raise typer.BadParameter("give either --nodes or --ratios", param_hint="--ratios")
    with warnings.catch_warnings(record=True) as told, Progress(f"selecting the nodes of {path}", quiet=json) as shown:
        warnings.simplefilter("always", UserWarning)
        hierarchy = coarsen(
            path,
            counts or None,
            factors or None,
            selection="vtk" if selection == "vtk" else "quadric",
            pair_distance=pair_distance,
            test=test or None,
            report=shown.step,
        )
    without = [str(w.message) for w in told if w.category is UserWarning]
    levels, over = summarize_hierarchy(path), lifting_errors_over(path)
    mesh = open_mesh(path)
    files = [] if vtp is None else _write_levels(vtp, hierarchy, mesh)
    drawn = picture is not None and _draw(picture, hierarchy, mesh, levels)
    if json:
        print_json(
            {
                "path": path,
                "settings": hierarchy.settings,
                "levels": levels,
                "interpolation_errors_over": over,
                "vtp": files,
                "picture": picture if drawn else None,
                "parts_without_faces": without,
            }
        )
        return
    show(path, levels, over)
    for text in without:
        say(f"  {text}")
    if files:
        say(f"levels as VTP: {vtp}")
    what_next(picture if drawn else path, ("train", path, "-o", "model", "--test", test or "0.25"))


def show(path: Path, levels: list[dict[str, Any]], over: str) -> None:
    """What each level is, and what it costs; `over` says on which runs."""
    table(
        f"Mesh hierarchy of {path}, interpolation errors over {over}",
        ("level", "nodes", "faces", "edges", "distance mean / max (cm)", "interpolation error mean / max (cm)"),
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
    parts = list(levels[0]["lifting_error_of_parts"]) if levels else []
    if len(parts) > 1:
        table(
            "Interpolation error by part: mean over the part's nodes (cm)",
            ("part", *(f"level {row['level']}" for row in levels)),
            (
                (name, *(f"{100 * row['lifting_error_of_parts'][name]:.3f}" for row in levels))
                for name in sorted(parts, key=lambda name: _descending(levels[-1]["lifting_error_of_parts"][name]))
            ),
        )


def _descending(error: float) -> float:
    """Sorts the largest error first, and parts without faces (NaN) last."""
    return math.inf if math.isnan(error) else -error


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
