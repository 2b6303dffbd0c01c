"""The accessor `.crash` on xarray datasets: parameters, split, magnitude, surface, one state as a mesh."""

from __future__ import annotations

import fnmatch
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from crashkit.errors import DataError
from crashkit.selection import WhichRuns, runs_of

if TYPE_CHECKING:
    import pyvista

# Importing xarray may import this module in turn (crashkit.register), whoever imports it: also data_schema, which is
# why nothing of data_schema is imported here but inside functions.


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

    def split(self, test: WhichRuns, *, seed: int = 0) -> tuple[xr.Dataset, xr.Dataset]:
        """(training runs, test runs), each in the dataset's order; `test` as in `runs_of`.

        Raises
        ------
        DataError
            If there is no such run, or if all runs would be test runs.
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

        Raises
        ------
        DataError
            If there is no such part.
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
        from data_schema.edges import face_edges

        return face_edges(self._dataset["face_nodes"].values)

    def surface(self, sim: int | str | None = None) -> pyvista.PolyData:
        """The undeformed faces, with node numbers on points, part and element numbers on cells.

        `sim` (name or place) says whose shape where the runs differ; the first run's without.
        """
        position = self._run(0 if sim is None else sim)["reference_position"].values
        return self._faces(np.asarray(position, np.float64), np.ones(self._dataset.sizes["face"], bool))

    def to_pyvista(self, sim: int | str = 0, time: float | int = -1, *, deform: bool = True) -> pyvista.PolyData:
        """One state of one run as a surface with the displacement and all fields on nodes and faces.

        Eroded faces are left out; nodes that nothing holds any more stay at their undeformed position, with NaN as
        displacement.

        Parameters
        ----------
        sim
            Name of the run, or its place.
        time
            Place of the state (int), or seconds (float): the nearest state.
        deform
            Points where they are then; else the undeformed position.

        Raises
        ------
        DataError
            For a run that is not there.
        """
        from data_schema import fields

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
