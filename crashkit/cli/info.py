"""`crashkit info`: what an engineer asks first about a dataset."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from crashkit.cli._console import console, print_json, table

if TYPE_CHECKING:
    import xarray as xr


def command(
    path: Annotated[Path, typer.Argument(help="Dataset (.zarr or .nc).", show_default=False)],
    json: Annotated[bool, typer.Option("--json", help="Print as JSON.")] = False,
) -> None:
    """Print runs, states, time span, mesh, parts, parameters, largest displacement, size, and the mesh hierarchy."""
    from crashkit.dataset import open_dataset

    with open_dataset(path) as dataset:
        found = describe(dataset, path)
    if json:
        print_json(found)
        return
    _print(found)


def describe(dataset: xr.Dataset, path: Path | None = None) -> dict[str, Any]:
    """The facts as a dictionary; lengths m, times s. Reads the displacements once, a run at a time."""
    from data_schema import fields, parameters

    size = dataset.sizes
    found: dict[str, Any] = {
        "path": str(path) if path else None,
        "solver": dataset.attrs.get("solver"),
        "runs": size["sim"],
        "states": size["time"],
        "time_begin": float(dataset["time"][0]),
        "time_end": float(dataset["time"][-1]),
        "nodes": size["node"],
        "faces": size["face"],
        "cells": size.get("cell", 0),
        "parts": [
            {"id": int(i), "name": str(n)}
            for i, n in zip(dataset["part_id"].values, dataset["part_name"].values, strict=True)
        ],
        "parameters": [
            {
                "name": n,
                "units": dataset[n].attrs.get("units", ""),
                "least": float(dataset[n].min()),
                "largest": float(dataset[n].max()),
            }
            for n in parameters(dataset)
        ],
        "fields": fields(dataset),
        "erodes": "alive" in dataset,
        "largest_displacement": _largest(dataset),
        "bytes_on_disk": _bytes(path) if path else None,
        "units_read": dataset.attrs.get("units_read"),
        "checksum": dataset.attrs.get("checksum"),
        "levels": _levels(path),
    }
    return found


def _largest(dataset: xr.Dataset) -> dict[str, Any]:
    import numpy as np

    best: dict[str, Any] = {"value": -1.0}
    for k in range(dataset.sizes["sim"]):
        u = dataset["displacement"].isel(sim=k).values
        length = np.sqrt(np.nan_to_num(np.einsum("tnx,tnx->tn", u, u, dtype=np.float64)))
        state, node = np.unravel_index(int(length.argmax()), length.shape)
        if length[state, node] > best["value"]:
            best = {
                "value": float(length[state, node]),
                "run": str(dataset["sim"].values[k]),
                "time": float(dataset["time"].values[state]),
                "node_id": int(dataset["node_id"].values[node]),
            }
    return best


def _bytes(path: Path) -> int:
    return sum(f.stat().st_size for f in path.rglob("*") if f.is_file()) if path.is_dir() else path.stat().st_size


def _levels(path: Path | None) -> list[dict[str, Any]]:
    from crashkit.errors import DataError
    from crashkit.mesh.store import summarize_hierarchy

    if path is None:
        return []
    try:
        return list(summarize_hierarchy(path))
    except DataError:
        return []


def _print(found: dict[str, Any]) -> None:
    out = console()
    parts = found["parts"]
    named = ", ".join(f"{p['id']} {p['name']}".strip() for p in parts[:6]) + (", ..." if len(parts) > 6 else "")
    most = found["largest_displacement"]
    out.print(
        f"{found['path']}  ({found['bytes_on_disk'] / 1e6:.1f} MB on disk, read in {found['units_read']}, kept in SI)"
    )
    out.print(f"  solver      {found['solver']}")
    out.print(f"  runs        {found['runs']}")
    out.print(f"  states      {found['states']}, {found['time_begin'] * 1e3:g} to {found['time_end'] * 1e3:g} ms")
    out.print(f"  mesh        {found['nodes']} nodes, {found['faces']} faces, {found['cells']} solids and beams")
    out.print(f"  parts       {len(parts)}: {named}")
    out.print(
        f"  fields      displacement{''.join(', ' + f for f in found['fields'])}{', alive' if found['erodes'] else ''}"
    )
    out.print(
        f"  largest     {most['value'] * 100:.1f} cm displacement (run {most['run']}, {most['time'] * 1e3:g} ms, node {most['node_id']})"
    )
    if found["parameters"]:
        table(
            "parameters",
            ("name", "least", "largest", "unit"),
            [(p["name"], f"{p['least']:g}", f"{p['largest']:g}", p["units"]) for p in found["parameters"]],
        )
    if found["levels"]:
        table(
            "mesh hierarchy",
            ("level", "nodes", "faces", "distance mean / max (mm)", "lifting error mean / max (cm)"),
            [
                (
                    level["level"],
                    level["nodes"],
                    level["faces"],
                    f"{level['distance_mean'] * 1e3:.2f} / {level['distance_max'] * 1e3:.1f}",
                    f"{level['lifting_error_mean'] * 100:.3f} / {level['lifting_error_max'] * 100:.2f}",
                )
                for level in found["levels"]
            ],
        )
    else:
        out.print("  no mesh hierarchy yet: crashkit coarsen makes one")
