"""`crashkit export`: a run for ParaView, or a level of a model for programs without this package."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crashkit.cli._console import fail, print_json, say, what_next
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
    json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Write a run of a dataset for ParaView, or a model as ONNX."""
    if not (source / "model.json").exists() and (run or source.suffix in (".zarr", ".nc")):
        if not run:
            fail(f"{source}: is a dataset; name the run to write, such as --run run_008", code=2)
        _run(source, run, output, json)
    else:
        if run:
            fail(f"{source}: is a model, which has no runs; --run belongs to a dataset", code=2)
        _model(source, output, level, full, json)


def _run(source: Path, run: str, output: Path, as_json: bool) -> None:
    from crashkit.api.export import export_run
    from crashkit.errors import OutputError
    from crashkit.writers.paraview import SUFFIXES

    if output.suffix not in SUFFIXES:
        raise OutputError(f"{output}: a run is written as .pvd or .vtkhdf (.vtu or .vtp for a single state)")
    with Progress(f"reading run {run} of {source}", quiet=as_json):
        files = export_run(source, run, output)
    if as_json:
        print_json({"files": files})
        return
    say(f"{output}: run {run} of {source}, {sum(f.stat().st_size for f in files) / 1e6:.1f} MB")
    what_next(f"{files[0]} in ParaView; {files[-1]} shows it in fixed colour ranges (File > Load State)")


def _model(source: Path, output: Path, level: int | None, full: bool, as_json: bool) -> None:
    from crashkit.extras import need

    need("exporting a model", "train")
    from surrogates.storage.export import export
    from surrogates.storage.folder import load

    with Progress(f"reading {source}", quiet=as_json):
        error = export(load(source), output, level, full=full)
    if as_json:
        print_json({"output": output, "relative_difference": error})
        return
    say(f"{output}: predicts as the model does (largest relative difference {error:.1e})")
    what_next(output)
