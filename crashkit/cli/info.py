"""`crashkit info`: what an engineer asks first about a dataset, a model or a report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from crashkit.cli._console import console, print_json, table, what_next
from crashkit.cli._progress import Progress
from crashkit.display import listed, seeds_told

# How values of these units are shown to people: factor and unit. JSON keeps SI.
_SHOWN = {"Pa": (1e-6, "MPa"), "s": (1e3, "ms"), "m": (1e3, "mm")}
_SPLIT = (("training_runs", "training"), ("validation_runs", "validation"), ("held_out_runs", "held out for testing"))


def command(
    path: Annotated[
        Path, typer.Argument(help="Dataset (.zarr or .nc), model folder or report folder.", show_default=False)
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print as JSON, in SI units.")] = False,
    report: Annotated[
        Path | None,
        typer.Option(
            help="Also write a data card of the dataset (coverage, singular values, unusual runs) into this folder.",
            show_default="none",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the data card that is there.")] = False,
) -> None:
    """Describe a dataset, a model folder or a report.

    Of a dataset: runs, states, mesh, parts, parameters with their units, largest displacement, mesh hierarchy.
    """
    from crashkit.api.describe import describe, kind_of

    with Progress(f"reading {path}", quiet=as_json) as shown:
        found = describe(path, card=report, overwrite=overwrite, report=shown.step)
    if as_json:
        print_json(found)
    else:
        {"dataset": _print_dataset, "model": _print_model, "report": _print_report}[kind_of(path)](found)


def _print_dataset(found: dict[str, Any]) -> None:
    out = console()

    def line(name: str, text: str) -> None:
        out.print(f"  {name:<11} {text}", markup=False)

    out.print(f"{found['path']}: {found['bytes_on_disk'] / 1e6:.1f} MB on disk", markup=False)
    line("solver", f"{found['solver']}; read in {found['units_read']}, kept in SI")
    incomplete = found["incomplete_runs"]
    line("runs", f"{found['runs']}" + (f", incomplete: {listed(incomplete, most=8)}" if incomplete else ""))
    if found["marked_runs"]:
        line("marked", listed([f"{run} ({why})" for run, why in found["marked_runs"].items()], most=3))
    moved = found["alignment_error"]
    line(
        "states",
        f"{found['states']}, {_shown(found['time_begin'], 's')} to {_shown(found['time_end'], 's')}"
        + (f", interpolated to common times (error up to {_shown(moved, 'm')})" if moved else ""),
    )
    shapes = "" if found["one_shape"] else "; every run has its own shape"
    line("mesh", f"{found['nodes']} nodes, {found['faces']} faces, {found['cells']} solids and beams{shapes}")
    line("parts", listed([f"{p['id']} {p['name']} ({_elements(p)})" for p in found["parts"]], most=8))
    fields = [f"{f['name']} ({f['units']}, on {f['on']}s)" for f in found["fields"]]
    line("fields", ", ".join(["displacement (m, on nodes)", *fields]) + ("; elements erode" if found["erodes"] else ""))
    most = found["largest_displacement"]
    if most:
        where = f"run {most['run']}, {_shown(most['time'], 's')}, node {most['node_id']}"
        line("largest", f"displacement {_shown(most['value'], 'm')} ({where})")
    if found["parameters"]:
        _print_parameters(found["parameters"])
    else:
        line("parameters", "none")
    if found["levels"]:
        _print_levels(found["levels"], found["interpolation_errors_over"])
    else:
        line("hierarchy", f"none yet; make one with crashkit coarsen {found['path']}")
    if "report" in found:
        what_next(found["report"])


def _print_levels(levels: list[dict[str, Any]], over: str) -> None:
    table(
        f"mesh hierarchy, interpolation errors over {over}",
        ("level", "nodes", "faces", "distance mean / max (cm)", "interpolation error mean / max (cm)"),
        [
            (
                level["level"], level["nodes"], level["faces"],
                f"{level['distance_mean'] * 100:.3f} / {level['distance_max'] * 100:.2f}",
                f"{level['lifting_error_mean'] * 100:.3f} / {level['lifting_error_max'] * 100:.2f}",
            )
            for level in levels
        ],
    )  # fmt: skip


def _print_parameters(known: list[dict[str, Any]]) -> None:
    """Ranges in the units of the parameter table, in which numbers given to `crashkit predict` are understood."""
    rows = [
        (p["name"], *(f"{p[end] / p['table_factor']:.6g}" for end in ("min", "max")), p["table_units"]) for p in known
    ]
    table("parameters", ("name", "min", "max", "unit"), rows)


def _print_model(found: dict[str, Any]) -> None:
    out = console()
    out.print(
        f"{found['path']}: {found['kind']} model ({found['preset']}), {found['bytes_on_disk'] / 1e6:.1f} MB, trained "
        f"{found['created']} with {seeds_told(found['seeds'])}",
        markup=False,
    )
    out.print(f"  dataset     {found.get('dataset', 'unknown')}, checksum {found['checksum'][:12]}", markup=False)
    runs = [f"{len(found[k])} {what}" for k, what in _SPLIT if found[k]]
    out.print(f"  runs        {', '.join(runs)}", markup=False)
    if found["coarse"]:
        out.print(f"  coarse runs {found['coarse']}", markup=False)
    for level, told in found["coarse_levels"].items():
        out.print(f"              on {level}: {told}", markup=False)
    span = f"{_shown(found['time_begin'], 's')} to {_shown(found['time_end'], 's')}"
    out.print(f"  states      {found['states']}, {span}; full mesh {found['nodes']} nodes", markup=False)
    _print_parameters(found["parameters"])
    table(
        "levels",
        ("model", "level", "nodes", "latent", "parameters", f"{found['error_name']} (cm)", "on the full mesh (cm)", "band"),
        [
            (
                r["model"], r["level"], r["nodes"], r["latent"], r["parameters"],
                *("-" if r[k] is None else f"{100 * r[k]:.2f}" for k in ("validation_error", "validation_error_full")),
                "yes" if r["has_band"] else "no",
            )
            for r in found["levels"]
        ],
    )  # fmt: skip
    for note in found["notes"]:
        out.print(f"  note: {note}", markup=False)


def _print_report(found: dict[str, Any]) -> None:
    rows = [
        (
            str(r.get("model")), *(_number(r.get(k), 1.0) for k in ("nodes", "error_cm")),
            _number(r.get("relative"), 100.0), _number(r.get("worst_run_cm"), 1.0),
        )
        for r in found["performance"]
    ]  # fmt: skip
    runs = found.get("test_runs", [])
    table(
        f"{found['path']}: mean node error of {len(runs)} test runs on the full mesh, cm",
        ("model", "nodes", "error", "% of motion", "worst run"),
        rows,
    )
    what_next(Path(found["path"]) / "report.html")


def _number(value: object, factor: float) -> str:
    return f"{factor * value:.4g}" if isinstance(value, (int, float)) else "-"


def _shown(value: float, unit: str) -> str:
    return f"{_SHOWN.get(unit, (1.0, unit))[0] * value:.4g} {_unit(unit)}"


def _unit(unit: str) -> str:
    return _SHOWN.get(unit, (1.0, unit))[1]


def _elements(part: dict[str, Any]) -> str:
    counts = [f"{part[kind]} {kind}" for kind in ("faces", "cells") if part[kind]]
    return ", ".join(counts) or "empty"
