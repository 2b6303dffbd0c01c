"""`crashkit info`: what an engineer asks first about a dataset."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from crashkit.cli._console import console, print_json, progress, say, table

if TYPE_CHECKING:
    import xarray as xr

# How values of these units are shown to people: factor and unit. JSON keeps SI.
_SHOWN = {"Pa": (1e-6, "MPa"), "s": (1e3, "ms"), "m": (1e3, "mm")}


def describe(dataset: xr.Dataset, path: Path) -> dict[str, Any]:
    """The facts about the dataset at `path` in SI units; reads the displacements once, block by block.

    Raises ReadError if values cannot be read.
    """
    from data_schema import fields, parameters

    size = dataset.sizes
    part_faces = _counts(dataset, "face_part")
    part_cells = _counts(dataset, "cell_part")
    known = dataset.attrs
    return {
        "path": path,
        "bytes_on_disk": _bytes(path),
        "title": known.get("title"),
        "solver": known.get("solver"),
        "units_read": known.get("units_read"),
        "runs": size["sim"],
        "incomplete_runs": [str(n) for n in dataset["sim"].values[~dataset["complete"].values]] if "complete" in dataset else [],
        "states": size["time"],
        "time_begin": float(dataset["time"].values[0]),
        "time_end": float(dataset["time"].values[-1]),
        "alignment_error": float(dataset["alignment_error"].max()) if "alignment_error" in dataset else None,
        "nodes": size["node"],
        "faces": size["face"],
        "cells": size.get("cell", 0),
        "one_shape": "sim" not in dataset["reference_position"].dims,
        "parts": [
            {"id": int(number), "name": str(name), "faces": part_faces[k], "cells": part_cells[k]}
            for k, (number, name) in enumerate(zip(dataset["part_id"].values, dataset["part_name"].values, strict=True))
        ],
        "parameters": [
            {
                "name": name,
                "units": str(dataset[name].attrs.get("units", "")),
                "least": float(dataset[name].min()),
                "largest": float(dataset[name].max()),
            }
            for name in parameters(dataset)
        ],
        "fields": [
            {"name": name, "on": str(dataset[name].dims[2]), "units": str(dataset[name].attrs.get("units", ""))}
            for name in fields(dataset)
        ],
        "erodes": "alive" in dataset or "cell_alive" in dataset,
        "largest_displacement": _largest(dataset),
        "checksum": known.get("checksum"),
        "levels": _levels(path),
    }  # fmt: skip


def _counts(dataset: xr.Dataset, name: str) -> list[int]:
    import numpy as np

    owners = dataset[name].values if name in dataset else np.empty(0, int)
    return [int(n) for n in np.bincount(owners, minlength=dataset.sizes["part"])]


def _largest(dataset: xr.Dataset) -> dict[str, Any]:
    """The largest displacement of all: value (m), run, time (s), node_id; an empty dictionary if none is a number."""
    import numpy as np

    from data_schema.checksum import result_blocks

    best: dict[str, Any] = {}
    for k, run in enumerate(dataset["sim"].values):
        for first, _, u in result_blocks(dataset["displacement"].isel(sim=k)):
            squared = np.nan_to_num(np.einsum("tnx,tnx->tn", u, u), nan=-1.0)
            state, node = (int(i) for i in np.unravel_index(int(squared.argmax()), squared.shape))
            value = float(squared[state, node])
            if value >= 0 and value**0.5 > best.get("value", -1.0):
                best = {
                    "value": value**0.5,
                    "run": str(run),
                    "time": float(dataset["time"].values[state]),
                    "node_id": int(dataset["node_id"].values[first + node]),
                }
    return best


def _bytes(path: Path) -> int:
    return sum(f.stat().st_size for f in path.rglob("*") if f.is_file()) if path.is_dir() else path.stat().st_size


def _levels(path: Path) -> list[dict[str, Any]]:
    from crashkit.mesh.store import has_hierarchy, summarize_hierarchy

    return list(summarize_hierarchy(path)) if has_hierarchy(path) else []


def command(
    path: Annotated[Path, typer.Argument(help="Dataset (.zarr or .nc).", show_default=False)],
    as_json: Annotated[bool, typer.Option("--json", help="Print as JSON, in SI units.")] = False,
    report: Annotated[
        Path | None,
        typer.Option(
            help="Folder for a data card: coverage, singular values, envelopes, unusual runs.", show_default="none"
        ),
    ] = None,
) -> None:
    """Print runs, states, time span, mesh, parts, parameters, largest displacement, size, and the mesh hierarchy."""
    from crashkit.dataset import open_dataset, reading
    from crashkit.extras import need

    with open_dataset(path, chunks=None) as dataset, reading(path):
        found = describe(dataset, path)
        if report is not None:
            need("a data card (--report)", "report")
            from evaluation.report.datacard import write_card

            with progress() as bar:
                task = bar.add_task("runs", total=dataset.sizes["sim"], note="")
                found["report"] = write_card(
                    dataset, report, about={"Dataset": path.name}, done=lambda run: bar.advance(task)
                )
    if as_json:
        print_json(found)
        return
    _print(found)
    if report is not None:
        say(f"data card: {found['report']}")


def _print(found: dict[str, Any]) -> None:
    out = console()

    def line(name: str, text: str) -> None:
        out.print(f"  {name:<11} {text}", markup=False)

    out.print(f"{found['path']}: {found['bytes_on_disk'] / 1e6:.1f} MB on disk", markup=False)
    line("solver", f"{found['solver']}; read in {found['units_read']}, kept in SI")
    incomplete = found["incomplete_runs"]
    line("runs", f"{found['runs']}" + (f", incomplete: {_listed(incomplete)}" if incomplete else ""))
    moved = found["alignment_error"]
    line(
        "states",
        f"{found['states']}, {_shown(found['time_begin'], 's')} to {_shown(found['time_end'], 's')}"
        + (f", brought to common times (error up to {_shown(moved, 'm')})" if moved else ""),
    )
    shapes = "" if found["one_shape"] else "; every run has its own shape"
    line("mesh", f"{found['nodes']} nodes, {found['faces']} faces, {found['cells']} solids and beams{shapes}")
    line("parts", _listed([f"{p['id']} {p['name']} ({_elements(p)})" for p in found["parts"]]))
    fields = [f"{f['name']} ({f['units']}, on {f['on']}s)" for f in found["fields"]]
    line("fields", ", ".join(["displacement (m, on nodes)", *fields]) + ("; elements erode" if found["erodes"] else ""))
    most = found["largest_displacement"]
    if most:
        where = f"run {most['run']}, {_shown(most['time'], 's')}, node {most['node_id']}"
        line("largest", f"displacement {_shown(most['value'], 'm')} ({where})")
    if found["parameters"]:
        rows = [
            (
                p["name"],
                *(_shown(p[end], p["units"], with_unit=False) for end in ("least", "largest")),
                _unit(p["units"]),
            )
            for p in found["parameters"]
        ]
        table("parameters", ("name", "least", "largest", "unit"), rows)
    else:
        line("parameters", "none")
    if not found["levels"]:
        line("hierarchy", "none yet; crashkit coarsen makes one")
        return
    table(
        "mesh hierarchy",
        ("level", "nodes", "faces", "distance mean / max (mm)", "lifting error mean / max (cm)"),
        [
            (
                level["level"], level["nodes"], level["faces"],
                f"{level['distance_mean'] * 1e3:.2f} / {level['distance_max'] * 1e3:.1f}",
                f"{level['lifting_error_mean'] * 100:.3f} / {level['lifting_error_max'] * 100:.2f}",
            )
            for level in found["levels"]
        ],
    )  # fmt: skip


def _shown(value: float, unit: str, *, with_unit: bool = True) -> str:
    factor = _SHOWN.get(unit, (1.0, unit))[0]
    return f"{factor * value:.4g}" + (f" {_unit(unit)}" if with_unit else "")


def _unit(unit: str) -> str:
    return _SHOWN.get(unit, (1.0, unit))[1]


def _elements(part: dict[str, Any]) -> str:
    counts = [f"{part[kind]} {kind}" for kind in ("faces", "cells") if part[kind]]
    return ", ".join(counts) or "empty"


def _listed(texts: Iterable[str], most: int = 8) -> str:
    known = list(texts)
    return ", ".join(known[:most]) + (f" and {len(known) - most} more" if len(known) > most else "")
