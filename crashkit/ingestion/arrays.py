"""A crash dataset from NumPy arrays: results of another solver, a database or a formula."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crashkit.errors import DataError, OutputError, ReadError
from crashkit.version import __version__
from data_schema.layout import CONVENTIONS, DIMENSIONS, VARIABLES
from data_schema.units import UnknownUnits, to_si, unit_system

if TYPE_CHECKING:
    import xarray as xr

    from crashkit.ingestion.store import ArraySpec

_BEHIND = {(): (), (3,): ("xyz",), (6,): ("tensor",)}


def from_arrays(
    displacement: ArrayLike,
    time: ArrayLike,
    parameters: Mapping[str, ArrayLike],
    position: ArrayLike,
    faces: ArrayLike,
    *,
    names: Sequence[str] | None = None,
    units: str = "SI",
    parameter_units: Mapping[str, str] | None = None,
    node_id: ArrayLike | None = None,
    face_part: ArrayLike | None = None,
    part_id: ArrayLike | None = None,
    part_names: Sequence[str] | None = None,
    fields: Mapping[str, tuple[ArrayLike, str]] | None = None,
    alive: ArrayLike | None = None,
    history: Mapping[str, tuple[ArrayLike, str]] | None = None,
    history_time: ArrayLike | None = None,
    solver: str = "arrays",
    title: str = "",
    output: str | Path | None = None,
) -> xr.Dataset:
    """A crash dataset made of arrays, for `train`, `coarsen`, `evaluate` and all else that takes one.

    Parameters
    ----------
    displacement
        (sim, time, node, 3), from `position`, zero in the first state. NaN only where all faces of a node are gone.
    time
        (state,), increasing; the same for all runs.
    parameters
        Design parameters: name, or "name (unit)" as in "speed (km/h)", -> (sim,) values. They are changed to SI.
    position
        (node, 3) undeformed, the same for all runs.
    faces
        (face, 3) or (face, 4) 0-based nodes of each triangle or quadrilateral; -1 in the last corner of a triangle
        among quadrilaterals.
    names
        (sim,) names of the runs; run_00, run_01, ... without.
    units
        Unit system of `displacement`, `position` and the times: "SI" or length-time-mass such as "mm-ms-kg".
    parameter_units
        Parameter name -> unit, where the name does not say it; without either it is a plain number.
    node_id
        (node,) the solver's node numbers; 1, 2, ... without.
    face_part
        (face,) place of each face's part in `part_id`; one part without.
    part_id, part_names
        (part,) the solver's part numbers, and titles.
    fields
        Name -> (values, unit), with values (sim, time, node or face), or with 3 or 6 components behind. Changed to SI.
    alive
        (sim, time, face) bool, False once the face has eroded.
    history
        Time histories: name -> (values (sim, sample), unit). Changed to SI.
    history_time
        (sample,) times of the histories, the same for all runs; `time` without.
    solver, title
        What computed the runs, and a name for people.
    output
        Write it there, too, as NAME.zarr or NAME.nc, and return the dataset opened from there; there must be nothing yet.

    Returns
    -------
    xarray.Dataset
        In which `crashkit.validate` finds nothing.

    Raises
    ------
    DataError
        Naming the argument, what was found and what was expected.
    OutputError
        Where `output` is there already, or cannot be written.
    """
    import xarray as xr

    from crashkit.dataset import open_dataset
    from data_schema import dataset_checksum, digests_of_run, run_checksum, validate

    target = _free(Path(output)) if output is not None else None
    try:
        system = unit_system(units)
    except UnknownUnits as error:
        raise DataError(f"units: {error}") from error

    moved = _numbers("displacement", displacement, ("sim", "time", "node", 3), {})
    sizes = dict(zip(("sim", "time", "node"), moved.shape))
    states = _increasing("time", _numbers("time", time, ("time",), sizes))
    at = _numbers("position", position, ("node", 3), sizes)
    _finite("position", at)
    corners = _faces(faces, sizes["node"])
    sizes["face"] = len(corners)
    runs = _texts(
        "names", names, "sim", sizes, [f"run_{k:0{max(2, len(str(sizes['sim'] - 1)))}d}" for k in range(sizes["sim"])]
    )
    part = _integers("face_part", face_part, ("face",), sizes, np.zeros(len(corners), np.int32)).astype(np.int32)
    sizes["part"] = len(np.atleast_1d(part_id if part_id is not None else part_names or range(int(part.max()) + 1)))
    if part.min() < 0 or part.max() >= sizes["part"]:
        raise DataError(
            f"face_part: holds {part.min()} to {part.max()}; expected 0 to {sizes['part'] - 1}, places of parts"
        )
    numbers = _integers("part_id", part_id, ("part",), sizes, np.arange(1, sizes["part"] + 1))

    ds = xr.Dataset(
        {
            "displacement": (
                ("sim", "time", "node", "xyz"), (moved * system.length).astype(np.float32),
                {"units": "m", "long_name": "displacement from the reference position"},
            ),
            "reference_position": (
                ("node", "xyz"), at * system.length, {"units": "m", "long_name": "undeformed position"}
            ),
            "node_id": ("node", _integers("node_id", node_id, ("node",), sizes, np.arange(1, len(at) + 1))),
            "face_nodes": (("face", "corner"), corners),
            "face_part": ("face", part),
            "face_id": ("face", np.arange(1, len(corners) + 1)),
            "part_id": ("part", numbers),
            "part_name": ("part", _texts("part_names", part_names, "part", sizes, [f"part {k}" for k in numbers])),
            "complete": ("sim", np.ones(len(runs), bool)),
        },
        coords={"sim": runs, "time": ("time", states * system.time, {"units": "s", "long_name": "time"})},
    )  # fmt: skip
    if alive is not None:
        ds["alive"] = (("sim", "time", "face"), _shaped("alive", alive, ("sim", "time", "face"), sizes).astype(bool))
    own = _parameters(parameters, parameter_units or {}, sizes)
    for name, (in_si, unit, written) in own.items():
        ds[name] = ("sim", in_si, {"units": unit, "role": "parameter", "table_units": written or unit})
    for name, (values, unit) in (fields or {}).items():
        factor, si = _unit(f"fields, {name}", unit)
        if name in ds.variables or name in VARIABLES or name in DIMENSIONS:
            raise DataError(f"fields: a field cannot be called {name!r}, which means something else; rename it")
        dims, found = _field(f"fields, {name}", values, sizes)
        ds[name] = (dims, (found * factor).astype(np.float32), {"units": si, "role": "field"})
    if history:
        ds = _with_history(ds, history, states if history_time is None else history_time, system.time, sizes)
    ds.attrs = {
        "Conventions": CONVENTIONS,
        "title": title or f"{len(runs)} crash runs",
        "solver": solver or "arrays",
        "source_files": "[]",
        "units_read": units,
        "units_written": "SI",
        "parameters": json.dumps(list(own)),
        "crashkit_version": __version__,
        "history": f"crashkit {__version__} from_arrays: {len(runs)} runs",
    }
    checksums = [run_checksum(digests_of_run(ds, k)) for k in range(len(runs))]
    ds["run_checksum"] = ("sim", np.array(checksums, dtype=str))
    ds.attrs["checksum"] = dataset_checksum(ds, checksums)
    if problems := validate(ds):
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        where = re.sub("^sim:", "names:", str(problems[0]))
        hint = "; displacements are from position, not positions" if "first state" in problems[0].where else ""
        raise DataError(f"{where}{hint}{more}")
    if target is None:
        return ds
    _write(ds, target)
    return open_dataset(target)


def _parameters(
    given: Mapping[str, ArrayLike], units: Mapping[str, str], sizes: Mapping[str, int]
) -> dict[str, tuple[NDArray[np.float64], str, str]]:
    """Name -> values in SI, their unit, and the unit they were given in."""
    from crashkit.readers.parameter_names import parameter_columns

    if not isinstance(given, Mapping):
        raise DataError(f"parameters: is {type(given).__name__}; expected a mapping of names to values, one a run")
    try:
        columns = parameter_columns(list(given), [units.get(title, "") for title in given], "parameters")
    except ReadError as error:
        raise DataError(str(error)) from error
    unknown = [name for name in units if name not in given and name not in dict(columns)]
    if unknown:
        raise DataError(f"parameter_units: {unknown[0]!r} is no parameter; there are {', '.join(dict(columns))}")
    out = {}
    for (name, beside), title in zip(columns, given, strict=True):
        if name in VARIABLES or name in DIMENSIONS:
            raise DataError(f"parameters: one cannot be called {name!r}, which means something else; rename it")
        written = units.get(name, beside)
        factor, si = _unit(f"parameters, {name}", written)
        values = _numbers(f"parameters, {name}", given[title], ("sim",), sizes)
        _finite(f"parameters, {name}", values)
        out[name] = (values * factor, si, written)
    return out


def _with_history(
    ds: xr.Dataset,
    history: Mapping[str, tuple[ArrayLike, str]],
    times: ArrayLike,
    second: float,
    sizes: dict[str, int],
) -> xr.Dataset:
    from crashkit.ingestion.curves import Curves, with_curves

    at = _shaped("history_time", times, ("sample",), {}).astype(np.float64)
    sizes = {**sizes, "sample": len(at)}
    _increasing("history_time", at)
    factors = {name: _unit(f"history, {name}", unit) for name, (_, unit) in history.items()}
    curves = [
        _numbers(f"history, {name}", values, ("sim", "sample"), sizes) * factors[name][0]
        for name, (values, _) in history.items()
    ]
    values = np.stack(curves, axis=-1)
    labels = tuple(si for _, si in factors.values())
    return with_curves(
        ds, [Curves(at * second, of_run, tuple(history), labels, ("",) * len(labels)) for of_run in values]
    )


def _field(name: str, values: ArrayLike, sizes: Mapping[str, int]) -> tuple[tuple[str, ...], NDArray[Any]]:
    """Dimensions of a field by its shape; where there are as many faces as nodes it is one of nodes."""
    shape = np.shape(values)
    for place in ("node", "face"):
        if shape[:3] == (sizes["sim"], sizes["time"], sizes[place]) and shape[3:] in _BEHIND:
            dims = ("sim", "time", place, *_BEHIND[shape[3:]])
            return dims, _numbers(name, values, ("sim", "time", place, *shape[3:]), sizes)
    raise DataError(
        f"{name}: has shape {shape}; expected ({sizes['sim']}, {sizes['time']}, {sizes['node']} nodes or {sizes['face']} "
        "faces), with 3 or 6 components behind if any"
    )


def _faces(faces: ArrayLike, nodes: int) -> NDArray[np.int32]:
    found = np.asarray(faces)
    if found.ndim != 2 or found.shape[1] not in (3, 4) or not len(found) or found.dtype.kind not in "iu":
        raise DataError(
            f"faces: has shape {found.shape} and type {found.dtype}; expected whole numbers, (face, 3) or (face, 4)"
        )
    lowest = np.array([0, 0, 0, -1])[: found.shape[1]]
    wrong = ((found < lowest) | (found >= nodes)).any(axis=1)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise DataError(
            f"faces: face {row} has nodes {found[row].tolist()}; expected 0 to {nodes - 1}, counted from 0 (-1 only in the "
            "last corner)"
        )
    return found.astype(np.int32)


def _shaped(name: str, values: ArrayLike, dims: Sequence[str | int], sizes: Mapping[str, int]) -> NDArray[Any]:
    """`values` as an array with these dimensions; sizes that are known must be met."""
    try:
        found = np.asarray(values)
    except ValueError as error:
        raise DataError(f"{name}: is no array ({error})") from error
    wanted = [dim if isinstance(dim, int) else sizes.get(dim) for dim in dims]
    if found.ndim != len(dims) or any(w not in (None, n) for w, n in zip(wanted, found.shape)) or 0 in found.shape:
        told = ", ".join(str(d) if isinstance(d, int) or d not in sizes else f"{sizes[d]} ({d})" for d in dims)
        raise DataError(f"{name}: has shape {found.shape}; expected ({told}{',' if len(dims) == 1 else ''})")
    return found


def _numbers(name: str, values: ArrayLike, dims: Sequence[str | int], sizes: Mapping[str, int]) -> NDArray[Any]:
    found = _shaped(name, values, dims, sizes)
    if found.dtype.kind not in "fiu":
        raise DataError(f"{name}: has type {found.dtype}; expected numbers")
    return found.astype(np.float64, copy=False) if found.dtype != np.float32 or len(dims) < 2 else found


def _integers(
    name: str, values: ArrayLike | None, dims: Sequence[str], sizes: Mapping[str, int], otherwise: NDArray[Any]
) -> NDArray[np.int64]:
    if values is None:
        return otherwise.astype(np.int64)
    found = _shaped(name, values, dims, sizes)
    if found.dtype.kind not in "iu":
        raise DataError(f"{name}: has type {found.dtype}; expected whole numbers")
    return found.astype(np.int64)


def _texts(
    name: str, values: Sequence[str] | None, dim: str, sizes: Mapping[str, int], otherwise: Sequence[str]
) -> NDArray[np.str_]:
    found = np.array([str(value) for value in (otherwise if values is None else values)], dtype=str)
    return _shaped(name, found, (dim,), sizes)


def _finite(name: str, values: NDArray[Any]) -> None:
    bad = ~np.isfinite(values)
    if bad.any():
        place = tuple(int(k) for k in np.argwhere(bad)[0])
        raise DataError(f"{name}: is {values[place]} at {list(place)}; expected a number")


def _increasing(name: str, values: NDArray[Any]) -> NDArray[np.float64]:
    _finite(name, values)
    if (np.diff(values) <= 0).any():
        k = int(np.argmax(np.diff(values) <= 0))
        raise DataError(
            f"{name}: {values[k + 1]:g} comes after {values[k]:g} (state {k + 1}); expected increasing times"
        )
    return values.astype(np.float64)


def _unit(name: str, unit: str) -> tuple[float, str]:
    try:
        return to_si(unit)
    except UnknownUnits as error:
        raise DataError(f"{name}: {error}") from error


def _free(output: Path) -> Path:
    from crashkit.ingestion.store import check_output

    check_output(output)
    if output.exists():
        raise OutputError(f"output: {output} exists; choose another name, or delete it first")
    return output


def _write(ds: xr.Dataset, target: Path) -> None:
    """As ingest writes it: the same chunks and checksums of chunks."""
    from crashkit.ingestion import store
    from data_schema.checksum import results
    from data_schema.replace import put_in_place, room_beside

    names = results(ds)
    specs: list[ArraySpec] = [
        store.ArraySpec(
            name, tuple(map(str, ds[name].dims[1:])), ds[name].shape[1:], str(ds[name].dtype), dict(ds[name].attrs)
        )
        for name in names
    ]
    try:
        with room_beside(target) as room:
            store.zarr_from(ds, specs, room / "runs.zarr")
            sources = [store.RunSource(room / "runs.zarr", k) for k in range(ds.sizes["sim"])]
            write = store.write_netcdf if target.suffix == ".nc" else store.write_zarr
            write(room / f"whole{target.suffix}", ds.drop_vars(names), specs, sources)
            put_in_place(room / f"whole{target.suffix}", target, durable=True)
    except OSError as error:
        raise OutputError(
            f"output: {target} cannot be written ({error.strerror or error}); check permissions and free space"
        ) from error
