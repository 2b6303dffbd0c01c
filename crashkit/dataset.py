"""Opening a crash dataset, splitting it, and the accessor `.crash` on xarray datasets.

Importing this module registers the accessor; `xarray.open_dataset(path, engine="crashkit")` imports it too.
"""

from __future__ import annotations

import contextlib
from collections.abc import Hashable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendEntrypoint

from crashkit.errors import CrashkitError, DataError, ReadError

if TYPE_CHECKING:
    import pyvista

    from crashkit.mesh.levels import Hierarchy

Selection = int | float | slice | str | Sequence[int | str]


def open_dataset(path: str | Path) -> xr.Dataset:
    """The crash dataset at `path`, a `.zarr` folder or `.nc` file; values are read when they are asked for.

    Raises ReadError if there is nothing, or nothing of the kind; `data_schema.validate` tells whether it is good.
    """
    path = Path(path)
    if not path.exists():
        raise ReadError(f"{path}: no such dataset; crashkit ingest makes one")
    zarr_store = path.is_dir()
    if zarr_store and not (path / "zarr.json").exists():
        raise ReadError(f"{path}: is a folder, but no Zarr store; expected a dataset made by crashkit ingest")
    options: dict[str, Any] = {"engine": "zarr", "consolidated": False} if zarr_store else {"engine": "netcdf4"}
    try:
        dataset = xr.open_dataset(path, chunks=None, **options)
    except Exception as error:  # what a damaged file raises is up to the libraries below
        text = " ".join(str(error).split())[:160] or type(error).__name__
        raise ReadError(
            f"{path}: cannot be opened as a dataset ({text}); expected one made by crashkit ingest"
        ) from error
    if "displacement" not in dataset:
        dataset.close()
        raise ReadError(f"{path}: holds no variable displacement; expected a dataset made by crashkit ingest")
    return dataset


def open_hierarchy(path: str | Path) -> Hierarchy:
    """The mesh hierarchy of the dataset at `path`; raises DataError if it has none."""
    from crashkit.mesh.store import read_hierarchy

    return read_hierarchy(path)


def demo_data() -> Path:
    """The embedded campaign: 36 kart crashes in the HDF5 layout of the paper's public data."""
    return Path(__file__).parent / "data" / "kart_demo.h5"


def runs_of(names: Sequence[str], chosen: Selection, *, seed: int = 0) -> list[int]:
    """Which of the runs `names` a selection means, as increasing numbers.

    An int or a fraction below 1 draws that many at random (seeded); a slice or "27:36" means places; a list or
    "run_003,run_007" means names or places.

    Raises DataError for a run that is not there, or a selection of nothing.
    """
    count = len(names)
    place = {str(n): k for k, n in enumerate(names)}
    if isinstance(chosen, str):
        chosen = _parse(chosen)
    if isinstance(chosen, slice):
        out = list(range(count))[chosen]
    elif isinstance(chosen, (int, float, np.integer, np.floating)):
        size = round(float(chosen) * count) if 0 < chosen < 1 else int(chosen)
        if not 0 < size < count:
            raise DataError(f"{chosen} of {count} runs were asked for; expected at least 1 and fewer than {count}")
        out = sorted(np.random.default_rng(seed).choice(count, size, replace=False).tolist())
    else:
        out = []
        for item in chosen:
            if str(item) in place:
                out.append(place[str(item)])
            elif isinstance(item, (int, np.integer)) and -count <= item < count:
                out.append(int(item) % count)
            elif isinstance(item, str) and item.strip().isdigit() and int(item) < count:
                out.append(int(item))
            else:
                raise DataError(f"there is no run {item!r}; the dataset has {names[0]} to {names[-1]} ({count} runs)")
    out = sorted(set(out))
    if not out:
        raise DataError(f"the selection {chosen!r} means none of the {count} runs")
    return out


def _parse(text: str) -> Selection:
    text = text.strip()
    if ":" in text and "," not in text:
        try:
            return slice(*(int(p) if p.strip() else None for p in text.split(":")))
        except ValueError as error:
            raise DataError(f"{text!r} is no range of runs; expected first:last, such as 27:36") from error
    if "," not in text:
        with contextlib.suppress(ValueError):
            number = float(text)
            return int(number) if number == int(number) and "." not in text else number
    return [p.strip() for p in text.split(",") if p.strip()]


@xr.register_dataset_accessor("crash")
class CrashAccessor:
    """What a crash dataset can do beyond xarray: `ds.crash.split(...)`, `.magnitude(...)`, `.to_pyvista(...)`."""

    def __init__(self, dataset: xr.Dataset) -> None:
        self._dataset = dataset

    @property
    def parameters(self) -> list[str]:
        """Names of the design parameters."""
        from data_schema import parameters

        return parameters(self._dataset)

    def split(self, test: Selection, *, seed: int = 0) -> tuple[xr.Dataset, xr.Dataset]:
        """(training runs, test runs); `test` as in `runs_of`: a number, a fraction, a range "27:36", or names."""
        count = self._dataset.sizes["sim"]
        chosen = runs_of([str(n) for n in self._dataset["sim"].values], test, seed=seed)
        rest = [k for k in range(count) if k not in set(chosen)]
        if not rest:
            raise DataError(f"all {count} runs would be test runs; leave some for training")
        return self._dataset.isel(sim=rest), self._dataset.isel(sim=chosen)

    def magnitude(self, name: str = "displacement") -> xr.DataArray:
        """Euclidean length of a vector variable over `xyz`, with its unit."""
        variable = self._dataset[name]
        if "xyz" not in variable.dims:
            raise DataError(f"{name} is on {variable.dims}; a magnitude needs the dimension xyz")
        out = (variable**2).sum("xyz", skipna=False) ** 0.5
        out.attrs = {k: v for k, v in variable.attrs.items() if k == "units"}
        return out.rename(f"{name}_magnitude")

    def surface(self) -> pyvista.PolyData:
        """The undeformed faces with node, part and element numbers."""
        import pyvista as pv

        ds = self._dataset
        position = ds["reference_position"]
        if "sim" in position.dims:
            position = position.isel(sim=0)
        corners = ds["face_nodes"].values
        sizes = (corners >= 0).sum(axis=1)
        padded = np.column_stack([sizes, corners])
        faces = padded[np.column_stack([np.ones(len(corners), bool), corners >= 0])]
        mesh = pv.PolyData(np.asarray(position.values, np.float64), faces=faces)
        mesh.point_data["node_id"] = ds["node_id"].values
        mesh.cell_data["part_id"] = ds["part_id"].values[ds["face_part"].values]
        if "face_id" in ds:
            mesh.cell_data["element_id"] = ds["face_id"].values
        return mesh

    def to_pyvista(self, sim: Hashable | int, time: float | int) -> pyvista.PolyData:
        """One state of one run as a deformed surface with its fields.

        sim   run name, or place (int)
        time  place (int), or s (float): the nearest state
        """
        ds = self._dataset
        one = ds.isel(sim=sim) if isinstance(sim, (int, np.integer)) else ds.sel(sim=sim)
        one = one.isel(time=time) if isinstance(time, (int, np.integer)) else one.sel(time=time, method="nearest")
        mesh = self.surface()
        u = one["displacement"].values
        mesh.points = one["reference_position"].values + np.nan_to_num(u)
        mesh.point_data["displacement"] = u
        for name, variable in one.data_vars.items():
            if variable.attrs.get("role") != "field":
                continue
            if variable.dims[0] == "node":
                mesh.point_data[str(name)] = variable.values
            elif variable.dims[0] == "face":
                mesh.cell_data[str(name)] = variable.values
        if "alive" in one:
            mesh.cell_data["alive"] = one["alive"].values.astype(np.uint8)
            mesh = mesh.extract_cells(one["alive"].values.astype(bool)).extract_surface()
        mesh.field_data["TimeValue"] = [float(one["time"])]
        return mesh

    def edges(self) -> NDArray[np.int32]:
        """(e, 2) sides of the faces, each once, i < j."""
        corners = self._dataset["face_nodes"].values
        nxt = np.roll(corners, -1, axis=1)
        if corners.shape[1] == 4:
            triangle = corners[:, 3] < 0
            nxt[triangle, 2], nxt[triangle, 3] = corners[triangle, 0], -1
        pairs = np.column_stack([corners.ravel(), nxt.ravel()])
        pairs = np.sort(pairs[(pairs >= 0).all(axis=1)], axis=1)
        return np.unique(pairs, axis=0).astype(np.int32)


class CrashBackend(BackendEntrypoint):
    """`xarray.open_dataset(path, engine="crashkit")`: datasets of ours, and solver results straight from their files.

    The displacements of solver results are read run by run and state by state when asked for.
    """

    description = "crash datasets, and results of LS-DYNA, OpenRadioss and others"
    open_dataset_parameters = ("filename_or_obj", "drop_variables", "units", "reader")

    def open_dataset(  # type: ignore[override]
        self,
        filename_or_obj: str | Path,
        *,
        drop_variables: str | Iterable[str] | None = None,
        units: str | None = None,
        reader: str | None = None,
    ) -> xr.Dataset:
        path = Path(filename_or_obj)
        if path.suffix in (".zarr", ".nc") and reader is None:
            dataset = open_dataset(path)
        else:
            dataset = _from_runs(path, units, reader)
        drop = [drop_variables] if isinstance(drop_variables, str) else list(drop_variables or ())
        return dataset.drop_vars(drop, errors="ignore")

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        return False  # only when asked for by name: many of these files have no suffix at all


class _RunArray(xr.backends.BackendArray):
    """Displacements (1, state, node, 3) of one run, read when indexed."""

    def __init__(self, run: Any, node: NDArray[np.int64], factor: float) -> None:
        self._run, self._node, self._factor = run, node, np.float32(factor)
        self.shape = (1, len(run.time), len(node), 3)
        self.dtype = np.dtype(np.float32)

    def __getitem__(self, key: xr.core.indexing.ExplicitIndexer) -> Any:
        from xarray.core import indexing

        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.BASIC, self._read)

    def _read(self, key: tuple[Any, ...]) -> NDArray[np.float32]:
        states = np.arange(self.shape[1])[key[1]]
        wanted = np.atleast_1d(states)
        first, last = (int(wanted.min()), int(wanted.max()) + 1) if len(wanted) else (0, 0)
        block = np.empty((len(wanted), *self.shape[2:]), np.float32)
        if len(wanted):
            block[...] = self._run.displacement(first, last)[wanted - first][:, self._node] * self._factor
        return block[None][key[0], 0 if np.ndim(states) == 0 else slice(None), key[2], key[3]]


def _from_runs(path: Path, units: str | None, reader: str | None) -> xr.Dataset:
    from crashkit.readers import reader_for
    from crashkit.structure import structure_of
    from data_schema import CONVENTIONS, to_si, unit_system

    runs = list(reader_for(path, reader).runs(path))
    if len(runs) != 1:
        raise CrashkitError(
            f"{path}: holds {len(runs)} runs; engine='crashkit' opens one, crashkit ingest joins several"
        )
    run = runs[0]
    name = units or run.units
    system = unit_system(name or "SI")
    s = structure_of(run.mesh)
    lazy = xr.core.indexing.LazilyIndexedArray(_RunArray(run, s.node, system.length))
    length = "m" if name else "unit of length of the source"
    ds = xr.Dataset(
        {
            "displacement": (("sim", "time", "node", "xyz"), lazy, {"units": length}),
            "reference_position": (("node", "xyz"), s.position * system.length, {"units": length}),
            "node_id": ("node", s.node_id),
            "face_nodes": (("face", "corner"), s.face_nodes),
            "face_part": ("face", s.face_part),
            "face_id": ("face", s.face_id),
            "part_id": ("part", np.array([p.id for p in s.parts], np.int64)),
            "part_name": ("part", np.array([p.name for p in s.parts], dtype="U")),
            "complete": ("sim", np.array([not run.problems])),
        },
        coords={
            "sim": np.array([run.name], dtype="U"),
            "time": (
                "time",
                np.asarray(run.time, np.float64) * system.time,
                {"units": "s" if name else "unit of time of the source"},
            ),
        },
    )
    for key, p in run.parameters.items():
        factor, unit = to_si(p.unit)
        ds[key] = ("sim", np.array([p.value * factor]), {"units": unit, "role": "parameter"})
    ds.attrs = {"Conventions": CONVENTIONS, "solver": run.solver, "units_read": name or "unknown"}
    return ds
