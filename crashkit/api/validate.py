"""Does a dataset keep the rules?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import xarray as xr

    from data_schema import Violation


# Values of a variable that are read again, whole, at no cost.
_SMALL = 1 << 20


def validate(dataset: str | Path | xr.Dataset, *, values: bool = True) -> list[Violation]:
    """Every violation of the rules of a crash dataset; an empty list means the dataset is good.

    Parameters
    ----------
    dataset
        Path of a crash dataset, or the dataset in hand: all runs, or a selection of them.
    values
        Also look at the values, which reads the results once, block by block, and takes the checksums anew. Without,
        names, dimensions, types, units and attributes only. The checksum of a whole dataset is not that of a
        selection of its runs, of which each run's own is compared.

    Raises
    ------
    ReadError
        Where there is no dataset, or its values, or those of its hierarchy, cannot be read.
    DataError
        Where the hierarchy is not one of this dataset.
    """
    import numpy as np
    import xarray as xr

    from crashkit.dataset import opened_dataset, reading_dataset
    from data_schema import validate as violations

    if isinstance(dataset, xr.Dataset):
        with reading_dataset(str(dataset.encoding.get("source", "the dataset in memory"))):
            return violations(_alone(dataset), values=values)
    with opened_dataset(dataset) as opened:
        found = violations(opened, values=values)
        if values:
            for variable in opened.variables.values():  # results were read by state; what is small, no rule may ask for
                if variable.size <= _SMALL:
                    np.asarray(variable[...])
    if values and not found:
        _read_levels(Path(dataset))
    return found


def _read_levels(path: Path) -> None:
    """Read the hierarchy, if there is one, and the displacements stored with it: what is damaged is refused as elsewhere."""
    from crashkit.dataset import reading_dataset
    from crashkit.mesh.store import has_hierarchy, level_displacement, open_hierarchy, runs_of_hierarchy

    if has_hierarchy(path):
        with reading_dataset(path):
            open_hierarchy(path)
            for run in range(runs_of_hierarchy(path)):
                level_displacement(path, 1, [run])


def _alone(dataset: xr.Dataset) -> xr.Dataset:
    """The dataset without the checksum of the whole, where it is a selection of what lies on disk."""
    from crashkit.dataset import opened_dataset

    origin = dataset.encoding.get("source")
    if "checksum" not in dataset.attrs or not origin or not Path(origin).exists():
        return dataset
    with opened_dataset(origin) as whole:
        if dict(whole.sizes) == dict(dataset.sizes):
            return dataset
    alone = dataset.copy(deep=False)
    del alone.attrs["checksum"]
    return alone
