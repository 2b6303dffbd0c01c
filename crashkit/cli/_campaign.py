"""From a dataset on disk to what a surrogate is trained on: the training runs as arrays, the test runs left out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr
    from numpy.typing import NDArray

    from surrogates.data import Campaign


class RunField:
    """Displacements (sim, state, node, 3) of chosen runs, m; a run is read when it is asked for."""

    def __init__(self, displacement: xr.DataArray, runs: Sequence[int]) -> None:
        self._displacement = displacement
        self._runs = list(runs)
        self.shape = (len(self._runs), *displacement.shape[1:])

    def __getitem__(self, run: int) -> NDArray[np.float32]:
        return self._displacement.isel(sim=self._runs[run]).values


def open_campaign(path: str | Path, test: Any = None) -> Campaign:
    """The runs of the dataset at `path` without the test runs, as `crashkit.dataset.runs_of` understands `test`.

    The full field is read run by run by those models that need it; the cascade reads its levels only.

    Raises ReadError or DataError where the dataset cannot be opened or `test` names no runs, or all.
    """
    import numpy as np

    from crashkit.dataset import open_dataset, runs_of
    from crashkit.errors import DataError
    from crashkit.mesh.store import level_displacement, read_hierarchy
    from data_schema import parameters
    from surrogates.data import Campaign, GraphLevel

    path = Path(path)
    dataset = open_dataset(path)
    runs = [str(n) for n in dataset["sim"].values]
    held_out = [] if test is None else runs_of(runs, test)
    chosen = [k for k in range(len(runs)) if k not in set(held_out)]
    if not chosen:
        raise DataError(f"{path}: all {len(runs)} runs would be test runs; leave some for training")
    names = parameters(dataset)
    if not names:
        raise DataError(f"{path}: no run has a parameter; give them with crashkit ingest --params")
    try:
        stored = read_hierarchy(path).levels
    except DataError as error:
        if "has no mesh hierarchy" not in str(error):
            raise
        stored = ()
    levels = tuple(GraphLevel(k.index, k.kept, k.faces, k.edges, k.in_finer, k.to_finer, k.to_full) for k in stored)
    at = dataset["reference_position"]

    def displacement(level: int) -> Any:
        return RunField(dataset["displacement"], chosen) if level == 0 else level_displacement(path, level, chosen)

    return Campaign(
        parameters=np.stack([dataset[n].values[chosen].astype(np.float64) for n in names], axis=1),
        parameter_names=tuple(names),
        parameter_units=tuple(str(dataset[n].attrs.get("units", "")) for n in names),
        time=dataset["time"].values.astype(np.float64),
        displacement=displacement,
        n_nodes=dataset.sizes["node"],
        levels=levels,
        full_edges=dataset.crash.edges(),
        runs=tuple(runs[k] for k in chosen),
        checksum=str(dataset.attrs.get("checksum", "")),
        attributes={"dataset": path.name, "solver": str(dataset.attrs.get("solver", ""))},
        held_out=tuple(runs[k] for k in held_out),
        points=np.asarray((at.isel(sim=0) if "sim" in at.dims else at).values, np.float64),
        faces=dataset["face_nodes"].values.astype(np.int32),
    )
