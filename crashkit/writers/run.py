"""One run as a labelled dataset, written for ParaView with the solver's numbers, parts, parameters and fields."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import DataError
from crashkit.writers.paraview import write_paraview
from data_schema import fields, parameters, table_unit

if TYPE_CHECKING:
    import xarray as xr

_VTK_LINE = 3


def write_run(run: xr.Dataset, output: str | Path, about: Mapping[str, str] | None = None) -> list[Path]:
    """Write `run`, a crash dataset without `sim` (one run of it, or a prediction), to `output` by its suffix.

    Parameters
    ----------
    run
        Displacements (time, node, xyz), the mesh, and what else is known: fields on nodes, faces and cells, what is
        alive, node, element and part numbers, part names, parameters. Beams, and pairs of nodes in `line_nodes`, are
        drawn as lines.
    output
        `.pvd`, `.vtkhdf`, or `.vtu` and `.vtp` for a single state.
    about
        Texts to stand in the file, such as the name of the run or of the model.

    Returns
    -------
    list of Path
        The files written, the one to open first.

    Raises
    ------
    DataError
        Where the dataset has no mesh, or a single-state file was asked for several states.
    OutputError
        Where `output` cannot be written.
    """
    output = Path(output)
    if "reference_position" not in run or "face_nodes" not in run:
        raise DataError(f"{output}: the run has no mesh to be drawn on; expected reference_position and face_nodes")
    states = run.sizes["time"]
    if output.suffix in (".vtu", ".vtp") and states != 1:
        raise DataError(f"{output}: holds one state, and there are {states}; choose one, or write .pvd")
    lines, of_lines = _lines(run)
    points: dict[str, Any] = {"displacement": run["displacement"].values}
    cells: dict[str, Any] = {}
    units = {"displacement": "m"}
    for name in fields(run):
        values, on = run[name].values, run[name].dims[1]
        units[name] = str(run[name].attrs.get("units", ""))
        if on == "node":
            points[name] = values
        elif on == "face":
            cells[name] = _with_lines(values, np.full((states, len(lines), *values.shape[2:]), np.nan, values.dtype))
        elif on == "cell" and len(lines) and name not in cells:
            beams = values[:, of_lines]
            nothing = np.full((states, run.sizes["face"], *values.shape[2:]), np.nan, values.dtype)
            cells[name] = _with_lines(nothing, beams)
    points |= {"node_id": run["node_id"].values} if "node_id" in run else {}
    cells |= _numbers(run, lines, of_lines)
    return write_paraview(
        output, run["reference_position"].values, run["face_nodes"].values, run["time"].values, points, cells,
        lines=lines, units={n: u for n, u in units.items() if u}, field_data=_about(run, about or {}),
        alive=run["alive"].values if "alive" in run else None,
    )  # fmt: skip


def _lines(run: xr.Dataset) -> tuple[NDArray[np.integer], NDArray[np.int64]]:
    """Pairs of nodes (e, 2), and which cells they are; no cells where they are sides without a face."""
    if "line_nodes" in run:
        return run["line_nodes"].values, np.empty(0, np.int64)
    if "cell_type" not in run:
        return np.empty((0, 2), np.int64), np.empty(0, np.int64)
    which = np.flatnonzero(run["cell_type"].values == _VTK_LINE)
    return run["cell_nodes"].values[which, :2], which


def _with_lines(faces: NDArray[Any], lines: NDArray[Any]) -> NDArray[Any]:
    return np.concatenate([faces, lines], axis=1) if lines.shape[1] else faces


def _numbers(run: xr.Dataset, lines: NDArray[np.integer], of_lines: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """Element and part numbers on faces, then lines; -1 where a line is no element."""
    out = {}
    none = np.full(len(lines), -1, np.int64)
    if "face_id" in run:
        beams = run["cell_id"].values[of_lines] if len(of_lines) and "cell_id" in run else none
        out["element_id"] = np.concatenate([run["face_id"].values, beams])
    if "face_part" in run and "part_id" in run:
        number = run["part_id"].values
        beams = number[run["cell_part"].values[of_lines]] if len(of_lines) and "cell_part" in run else none
        out["part_id"] = np.concatenate([number[run["face_part"].values], beams])
    return {name: _small(values) for name, values in out.items()}


def _small(values: NDArray[Any]) -> NDArray[Any]:
    """Numbers in four bytes where they fit: they stand in every VTU of a series."""
    return values.astype(np.int32) if abs(values).max(initial=0) < 2**31 else values


def _about(run: xr.Dataset, about: Mapping[str, str]) -> dict[str, Any]:
    """Field data: texts, parameters in the unit of their table, and the names of the parts."""
    out: dict[str, Any] = {_plain(name): text for name, text in about.items()}
    for name in parameters(run):
        unit, factor = table_unit(run, name)
        out[_plain(name)] = float(run[name]) / factor
        out[_plain(f"{name}_unit")] = unit
    if "part_name" in run:
        out["part_name"] = [str(name) for name in run["part_name"].values]
        out["part_number"] = run["part_id"].values
    return out


def _plain(name: str) -> str:
    return name.replace("/", "_").replace(".", "_")
