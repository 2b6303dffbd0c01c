"""Opening a crash dataset, splitting it, and the accessor `.crash` on xarray datasets.

Importing this module registers the accessor; `xarray.open_dataset(path, engine="crashkit")` imports it too.
"""

from __future__ import annotations

import contextlib
import fnmatch
import importlib.util
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from crashkit.errors import CrashkitError, DataError, ReadError
from data_schema import VARIABLES, fields, parameters
from data_schema import dataset_checksum as _checksum_from
from data_schema.checksum import digests_of_run, run_checksum

if TYPE_CHECKING:
    import pyvista

    from crashkit.mesh.levels import Hierarchy

Selection = int | float | slice | str | Sequence[int | str]


def open_dataset(path: str | Path, *, chunks: Literal["stored"] | Mapping[str, int] | None = "stored") -> xr.Dataset:
    """The crash dataset at `path`, a `.zarr` folder or `.nc` file; values are read when they are asked for.

    chunks  "stored": as Dask arrays in the chunks of the store, so that sums over all runs stay small in memory, or
            without Dask where that is not installed; sizes by dimension for other chunks; None for no Dask

    Raises ReadError if there is nothing, or nothing of the kind; `data_schema.validate` tells whether it is good.
    """
    path = Path(path)
    if not path.exists():
        raise ReadError(f"{path}: no such dataset; make one with crashkit ingest, or check the path")
    is_folder = path.is_dir()
    if is_folder and not (path / "zarr.json").exists():
        raise ReadError(f"{path}: is a folder, but no Zarr store; expected a dataset made by crashkit ingest")
    options: dict[str, Any] = {"engine": "zarr", "consolidated": False} if is_folder else {"engine": "netcdf4"}
    if chunks == "stored":
        chunks = {} if importlib.util.find_spec("dask") else None
    try:
        dataset = xr.open_dataset(path, chunks=chunks, **options)
    except Exception as error:  # what a damaged file raises is up to the libraries below
        raise ReadError(
            f"{path}: cannot be opened as a dataset ({_one_line(error)}); expected one made by crashkit ingest"
        ) from error
    missing = [v.name for v in VARIABLES.values() if v.required and v.name not in dataset.variables]
    if missing:
        dataset.close()
        raise ReadError(
            f"{path}: holds no variable {', '.join(missing)}; expected a dataset made by crashkit ingest"
            + ("; it is damaged" if "displacement" in dataset.variables else "")
        )
    with reading(path):
        out = dataset.assign({n: _as_text(v) for n, v in dataset.variables.items() if v.dtype.kind in "OT"})
    out.set_close(dataset.close)
    return out


@contextlib.contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Values read lazily from a damaged dataset raise ReadError within this context, and not what libraries raise."""
    try:
        yield
    except (CrashkitError, MemoryError):
        raise
    except Exception as error:
        raise ReadError(
            f"{path}: cannot be read ({_one_line(error)}); it is damaged: copy or ingest it again"
        ) from error


def _as_text(variable: xr.Variable) -> xr.Variable:
    """Text as numpy's own, which both forms on disk give in another way."""
    values = np.asarray(variable.values, object)
    text = np.array([str(value) for value in values.ravel()], dtype=str).reshape(values.shape)
    return xr.Variable(variable.dims, text, variable.attrs)


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:160] or type(error).__name__


def has_hierarchy(path: str | Path) -> bool:
    """Whether the dataset at `path` has a mesh hierarchy."""
    path = Path(path)
    if path.is_dir():
        return (path / "hierarchy").is_dir()
    import netCDF4

    with netCDF4.Dataset(str(path)) as file:
        return "hierarchy" in file.groups


def open_hierarchy(path: str | Path) -> Hierarchy:
    """The mesh hierarchy of the dataset at `path`; raises DataError if it has none."""
    from crashkit.mesh.store import read_hierarchy

    return read_hierarchy(path)


def dataset_checksum(dataset: str | Path | xr.Dataset) -> str:
    """SHA-256 of a dataset's content, taken anew from its values (`data_schema.checksum`), whatever its form on disk.

    Ingest keeps the same number in the attribute `checksum`.
    """
    if not isinstance(dataset, xr.Dataset):
        with open_dataset(dataset, chunks=None) as opened, reading(dataset):
            return dataset_checksum(opened)
    runs = range(dataset.sizes["sim"])
    return _checksum_from(dataset, [run_checksum(digests_of_run(dataset, k)) for k in runs])


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
        if not 0 < size < count or (chosen > 1 and size != chosen):
            raise DataError(
                f"{chosen} of {count} runs were asked for; expected a fraction, or a whole number from 1 to {count - 1}"
            )
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
        return parameters(self._dataset)

    def split(self, test: Selection, *, seed: int = 0) -> tuple[xr.Dataset, xr.Dataset]:
        """(training runs, test runs), each in the dataset's order; `test` as in `runs_of`.

        Raises DataError if there is no such run, or if all runs would be test runs.
        """
        count = self._dataset.sizes["sim"]
        chosen = runs_of([str(n) for n in self._dataset["sim"].values], test, seed=seed)
        rest = sorted(set(range(count)) - set(chosen))
        if not rest:
            raise DataError(f"all {count} runs would be test runs; leave some for training")
        return self._dataset.isel(sim=rest), self._dataset.isel(sim=chosen)

    def magnitude(self, name: str = "displacement") -> xr.DataArray:
        """Euclidean length of a vector variable over `xyz`, in its unit; NaN where a component is."""
        variable = self._dataset[name]
        if "xyz" not in variable.dims:
            raise DataError(f"{name} has the dimensions {variable.dims}; a magnitude needs xyz among them")
        with xr.set_options(keep_attrs=False):
            out = (variable**2).sum("xyz", skipna=False) ** 0.5
        if "units" in variable.attrs:
            out.attrs["units"] = variable.attrs["units"]
        return out.rename(f"{name}_magnitude")

    def nodes(self, part: str | int) -> NDArray[np.int64]:
        """Places of the nodes of a part (number, title or pattern), for `ds.isel(node=...)`, increasing.

        Raises DataError if there is no such part.
        """
        ds = self._dataset
        names = [str(n) for n in ds["part_name"].values]
        chosen = [k for k, n in enumerate(ds["part_id"].values) if str(n) == str(part) or names[k] == part]
        chosen = chosen or [k for k, n in enumerate(names) if fnmatch.fnmatchcase(n, str(part))]
        if not chosen:
            known = ", ".join(f"{i} ({n})" for i, n in zip(ds["part_id"].values, names, strict=True))
            raise DataError(f"no part is called {part!r}; the dataset has {known}")
        used = [ds["face_nodes"].values[np.isin(ds["face_part"].values, chosen)].ravel()]
        if "cell_nodes" in ds:
            used.append(ds["cell_nodes"].values[np.isin(ds["cell_part"].values, chosen)].ravel())
        nodes = np.unique(np.concatenate(used))
        return nodes[nodes >= 0].astype(np.int64)

    def edges(self) -> NDArray[np.int32]:
        """(e, 2) sides of the faces, each once, i < j."""
        from crashkit.mesh.surface import face_edges

        return face_edges(self._dataset["face_nodes"].values)

    def surface(self, sim: int | str | None = None) -> pyvista.PolyData:
        """The undeformed faces, with node numbers on points, part and element numbers on cells.

        `sim` (name or place) says whose shape where the runs differ; the first run's without.
        """
        position = self._run(0 if sim is None else sim)["reference_position"].values
        return self._faces(np.asarray(position, np.float64), np.ones(self._dataset.sizes["face"], bool))

    def to_pyvista(self, sim: int | str = 0, time: float | int = -1, *, deform: bool = True) -> pyvista.PolyData:
        """One state of one run as a surface with the displacement and all fields on nodes and faces.

        sim     name of the run, or its place
        time    place of the state (int), or seconds (float): the nearest state
        deform  points where they are then; else the undeformed position

        Eroded faces are left out; nodes that nothing holds any more stay at their undeformed position, with NaN as
        displacement. Raises DataError for a run that is not there.
        """
        ds = self._run(sim)
        if "time" in ds.dims:
            is_place = isinstance(time, (int, np.integer))
            ds = ds.isel(time=int(time)) if is_place else ds.sel(time=time, method="nearest")
        moved = ds["displacement"].values
        points = np.asarray(ds["reference_position"].values, np.float64)
        if deform:
            points = points + np.nan_to_num(moved)
        alive = ds["alive"].values if "alive" in ds else np.ones(ds.sizes["face"], bool)
        mesh = self._faces(points, alive)
        mesh.point_data["displacement"] = moved
        for name in fields(ds):
            values = ds[name].values
            if ds[name].dims[0] == "node":
                mesh.point_data[name] = values
            elif ds[name].dims[0] == "face":
                mesh.cell_data[name] = values[alive]
        mesh.field_data["TimeValue"] = [float(ds["time"])]
        return mesh

    def _run(self, sim: int | str) -> xr.Dataset:
        ds = self._dataset
        if "sim" not in ds.dims:
            return ds
        names = [str(n) for n in ds["sim"].values]
        place = runs_of(names, [sim])[0] if isinstance(sim, str) or not -len(names) <= sim < len(names) else int(sim)
        return ds.isel(sim=place)

    def _faces(self, points: NDArray[np.float64], which: NDArray[np.bool_]) -> pyvista.PolyData:
        import pyvista

        ds = self._dataset
        corners = ds["face_nodes"].values[which]
        padded = np.column_stack([(corners >= 0).sum(axis=1), corners])
        valid = padded >= 0
        mesh = pyvista.PolyData(points, faces=padded[valid])
        mesh.point_data["node_id"] = ds["node_id"].values
        mesh.cell_data["part_id"] = ds["part_id"].values[ds["face_part"].values[which]]
        if "face_id" in ds:
            mesh.cell_data["element_id"] = ds["face_id"].values[which]
        return mesh
