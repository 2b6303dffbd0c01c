"""`crashkit coarsen`: give a dataset its mesh hierarchy, and say what each level costs."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from crashkit.api.coarsen import coarsen_with_files
from crashkit.cli._console import fixed, numbers, print_json, say, table, what_next
from crashkit.cli._progress import Progress


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
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the picture and the VTP files that are there.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Build coarser meshes (subsets of the nodes) and store them in the dataset, with the maps between them."""
    if selection not in ("quadric", "vtk"):
        raise typer.BadParameter(f"{selection!r}; expected quadric or vtk", param_hint="--selection")
    counts = [int(n) for n in numbers(nodes, "--nodes", "1165,292,73", whole=True)]
    factors = numbers(ratios, "--ratios", "8,4,4")
    if counts and factors:
        raise typer.BadParameter("give either --nodes or --ratios", param_hint="--ratios")
    with Progress(f"selecting the nodes of {path}", quiet=json) as shown:
        result = coarsen_with_files(
            path, counts or None, factors or None, picture=picture, vtp=vtp,
            selection="vtk" if selection == "vtk" else "quadric", pair_distance=pair_distance, test=test or None, overwrite=overwrite,
            report=shown.step,
        )  # fmt: skip
    if json:
        print_json(asdict(result))
        return
    show(path, result.levels, result.interpolation_errors_over)
    if result.replaced:
        earlier = ", ".join(map(str, result.replaced))
        say(f"  it replaces the hierarchy of {earlier} nodes, and evaluate asks to train models of that one again")
    for text in result.parts_without_faces:
        say(f"  {text}")
    if result.problem:
        say(f"{picture}: {result.problem}")
    if result.vtp:
        say(f"levels as VTP: {vtp}")
    what_next(result.picture or path, ("train", path, "-o", "model", "--test", test or "0.25"))


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
                f"{fixed(row['distance_mean'], 3, 100)} / {fixed(row['distance_max'], 2, 100)}",
                f"{fixed(row['lifting_error_mean'], 3, 100)} / {fixed(row['lifting_error_max'], 2, 100)}",
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
                (name, *(fixed(row["lifting_error_of_parts"][name], 3, 100) for row in levels))
                for name in sorted(parts, key=lambda name: _descending(levels[-1]["lifting_error_of_parts"][name]))
            ),
        )


def _descending(error: float) -> float:
    """Sorts the largest error first, and parts without faces (NaN) last."""
    return math.inf if math.isnan(error) else -error
