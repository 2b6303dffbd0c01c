"""`crashkit ingest`: solver runs in, one dataset out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crashkit.cli._console import fail, print_json, progress, say, table

# Where no progress bar can be shown.
_SECONDS_BETWEEN_LINES = 10


def command(
    sources: Annotated[list[Path], typer.Argument(help="Files or folders with runs.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", help="Dataset to write: NAME.zarr or NAME.nc.")],
    params: Annotated[
        Path | None, typer.Option(help="Table of design parameters, a row a run: CSV, JSON or XLSX.")
    ] = None,
    units: Annotated[str | None, typer.Option(help="Unit system of the source: SI, mm-ms-kg, mm-s-t, ...")] = None,
    reader: Annotated[str | None, typer.Option(help="Source format, where it shall not be told by content.")] = None,
    mesh: Annotated[Path | None, typer.Option(help="Mesh file with the faces, where the source has none.")] = None,
    time_step: Annotated[
        float | None,
        typer.Option(
            help="Time between two states, in the source's unit, where the source has none.", show_default=False
        ),
    ] = None,
    names: Annotated[
        str, typer.Option(help="Names of the runs, from {run} and {source}, such as {source}-{run}.")
    ] = "{run}",
    parts: Annotated[str, typer.Option(help="Only these parts: numbers, titles or patterns, with commas.")] = "",
    exclude_parts: Annotated[str, typer.Option(help="Without these parts.")] = "",
    keep_rigid_walls: Annotated[
        bool, typer.Option("--keep-rigid-walls", help="Keep what the solver drew of walls.")
    ] = False,
    fields: Annotated[str, typer.Option(help="Further result fields, such as plastic_strain,velocity.")] = "",
    time: Annotated[
        str, typer.Option(help="Common output times: begin:end:count, s. Default: the coarsest run's.")
    ] = "",
    on_error: Annotated[str, typer.Option(help="stop, or skip runs that cannot be used.")] = "stop",
    allow_incomplete: Annotated[
        bool, typer.Option("--allow-incomplete", help="Take runs that were cut short.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Read runs again that the dataset already holds.")
    ] = False,
    workers: Annotated[int, typer.Option(help="Processes on this machine.", min=1)] = 1,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler to use instead.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Read solver runs, check them, and write them as one labelled dataset in SI units.

    Interrupted or killed, the same command goes on where it was. New runs are appended to an existing dataset.
    """
    from dataclasses import asdict
    from time import monotonic

    from crashkit.ingestion.ingest import ingest

    if on_error not in ("stop", "skip"):
        raise typer.BadParameter(f"{on_error!r}; expected stop or skip", param_hint="--on-error")
    with progress(quiet=json) as bar:
        task = bar.add_task("ingest", total=None, note="")
        last = monotonic()

        def tell(done: int, total: int, note: str) -> None:
            nonlocal last
            bar.update(task, completed=done, total=total or None, note=note)
            if bar.disable and not json and monotonic() - last > _SECONDS_BETWEEN_LINES:
                last = monotonic()
                say(f"{done} of {total or '?'} runs, {note}")

        try:
            summary = ingest(
                sources, output, params=params, units=units, reader=reader, mesh=mesh, time_step=time_step, names=names,
                parts=_list(parts), exclude_parts=_list(exclude_parts), keep_rigid_walls=keep_rigid_walls,
                fields=_list(fields), time=_times(time), on_error="skip" if on_error == "skip" else "stop",
                allow_incomplete=allow_incomplete, overwrite=overwrite, workers=workers, scheduler=scheduler,
                progress=tell,
            )  # fmt: skip
        except KeyboardInterrupt:
            partial = output.with_name(output.name + ".partial")
            kept = f"; finished runs are kept in {partial}, the same command goes on from there"
            fail(f"interrupted{kept if partial.exists() else ''}", code=130)
    if json:
        print_json(asdict(summary))
        return
    for note in summary.notes:
        say(f"  {note}")
    for run, reason in summary.skipped.items():
        say(f"  skipped {run}: {reason}")
    errors = summary.alignment_error
    if any(errors.values()):
        table(
            "Runs brought to common times",
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
    say(f"{summary.output}: {len(summary.runs)} runs ({told}{resumed}), {summary.states} states, {summary.nodes} nodes")


def _list(text: str) -> list[str]:
    return [piece.strip() for piece in text.split(",") if piece.strip()]


def _times(text: str) -> list[float] | None:
    if not text:
        return None
    try:
        begin, end, count = text.split(":")
        first, last, n = float(begin), float(end), int(count)
        if n < 2 or last <= first:
            raise ValueError
    except ValueError as error:
        raise typer.BadParameter(
            f"{text!r}; expected begin:end:count, such as 0:0.03:61", param_hint="--time"
        ) from error
    return [first + (last - first) * k / (n - 1) for k in range(n)]
