"""`crashkit evaluate`: ask every model for the test runs, and write the report and the ParaView files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from crashkit.api.evaluate import evaluate
from crashkit.cli._console import fail, print_json, progress, say, table

if TYPE_CHECKING:
    pass


def command(
    dataset: Annotated[Path, typer.Argument(help="Dataset (.zarr or .nc).", show_default=False)],
    models: Annotated[list[Path], typer.Argument(help="Model folders made by `crashkit train`.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the report.")] = Path("report"),
    test: Annotated[
        str, typer.Option(help="Test runs: 27:36, or names with commas.", show_default="those the models hold out")
    ] = "",
    write_vtu: Annotated[
        bool, typer.Option("--write-vtu", help="Also write PVD + VTU and VTKHDF for ParaView.")
    ] = False,
    vtk_runs: Annotated[
        str, typer.Option(help="Runs written for ParaView.", show_default="the worst and the median of the best model")
    ] = "",
    probes: Annotated[
        str, typer.Option(help="Nodes whose histories are compared: 12,340.", show_default="four, spread out")
    ] = "",
    intrusion: Annotated[
        str, typer.Option(help="Part and direction: floor:-x.", show_default="the structure, against its motion")
    ] = "",
    workers: Annotated[int, typer.Option(min=1, help="Processes that share the test runs.")] = 1,
    scheduler: Annotated[str, typer.Option(help="Address of a Dask scheduler instead.", show_default="none")] = "",
    seeds_as_spread: Annotated[
        bool, typer.Option(help="Models that differ only in their seed make one row with its spread.")
    ] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print the performance table as JSON.")] = False,
) -> None:
    """Compare models on runs they have never seen: report, figures, numbers, ParaView files."""
    from dataclasses import asdict

    from crashkit.dataset import open_dataset
    from evaluation.report.tables import performance
    from evaluation.report.verdict import statements

    names = tuple(map(str, open_dataset(dataset)["sim"].values)) if test or vtk_runs else ()
    with progress() as bar:
        tasks: dict[str, Any] = {}

        def follow(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=total or None, note="")
                if bar.disable:
                    say(f"{what} ...")
            bar.update(tasks[what], completed=done)

        result = evaluate(
            dataset, models, output,
            test=_named(names, test) if test else None,
            write_vtu=write_vtu,
            vtk_runs=_named(names, vtk_runs if ":" in vtk_runs else vtk_runs.split(",")) if vtk_runs else None,
            probes=_node_numbers(probes) if probes else None,
            intrusion=_part_and_direction(intrusion) if intrusion else None,
            workers=workers, scheduler=scheduler or None, seeds_as_spread=seeds_as_spread, report=follow,
        )  # fmt: skip
    rows = performance(result)
    if as_json:
        print_json({"output": output, "report": output / "report.html", "performance": [asdict(r) for r in rows]})
        return
    several = any(row.seeds > 1 for row in rows)
    table(
        f"Mean node error of {len(result.runs)} test runs on the full mesh, cm",
        ("model", "nodes", "error", *(["± seeds"] if several else []), "% of motion", "worst run", "train s", "ms"),
        (
            (
                r.model, r.nodes, f"{r.error_cm:.3f}", *([_or_dash(r.spread_cm, ".3f")] if several else []),
                f"{100 * r.relative:.1f}", f"{r.worst_run_cm:.2f}", _or_dash(r.training_s, ".0f"),
                _or_dash(r.prediction_lifted_ms, ".2g"),
            )
            for r in rows
        ),
    )  # fmt: skip
    for said in statements(result):
        if said.kind == "use":
            say(f"  {said.about}: {said.text}")
    say("")
    for path in (output / "report.html", output / "report.json", *sorted((output / "vtk").glob("*.pvd"))):
        say(f"  {path}")


def _named(names: Sequence[str], chosen: str | list[str]) -> list[str]:
    """Names of the runs that an option means."""
    from crashkit.selection import runs_of

    return [names[k] for k in runs_of(names, chosen)]


def _node_numbers(text: str) -> list[int]:
    try:
        return [int(piece) for piece in text.split(",")]
    except ValueError:
        fail(f"--probes {text!r} not understood; expected node numbers with commas, such as 12,340", code=2)


def _part_and_direction(text: str) -> tuple[str, str]:
    part, colon, direction = text.rpartition(":")
    if not colon or not part:
        fail(f"--intrusion {text!r} not understood; expected a part and a direction, such as floor:-x", code=2)
    return part, direction


def _or_dash(value: float, form: str) -> str:
    return format(value, form) if value == value else "–"
