"""`crashkit export`: a run for ParaView, or a level of a model for programs without this package."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crashkit.cli._console import fail, look_in_paraview, print_json, say, what_next
from crashkit.cli._progress import Progress


def command(
    source: Annotated[Path, typer.Argument(help="Dataset (.zarr or .nc) or model folder.", show_default=False)],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help="Of a dataset: run.pvd or run.vtkhdf. Of a model: model.onnx or model.pt2 (torch.export).",
        ),
    ],
    run: Annotated[
        str, typer.Option(help="Of a dataset: the run to write, by name or place.", show_default=False)
    ] = "",
    level: Annotated[
        int | None, typer.Option(help="Of a model: the mesh level.", show_default="the finest it has")
    ] = None,
    full: Annotated[bool, typer.Option("--full", help="Of a model: include interpolation to the full mesh.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that is there.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Write a run of a dataset for ParaView, or a model as ONNX."""
    from crashkit.api.describe import kind_of
    from crashkit.api.export import export_model, export_run

    is_model = kind_of(source) == "model" or not (run or source.suffix in (".zarr", ".nc"))
    if is_model and run:
        fail(f"{source}: is a model, which has no runs; --run belongs to a dataset", code=2)
    if not (is_model or run):
        fail(f"{source}: is a dataset; name the run to write, such as --run run_008", code=2)
    with Progress(f"reading {source}" if is_model else f"reading run {run} of {source}", quiet=json):
        files = [] if is_model else export_run(source, run, output, overwrite=overwrite)
        error = export_model(source, output, level, full=full, overwrite=overwrite) if is_model else 0.0
    if json:
        print_json({"output": output, "relative_difference": error} if is_model else {"files": files})
    elif is_model:
        say(f"{output}: predicts as the model does (largest relative difference {error:.1e})")
        what_next(output)
    else:
        say(f"{output}: run {run} of {source}, {sum(f.stat().st_size for f in files) / 1e6:.1f} MB")
        look_in_paraview(files)
