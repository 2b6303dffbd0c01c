"""A dataset however it is given: as a path, or as the xarray dataset in hand, of all runs or of a selection."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import xarray as xr

    from crashkit.mesh.levels import Hierarchy


@dataclass(frozen=True)
class Source:
    """The dataset that a public function works on.

    Attributes
    ----------
    name
        What messages and reports call it.
    path
        Where it is on disk; None for a dataset in hand.
    dataset
        The dataset in hand; None for one on disk.
    hierarchy
        The mesh hierarchy that was given with it, or that is stored in it; None where there is none.
    stored
        Whether that hierarchy is the one stored at `path`, with the displacements of its levels.
    """

    name: str
    path: Path | None
    dataset: xr.Dataset | None
    hierarchy: Hierarchy | None
    stored: bool = False

    @contextlib.contextmanager
    def opened(self) -> Iterator[xr.Dataset]:
        """The dataset, read lazily; closed afterwards where it was opened here."""
        from crashkit.dataset import open_dataset

        if self.dataset is not None:
            yield self.dataset
        elif self.path is not None:
            with open_dataset(self.path, chunks=None) as dataset:
                yield dataset


def source_of(dataset: str | Path | xr.Dataset, hierarchy: Hierarchy | None = None) -> Source:
    """What was given, with the mesh hierarchy that belongs to it.

    A dataset in hand that was opened from disk, and whose mesh is still that on disk, has the hierarchy on disk.

    Raises
    ------
    ReadError
        Where there is no such dataset.
    DataError
        Where a dataset in hand lacks what makes it a crash dataset, or `hierarchy` belongs to another mesh.
    """
    import xarray as xr

    from crashkit.mesh.store import has_hierarchy, open_hierarchy

    if isinstance(dataset, xr.Dataset):
        name = _name(dataset)
        _check(dataset, name)
        found = hierarchy or _on_disk(dataset)
        _fits(found, dataset, name)
        return Source(name, None, dataset, found)
    path = Path(dataset)
    with Source(str(path), path, None, None).opened() as opened:
        _fits(hierarchy, opened, str(path))
    stored = hierarchy is None and has_hierarchy(path)
    return Source(str(path), path, None, open_hierarchy(path) if stored else hierarchy, stored)


def _name(dataset: xr.Dataset) -> str:
    """The file it was opened from, or its title."""
    return str(dataset.encoding.get("source") or dataset.attrs.get("title") or "the dataset in memory")


def _check(dataset: xr.Dataset, name: str) -> None:
    from crashkit.errors import DataError
    from data_schema import VARIABLES

    missing = [v.name for v in VARIABLES.values() if v.required and v.name not in dataset.variables]
    if missing:
        raise DataError(
            f"{name}: holds no variable {', '.join(missing)}; expected a crash dataset: make one with crashkit.ingest or "
            "crashkit.from_arrays"
        )
    if "sim" not in dataset["displacement"].dims:
        raise DataError(f"{name}: holds one run without the dimension sim; keep it with .isel(sim=[0])")


def _on_disk(dataset: xr.Dataset) -> Hierarchy | None:
    """The hierarchy of the file that the dataset in hand was opened from, where it still has the mesh of that file."""
    import numpy as np

    from crashkit.dataset import opened_dataset
    from crashkit.mesh.store import has_hierarchy, open_hierarchy

    origin = dataset.encoding.get("source")
    if not origin or not Path(origin).exists() or not has_hierarchy(origin):
        return None
    with opened_dataset(origin) as stored:
        names = [
            "node_id",
            "face_nodes",
            *(["reference_position"] if "sim" not in stored["reference_position"].dims else []),
        ]
        same = all(np.array_equal(stored[name].values, dataset[name].values) for name in names)
    return open_hierarchy(origin) if same else None


def _fits(hierarchy: Hierarchy | None, dataset: xr.Dataset, name: str) -> None:
    from crashkit.errors import DataError

    if hierarchy is not None and hierarchy.n_nodes != dataset.sizes["node"]:
        raise DataError(
            f"{name}: has {dataset.sizes['node']} nodes, but the hierarchy was made for a mesh of {hierarchy.n_nodes}; "
            "build it from this dataset with crashkit.coarsen"
        )
