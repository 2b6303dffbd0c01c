"""Does a dataset keep the rules?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import xarray as xr

    from data_schema import Violation


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
        Where there is no dataset, or its values cannot be read.
    """
    import xarray as xr

    from crashkit.dataset import open_dataset, reading_dataset
    from data_schema import validate as violations

    if isinstance(dataset, xr.Dataset):
        with reading_dataset(str(dataset.encoding.get("source", "the dataset in memory"))):
            return violations(_alone(dataset), values=values)
    with open_dataset(dataset, chunks=None) as opened, reading_dataset(dataset):
        return violations(opened, values=values)


def _alone(dataset: xr.Dataset) -> xr.Dataset:
    """The dataset without the checksum of the whole, where it is a selection of what lies on disk."""
    from crashkit.dataset import open_dataset

    origin = dataset.encoding.get("source")
    if "checksum" not in dataset.attrs or not origin or not Path(origin).exists():
        return dataset
    with open_dataset(origin, chunks=None) as whole:
        if dict(whole.sizes) == dict(dataset.sizes):
            return dataset
    alone = dataset.copy(deep=False)
    del alone.attrs["checksum"]
    return alone
