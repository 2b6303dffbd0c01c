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

    def __repr__(self) -> str:
        from crashkit.display import as_text

        return as_text(*self._facts())

    def _repr_html_(self) -> str:
        from crashkit.display import as_html

        return as_html(*self._facts())

    def _facts(self) -> tuple[str, dict[str, object]]:
        """What the dataset is; reads the small variables only."""
        from crashkit.display import listed

        ds = self._dataset
        time = np.atleast_1d(ds["time"].values) if "time" in ds.variables else np.empty(0)
        names = np.atleast_1d(ds["part_name"].values) if "part_name" in ds.variables else ()
        facts: dict[str, object] = {
            "runs": f"{ds.sizes['sim']}: {listed(ds['sim'].values)}"
            if "sim" in ds.coords and "sim" in ds.dims
            else "one",
            "states": f"{len(time)} from {time[0]:.4g} to {time[-1]:.4g} s" if len(time) else "none",
            "mesh": f"{ds.sizes.get('node', 0)} nodes, {ds.sizes.get('face', 0)} faces, {ds.sizes.get('cell', 0)} cells",
            "parts": listed(names),
            "parameters": listed(
                f"{n} ({ds[n].attrs.get('units', '?')}) {float(ds[n].min()):.4g} to {float(ds[n].max()):.4g}"
                for n in self.parameters
            ),
        }
        facts |= {name: ds.attrs[name] for name in ("solver", "title", "checksum") if ds.attrs.get(name)}
        return "crash dataset", facts

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
        missing = [n for n in ("displacement", "reference_position", "face_nodes") if n not in ds.variables]
        if missing:
            raise DataError(f"the dataset has no {', '.join(missing)}; drawing needs the displacements and the mesh")
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
        mesh.set_active_scalars("displacement")  # what `.plot()` shows
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
        mesh = pyvista.PolyData(points, faces=padded[valid]) if len(corners) else pyvista.PolyData(points)
        if "line_nodes" in ds and ds.sizes["line"]:  # edges without a face, of coarse levels
            ends = ds["line_nodes"].values
            lines = np.column_stack([np.full(len(ends), 2), ends]).ravel()
            mesh = pyvista.PolyData(points, faces=padded[valid] if len(corners) else None, lines=lines)
        if "node_id" in ds:
            mesh.point_data["node_id"] = ds["node_id"].values
        if mesh.n_cells != len(corners):
            return mesh  # lines and lone points have no part
        if "face_part" in ds and "part_id" in ds:
            mesh.cell_data["part_id"] = ds["part_id"].values[ds["face_part"].values[which]]
        if "face_id" in ds:
            mesh.cell_data["element_id"] = ds["face_id"].values[which]
        return mesh
