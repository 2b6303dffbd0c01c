"""`crashkit evaluate`: ask every model for the test runs, and write the report and the ParaView files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crashkit.api.evaluate import best_folder, evaluate, whole_meshes
from crashkit.cli._console import fail, fixed, numbers, print_json, say, table, what_next
from crashkit.cli._progress import Progress

if TYPE_CHECKING:
    from evaluation.comparison.result import Evaluation


def command(
    dataset: Annotated[Path, typer.Argument(help="Dataset (.zarr or .nc).", show_default=False)],
    models: Annotated[list[Path], typer.Argument(help="Model folders made by `crashkit train`.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the report.")] = Path("report"),
    test: Annotated[
        str, typer.Option(help="Test runs: 27:36, or names.", show_default="those held out in training")
    ] = "",
    write_vtu: Annotated[bool, typer.Option("--write-vtu", help="Also write runs for ParaView, as PVD + VTU.")] = False,
    write_vtkhdf: Annotated[
        bool, typer.Option("--write-vtkhdf", help="Also write runs for ParaView, as VTKHDF.")
    ] = False,
    vtk_runs: Annotated[
        str, typer.Option(help="Runs written for ParaView.", show_default="worst and median run of the best model")
    ] = "",
    probes: Annotated[
        str, typer.Option(help="Node ids whose curves are compared: 12,340.", show_default="four, spread out")
    ] = "",
    intrusion: Annotated[
        str,
        typer.Option(
            help="Part and direction of the intrusion: floor:-x.", show_default="structure, against its motion"
        ),
    ] = "",
    workers: Annotated[int, typer.Option(min=1, help="Number of processes on this machine.")] = 1,
    scheduler: Annotated[
        str, typer.Option(help="Use this Dask scheduler (address) instead.", show_default="none")
    ] = "",
    seeds_as_spread: Annotated[
        bool, typer.Option(help="Show models that differ only in their seed as one row with its spread.")
    ] = True,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the report that is there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the performance table as JSON.")] = False,
) -> None:
    """Compare models on test runs none of them has seen: report, figures, numbers, ParaView files."""
    from dataclasses import asdict

    from evaluation.report.tables import performance

    with Progress(f"reading {dataset}", quiet=as_json) as shown:
        result = evaluate(
            dataset, models, output, test=test or None, write_vtu=write_vtu, write_vtkhdf=write_vtkhdf,
            vtk_runs=vtk_runs or None, probes=numbers(probes, "--probes", "12,340", whole=True) or None,
            intrusion=_part_and_direction(intrusion) if intrusion else None, workers=workers,
            scheduler=scheduler or None, seeds_as_spread=seeds_as_spread, overwrite=overwrite, report=shown.step,
        )  # fmt: skip
    if as_json:
        rows = performance(result)
        print_json({"output": output, "report": output / "report.html", "performance": [asdict(r) for r in rows]})
        return
    show(result)
    for file in whole_meshes(result, output):
        say(f"ParaView {file}")
    best = best_folder(result, models)
    what_next(output / "report.html", ("predict", best, "--run", result.test_names[0], "--dataset", dataset))


def show(result: Evaluation) -> None:
    """The warnings of the report, its first table and its recommendations."""
    from evaluation.report.tables import performance
    from evaluation.report.verdict import statements

    said = statements(result)
    for statement in said:
        if statement.kind == "warning":
            say(f"warning: {statement.about}: {statement.text}")
    rows = performance(result)
    several = any(row.seeds > 1 for row in rows)
    table(
        f"Mean node error of {len(result.runs)} test runs on the full mesh, cm",
        ("model", "nodes", "error", *(["± seeds"] if several else []), "% of motion", "worst run", "train s", "ms"),
        (
            (
                r.model, r.nodes, f"{r.error_cm:.3f}", *([fixed(r.spread_cm, 3)] if several else []),
                f"{100 * r.relative:.1f}", f"{r.worst_run_cm:.2f}", fixed(r.training_s, 0),
                "-" if r.prediction_lifted_ms != r.prediction_lifted_ms else f"{r.prediction_lifted_ms:.2g}",
            )
            for r in rows
        ),
    )  # fmt: skip
    for statement in said:
        if statement.kind == "use":
            say(f"  {statement.about}: {statement.text}")


def _part_and_direction(text: str) -> tuple[str, str]:
    part, colon, direction = text.rpartition(":")
    if not colon or not part:
        fail(f"--intrusion {text!r} not understood; expected a part and a direction, such as floor:-x", code=2)
    return part, direction
