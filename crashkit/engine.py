"""`xarray.open_dataset(path, engine="crashkit")`: solver results straight from their files, one run as a dataset.

Displacements and fields are read state by state when they are asked for; nothing is checked or aligned, as ingest
does. Datasets made by ingest open as well.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray, BackendEntrypoint
from xarray.core import indexing

from crashkit.dataset import open_dataset
from crashkit.errors import DataError, ReadError
from crashkit.ingestion.run_view import RunView, gone_nodes
from crashkit.ingestion.store import SUFFIXES
from crashkit.ingestion.structure import structure_of
from crashkit.ingestion.survey import reader_options, wanted_field
from crashkit.readers import reader_for
from crashkit.readers.base import Run, Runs
from crashkit.version import __version__
from data_schema import CONVENTIONS, UnknownUnits, to_si, unit_system


class CrashBackend(BackendEntrypoint):
    """The engine `crashkit` of xarray."""

    description = "Crash datasets, and results of LS-DYNA, OpenRadioss and the like, read lazily"
    open_dataset_parameters = (
        "filename_or_obj", "drop_variables", "run", "units", "reader", "mesh", "time_step", "parts", "exclude_parts",
        "keep_rigid_walls",
    )  # fmt: skip

    def open_dataset(  # type: ignore[override]
        self,
        filename_or_obj: str | Path,
        *,
        drop_variables: str | Iterable[str] | None = None,
        run: str | int | None = None,
        units: str | None = None,
        reader: str | None = None,
        mesh: str | Path | None = None,
        time_step: float | None = None,
        parts: Sequence[str] = (),
        exclude_parts: Sequence[str] = (),
        keep_rigid_walls: bool = False,
    ) -> xr.Dataset:
        """One run as a dataset with one `sim`.

        The other options are those of `crashkit.ingest`. Raises ReadError or DataError.

        Parameters
        ----------
        run
            Name or place of the run where the path holds several.
        units
            Unit system of the source; without, and where the source states none, values stay as they are and
            variables carry no unit.
        """
        path = Path(filename_or_obj)
        if path.suffix in SUFFIXES and reader is None:
            dataset = open_dataset(path, chunks=None)
        else:
            options = reader_options(mesh, time_step)
            opened = _the_run(path, run, reader_for(path, reader).runs(path, **dict(options)))
            dataset = dataset_of(opened, units, parts, exclude_parts, keep_rigid_walls)
        drop = [drop_variables] if isinstance(drop_variables, str) else list(drop_variables or ())
        kept = dataset.drop_vars(drop, errors="ignore")
        kept.set_close(dataset.close)
        return kept

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        """Never: solver files have no suffix to know them by, and looking into every file would slow xarray down."""
        return False


def dataset_of(
    run: Run,
    units: str | None = None,
    parts: Sequence[str] = (),
    exclude_parts: Sequence[str] = (),
    keep_rigid_walls: bool = False,
) -> xr.Dataset:
    """A run as a dataset with one `sim`, its displacements and fields read when they are asked for."""
    name = units or run.units
    system = unit_system(name or "SI")
    structure = structure_of(run.mesh, parts=parts, exclude_parts=exclude_parts, keep_rigid_walls=keep_rigid_walls)
    structure = replace(structure, position=structure.position * system.length)
    view, s, lock = RunView(run, structure, system), structure, threading.Lock()
    states, sizes = len(run.time), {"node": s.n_nodes, "face": len(s.face_nodes), "cell": len(s.cell_nodes)}

    def lazy(read: Callable[[int, int], NDArray[Any]], dtype: Any, *shape: int) -> indexing.LazilyIndexedArray:
        return indexing.LazilyIndexedArray(_Lazy(read, (1, states, *shape), np.dtype(dtype), lock))

    def measured(unit: str) -> dict[str, str]:
        return {"units": unit} if name else {}

    def displacement(first: int, last: int) -> NDArray[Any]:
        values = view.displacement(first, last)
        gone = gone_nodes(s, *view.alive(first, last), last - first)
        if gone is not None:
            values = np.where(gone[..., None], np.float32(np.nan), values)
        return values

    ds = xr.Dataset(
        {
            "displacement": (
                ("sim", "time", "node", "xyz"), lazy(displacement, np.float32, s.n_nodes, 3), measured("m"),
            ),
            "reference_position": (("node", "xyz"), s.position, measured("m")),
            "node_id": ("node", s.node_id),
            "face_nodes": (("face", "corner"), s.face_nodes),
            "face_part": ("face", s.face_part),
            "face_id": ("face", s.face_id),
            "part_id": ("part", np.array([p.id for p in s.parts], np.int64)),
            "part_name": ("part", np.array([p.name for p in s.parts], dtype=str)),
            "complete": ("sim", np.array([not run.problems])),
        },
        coords={
            "sim": np.array([run.name], dtype=str),
            "time": ("time", np.asarray(run.time, np.float64) * system.time, measured("s")),
        },
    )  # fmt: skip
    if len(s.cell_nodes):
        ds["cell_nodes"] = (("cell", "cell_corner"), s.cell_nodes)
        ds["cell_type"], ds["cell_part"], ds["cell_id"] = (("cell", v) for v in (s.cell_type, s.cell_part, s.cell_id))
    for place, (key, where) in enumerate((("alive", "face"), ("cell_alive", "cell"))):
        if states and view.alive(0, 1)[place] is not None:
            ds[key] = (("sim", "time", where), lazy(_flags(view, place), bool, sizes[where]))
    for key in run.fields:
        wanted = wanted_field(run, key, name or "SI")
        if wanted is None or key in ds.variables:
            continue
        where, count = wanted.info.location, wanted.info.components
        behind = () if count == 1 else ({3: "xyz", 6: "tensor"}.get(count, f"{key}_component"),)
        shape = (sizes[where], *(count,) * len(behind))
        values = lazy(partial(view.field, wanted), np.float32, *shape)
        ds[key] = (("sim", "time", where, *behind), values, {"role": "field", **measured(wanted.unit)})
    for key, parameter in run.parameters.items():
        try:
            factor, unit = to_si(parameter.unit)
        except UnknownUnits as error:
            raise DataError(f"run {run.name}, parameter {key}: {error}") from error
        ds[key] = ("sim", np.array([parameter.value * factor]), {"units": unit, "role": "parameter"})
    files = [{"run": run.name, "file": f.name, "bytes": f.stat().st_size, "sha256": None} for f in run.files]
    ds.attrs = {
        "Conventions": CONVENTIONS,
        "solver": run.solver,
        "source_files": json.dumps(files),
        "units_read": name or "not stated",
        "units_written": "SI" if name else "as read",
        "crashkit_version": __version__,
        "history": f"crashkit {__version__} open: run {run.name}",
    }
    ds.set_close(run.close)
    return ds


def _flags(view: RunView, place: int) -> Callable[[int, int], NDArray[Any]]:
    """A function that gives `alive` (place 0) or `cell_alive` (place 1) of some states."""

    def read(first: int, last: int) -> NDArray[Any]:
        return np.asarray(view.alive(first, last)[place])

    return read


def _the_run(path: Path, wanted: str | int | None, runs: Iterator[Run]) -> Run:
    """The run asked for by name or place; without either, the only one."""
    if not isinstance(runs, Runs):
        opened = list(runs)
        runs = Runs({run.name: partial(_itself, run) for run in opened})
    names = runs.names
    if not names:
        raise ReadError(f"{path}: holds no run")
    listed = ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
    if wanted is None:
        if len(names) > 1:
            raise DataError(
                f"{path}: holds {len(names)} runs ({listed}); name one with run=, or join them with crashkit ingest"
            )
        return runs.open(names[0])
    if isinstance(wanted, int) and -len(names) <= wanted < len(names):
        return runs.open(names[wanted])
    if wanted not in names:
        raise DataError(f"{path}: holds no run {wanted!r}; it has {listed}")
    return runs.open(str(wanted))


def _itself(run: Run) -> Run:
    return run


class _Lazy(BackendArray):
    """(1, state, ...) values of one run; `read(first, last)` gives a range of states."""

    def __init__(
        self, read: Callable[[int, int], NDArray[Any]], shape: tuple[int, ...], dtype: np.dtype, lock: threading.Lock
    ) -> None:
        self._read, self._lock = read, lock
        self.shape, self.dtype = shape, dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.BASIC, self._get)

    def _get(self, key: tuple[Any, ...]) -> NDArray[Any]:
        sim, state, *others = key
        is_slice = isinstance(state, slice)
        wanted = list(range(self.shape[1])[state]) if is_slice else [range(self.shape[1])[int(state)]]
        if wanted:
            with self._lock:  # readers hold files open, and Dask asks from several threads
                values = self._read(min(wanted), max(wanted) + 1)
            values = values[[w - min(wanted) for w in wanted]]
        else:
            values = np.empty((0, *self.shape[2:]), self.dtype)
        return values[None][(sim, slice(None) if is_slice else 0, *others)]
