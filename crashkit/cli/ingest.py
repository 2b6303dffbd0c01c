"""`crashkit ingest`: solver runs in, one dataset out."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crashkit.cli._console import fail, names, print_json, say, table, what_next
from crashkit.cli._progress import Progress
from crashkit.cli._times import times

if TYPE_CHECKING:
    from crashkit.ingestion.ingest import IngestSummary

# Marked runs that are listed one by one.
_MOST_MARKED = 10


def command(
    sources: Annotated[list[Path], typer.Argument(help="Files or folders with solver runs.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", help="Dataset to write: NAME.zarr or NAME.nc.")],
    params: Annotated[
        Path | None,
        typer.Option(help="Table of design parameters, one row per run: CSV, TSV, JSON or XLSX.", show_default="none"),
    ] = None,
    units: Annotated[
        str | None,
        typer.Option(help="Unit system of the source: SI, mm-ms-kg, mm-s-t, ...", show_default="from the source"),
    ] = None,
    reader: Annotated[
        str | None, typer.Option(help="Use this reader instead of detecting the format.", show_default=False)
    ] = None,
    mesh: Annotated[
        Path | None, typer.Option(help="Mesh file with the faces, if the source has none.", show_default=False)
    ] = None,
    time_step: Annotated[
        float | None,
        typer.Option(help="Time between two states in the source's unit, if it has no times.", show_default=False),
    ] = None,
    run_names: Annotated[
        str, typer.Option("--names", help="Names of the runs, from {run} and {source}: {source}-{run}.")
    ] = "{run}",
    parts: Annotated[str, typer.Option(help="Keep only these parts: numbers, titles or patterns.")] = "",
    exclude_parts: Annotated[str, typer.Option(help="Leave out these parts.")] = "",
    keep_rigid_walls: Annotated[bool, typer.Option("--keep-rigid-walls", help="Keep rigid-wall elements.")] = False,
    fields: Annotated[str, typer.Option(help="Further result fields to keep, such as plastic_strain,velocity.")] = "",
    time: Annotated[
        str,
        typer.Option(
            help="Common output times, start:stop:number, such as 0:0.03:61 (s) or 0:30ms:61.",
            show_default="the runs' own",
        ),
    ] = "",
    on_error: Annotated[str, typer.Option(help="stop at a run that cannot be used, or skip it.")] = "stop",
    allow_incomplete: Annotated[
        bool, typer.Option("--allow-incomplete", help="Accept runs that were cut short.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace runs that the dataset already holds.")
    ] = False,
    quality: Annotated[
        str,
        typer.Option(
            help="Runs whose energy balance, hourglass energy, added mass or end is beyond its limit, or in which a node leaps "
            "away in one state: mark or refuse them."
        ),
    ] = "mark",
    limit: Annotated[
        list[str] | None,
        typer.Option(
            help="Another limit, in per cent: energy_error=5, hourglass_share=10, mass_added=none. Repeat for more.",
            show_default="15, 10, 10",
        ),
    ] = None,
    workers: Annotated[int, typer.Option(help="Number of processes on this machine.", min=1)] = 1,
    scheduler: Annotated[
        str | None, typer.Option(help="Use this Dask scheduler (address) instead.", show_default="none")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Read solver runs, check them, and write them as one labelled dataset in SI units.

    After an interruption the same command continues. New runs are appended to an existing dataset.
    """
    from dataclasses import asdict

    from crashkit.ingestion.ingest import ingest

    if on_error not in ("stop", "skip"):
        raise typer.BadParameter(f"{on_error!r}; expected stop or skip", param_hint="--on-error")
    if quality not in ("mark", "refuse"):
        raise typer.BadParameter(f"{quality!r}; expected mark or refuse", param_hint="--quality")
    limits = _limits(limit or ())
    with Progress("looking for runs", quiet=json) as shown:
        try:
            summary = ingest(
                sources, output, params=params, units=units, reader=reader, mesh=mesh, time_step=time_step,
                names=run_names, parts=names(parts), exclude_parts=names(exclude_parts),
                keep_rigid_walls=keep_rigid_walls, fields=names(fields), time=times(time),
                on_error="skip" if on_error == "skip" else "stop", allow_incomplete=allow_incomplete,
                overwrite=overwrite, quality="refuse" if quality == "refuse" else "mark", limits=limits,
                workers=workers, scheduler=scheduler,
                report=shown.step,
            )  # fmt: skip
        except KeyboardInterrupt:
            partial = output.with_name(output.name + ".partial")
            kept = f"; finished runs are kept in {partial}, the same command goes on from there"
            fail(f"interrupted{kept if partial.exists() else ''}", code=130)
    if json:
        print_json(asdict(summary))
        return
    show(summary)
    what_next(output, ("info", output), ("coarsen", output))


def show(summary: IngestSummary) -> None:
    """What became of the runs."""
    for note in summary.notes:
        say(f"  {note}")
    for run, reason in summary.skipped.items():
        say(f"  skipped {run}: {reason}")
    for run, reason in list(summary.marked.items())[:_MOST_MARKED]:
        say(f"  marked {run}: {reason}")
    if len(summary.marked) > _MOST_MARKED:
        say(f"  and {len(summary.marked) - _MOST_MARKED} more runs marked: see quality_note in the dataset")
    errors = summary.alignment_error
    if any(errors.values()):
        table(
            "Runs interpolated to common times",
            ("run", "estimated error (mm)"),
            [(run, f"{1e3 * error:.3g}") for run, error in errors.items() if error > 0],
        )
    counts = [
        (len(summary.added), "new"),
        (len(summary.replaced), "replaced"),
        (len(summary.unchanged), "unchanged"),
        (len(summary.skipped), "skipped"),
    ]
    told = ", ".join(f"{count} {what}" for count, what in counts if count)
    resumed = f"; {summary.resumed} were read by an earlier start" if summary.resumed else ""
    if summary.scale is not None:
        say(f"  {summary.scale}")
    if summary.question:
        say(f"  {summary.question}")
    say(f"{summary.output}: {len(summary.runs)} runs ({told}{resumed}), {summary.states} states, {summary.nodes} nodes")


def _limits(texts: Iterable[str]) -> dict[str, float | None]:
    out: dict[str, float | None] = {}
    for text in texts:
        name, equals, value = (piece.strip() for piece in text.partition("="))
        try:
            out[name] = None if value == "none" else float(value.removesuffix("%"))
            if not equals or not (out[name] or 0.0) >= 0:
                raise ValueError
        except ValueError as error:
            raise typer.BadParameter(
                f"{text!r}; expected NAME=PER CENT, such as energy_error=5 or mass_added=none", param_hint="--limit"
            ) from error
    return out
