"""`crashkit predict`: ask a stored model about crashes that nobody computed."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crashkit.cli._console import fail, look_in_paraview, print_json, say, share, table
from crashkit.cli._progress import Progress
from crashkit.cli._times import times

if TYPE_CHECKING:
    from crashkit.api.predict_runs import PredictedBand, PredictedRun


def command(
    model: Annotated[Path, typer.Argument(help="Model folder.", show_default=False)],
    param: Annotated[
        list[str] | None,
        typer.Option(
            "--param",
            "-p",
            help="One parameter: impact_speed=20 (in the unit of the parameter table) or yield_stress=400MPa.",
        ),
    ] = None,
    params: Annotated[
        Path | None,
        typer.Option(help="Predict every row of this table (CSV, TSV, JSON or XLSX) instead.", show_default="none"),
    ] = None,
    run: Annotated[
        str, typer.Option(help="Predict this run of --dataset instead, with the truth beside it.", show_default="none")
    ] = "",
    dataset: Annotated[Path | None, typer.Option(help="Dataset of --run.", show_default="none")] = None,
    coarse_run: Annotated[
        str,
        typer.Option(
            help="Start from this run of the same parameters on the coarse mesh (models trained with --coarse): a solver's "
            "folder or file, or coarse.zarr:run_012; with --params a folder or dataset with the rows' runs.",
            show_default="none",
        ),
    ] = "",
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help="run.pvd, run.vtkhdf (ParaView), run.vtu (one state), run.npz, d3plot/ (LS-DYNA), run.zarr or run.vtp "
            "(PhysicsNeMo); of a table: a folder or NAME.pvd.",
        ),
    ] = Path("prediction.pvd"),
    time: Annotated[
        str,
        typer.Option(
            help="Times: 15ms, or 0,0.01,0.02 (s without a unit), or start:stop:number, such as 0:30ms:4.",
            show_default="those of the training runs",
        ),
    ] = "",
    level: Annotated[
        int | None, typer.Option(help="Mesh level, on its own nodes.", show_default="full mesh, from the finest level")
    ] = None,
    full: Annotated[
        bool, typer.Option("--full", help="With --level: interpolate from that level to the full mesh.")
    ] = False,
    band: Annotated[
        float | None,
        typer.Option(
            help="Also write a prediction band that should contain this share of nodes, e.g. 0.9 or 90%.",
            parser=share,
            metavar="SHARE",
            show_default="none",
        ),
    ] = None,
    sensitivity: Annotated[
        bool, typer.Option("--sensitivity", help="Also write the derivative by each parameter.")
    ] = False,
    extrapolate: Annotated[
        bool, typer.Option("--extrapolate", help="Predict even far outside the trained range.")
    ] = False,
    hide_above: Annotated[
        float,
        typer.Option(
            help="Hide elements that are gone with more than this probability (ParaView files).", min=0, max=1
        ),
    ] = 0.5,
    template: Annotated[
        Path | None,
        typer.Option(
            help="With -o d3plot/: a d3plot of the same model, whose geometry and units are taken.", show_default="none"
        ),
    ] = None,
    write_series: Annotated[
        bool, typer.Option("--write-series", help="With --params: write the rows in parallel, on all processors.")
    ] = False,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="With --params: go on with a table that was interrupted; what is written stays."),
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files that are there.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Predict runs and write them for ParaView or as arrays."""
    if sum((bool(param), params is not None, bool(run))) > 1:
        fail("give one of --param, --params and --run", code=2)
    if write_series and params is None:
        fail("--write-series writes the rows of a table; give it with --params runs.csv", code=2)
    if resume and params is None:
        fail("--resume goes on with the rows of a table; give it with --params runs.csv", code=2)
    if bool(run) != (dataset is not None):
        fail("--run and --dataset belong together: --run run_008 --dataset crash.zarr", code=2)
    asked = None if params is not None or run else given(param or ())
    at = times(time)
    with Progress(f"reading {model}", quiet=json) as shown:
        from crashkit.api.predict_runs import predict_runs

        try:
            rows = predict_runs(
                model, output, parameters=asked, table=params, run=run or None,
                dataset=dataset, time=at, level=level, full=full or None, extrapolate=extrapolate, band=band,
                sensitivity=sensitivity, template=template, workers=(os.cpu_count() or 1) if write_series else 1,
                coarse_run=coarse_run or None,
                hide_above=hide_above, overwrite=overwrite, resume=resume, report=shown.step,
            )  # fmt: skip
        except KeyboardInterrupt:
            kept = "; the runs written until then stay, each whole: go on with --resume" if params is not None else ""
            fail(f"interrupted{kept}", code=130)
    if json:
        documents = [row.as_dict() for row in rows]
        print_json(documents if params is not None else documents[0])
        return
    before = sum(row.resumed or False for row in rows)
    if before:
        say(f"{before} of {len(rows)} runs were written before, {len(rows) - before} now")
    for row in rows:
        for sentence in row.warnings:
            say(f"warning: {row.run + ': ' if row.run else ''}{sentence}")
    show(rows, from_coarse=bool(coarse_run))


def show(rows: list[PredictedRun], *, from_coarse: bool = False) -> None:
    """What was predicted, its error where the truth is known, and the file to open."""
    first = rows[0]
    where = f"{first.model}{' from a coarse run' * from_coarse}, {first.states} states of {first.nodes} nodes"
    if len(rows) > 1:
        table(
            f"{len(rows)} runs predicted: {where}",
            ("run", "largest displacement (cm)", "file"),
            ((r.run, f"{100 * r.largest_displacement_m:.1f}", r.files[0]) for r in rows),
        )
    else:
        say(f"{first.files[0]}: {where}, largest displacement {100 * first.largest_displacement_m:.1f} cm")
    if len(rows) == 1 and first.expected_removed is not None:
        say(
            f"elements gone at the end: {first.expected_removed:.0f} expected, {first.hidden} likely enough to be hidden"
        )
    if first.mean_error_m is not None and first.relative_error is not None and first.largest_error_m is not None:
        say(
            f"error: mean {100 * first.mean_error_m:.2f} cm, {100 * first.relative_error:.1f} % of the motion, "
            f"largest of any node {100 * first.largest_error_m:.1f} cm"
        )
    if first.band is not None:
        _show_band(first.band)
    if len(rows) == 1 and first.numbers:
        for name, found in first.numbers.items():
            say(f"{name}: {_readable(found['value'], found['unit'], found.get('half_width'))}")
    look_in_paraview(first.files)


def _show_band(band: PredictedBand) -> None:
    say(
        f"band: {100 * band.share:g} % of nodes and states within {100 * band.mean_half_width_m:.2f} cm on average, "
        f"{100 * band.largest_half_width_m:.1f} cm at most, from the errors on {band.runs_behind} left-out runs"
        + (f"; of this run {100 * band.inside:.0f} % lie inside" if band.inside is not None else "")
    )
    say(band.on_test_runs or "whether the band holds on test runs is not known yet: crashkit evaluate tells")


def given(texts: Iterable[str], option: str = "--param", example: str = "impact_speed=20") -> dict[str, str]:
    """Texts name=value as a dictionary; bad usage where one is none."""
    out: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name.strip() or not value.strip():
            raise typer.BadParameter(f"{text!r}; expected name=value, such as {example}", param_hint=option)
        if name.strip() in out:
            raise typer.BadParameter(f"{name.strip()} is given twice", param_hint=option)
        out[name.strip()] = value
    return out


def _readable(value: float, unit: str, half_width: float | None) -> str:
    """A number in the unit that people read, with its band."""
    import numpy as np

    from evaluation.drawing.style import readable

    shown, name = readable(np.array([value, half_width or 0.0]), unit)
    band = "" if half_width is None else f" ± {shown[1]:.3g}"
    useless = half_width is not None and half_width > abs(value)
    return f"{shown[0]:.4g}{band} {name}".rstrip() + (
        " (the band is wider than the value, which says next to nothing)" if useless else ""
    )
