"""Opening a crash dataset, splitting it, and the accessor `.crash` on xarray datasets.

Importing this module registers the accessor; `xarray.open_dataset(path, engine="crashkit")` imports it too.
"""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Literal

import numpy as np
import xarray as xr

import crashkit.accessor  # noqa: F401  registers `.crash`
from crashkit.chunks import RUNS_WITH, damaged_chunk, lost_chunks
from crashkit.errors import CrashkitError, ReadError
from crashkit.netcdf import default_indexes, open_netcdf
from crashkit.presence import require_dataset
from crashkit.version import __version__
from data_schema import VARIABLES
from data_schema import dataset_checksum as _checksum_from
from data_schema.checksum import digests_of_run, run_checksum


def open_dataset(
    path: str | Path, *, chunks: Literal["stored"] | Mapping[str, int] | None = "stored", indexes: bool = True
) -> xr.Dataset:
    """The crash dataset at `path`, a `.zarr` folder or `.nc` file; values are read when they are asked for.

    Parameters
    ----------
    chunks
        "stored": as Dask arrays in the chunks of the store, so that sums over all runs stay small in memory, or
        without Dask where that is not installed; sizes by dimension for other chunks; None for no Dask.
    indexes
        Whether runs and times have indexes, which `.sel` needs. Making them imports Pint and Dask where they are
        installed, which takes longer than opening. Without them, names stay objects as the store gives them.

    Raises
    ------
    ReadError
        If there is nothing, or nothing of the kind; `data_schema.validate` tells whether it is good.
    """
    path = Path(path)
    require_dataset(path)
    is_folder = path.is_dir()
    if chunks == "stored":
        chunks = {} if importlib.util.find_spec("dask") else None
    try:
        if is_folder:
            dataset = xr.open_dataset(
                path, chunks=chunks, engine="zarr", consolidated=False, **default_indexes(indexes)
            )
        else:
            dataset = open_netcdf(path, chunks=chunks, indexes=indexes)
    except Exception as error:  # what a damaged file raises is up to the libraries below
        raise ReadError(
            f"{path}: cannot be opened as a dataset ({_one_line(error)}); expected one made by crashkit ingest"
        ) from error
    missing = [v.name for v in VARIABLES.values() if v.required and v.name not in dataset.variables]
    if missing:
        writer = dataset.attrs.get("crashkit_version")
        dataset.close()
        raise ReadError(
            f"{path}: holds no variable {', '.join(missing)}; expected a dataset made by crashkit ingest"
            + (f" (this one was written by crashkit {writer}, here is {__version__})" if writer else "")
            + ("; it is damaged" if "displacement" in dataset.variables else "")
        )
    with reading_dataset(path):
        lost = lost_chunks(path, [str(name) for name in dataset["sim"].values]) if is_folder else []
        if lost:
            dataset.close()
            raise ReadError(f"{path}: {lost[0]}; copy the dataset again, or ingest the run again")
        for variable in dataset.variables.values():
            variable.attrs.pop(RUNS_WITH, None)  # of the store, not of what it holds
        out = dataset
        if indexes:  # assigning a coordinate makes its index
            out = dataset.assign({n: _as_text(v) for n, v in dataset.variables.items() if v.dtype.kind in "OT"})
    out.encoding["source"] = str(path.absolute())  # a dataset in hand finds its mesh hierarchy by it
    if out is not dataset:
        out.set_close(dataset.close)
    return out


@contextlib.contextmanager
def opened_dataset(path: str | Path, *, indexes: bool = True) -> Iterator[xr.Dataset]:
    """The dataset at `path` within this context, without Dask; values that are damaged raise ReadError as they are read.

    For reading: an error of any other kind within it is taken for damage, see `reading_dataset`.
    """
    with open_dataset(path, chunks=None, indexes=indexes) as dataset, reading_dataset(path):
        yield dataset


@contextlib.contextmanager
def reading_dataset(path: str | Path) -> Iterator[None]:
    """Values read lazily from a damaged dataset raise ReadError within this context, and not what libraries raise."""
    try:
        yield
    except (CrashkitError, ImportError, MemoryError):
        raise
    except Exception as error:
        found = _damage(Path(path)) or f"cannot be read ({_one_line(error)}); it is damaged"
        raise ReadError(f"{path}: {found}; copy the dataset again, or ingest the run again") from error


def _damage(path: Path) -> str | None:
    """Which run and chunk of a Zarr folder is damaged; None where that cannot be found out."""
    if not path.is_dir():
        return None
    try:
        with xr.open_dataset(path, engine="zarr", consolidated=False, chunks=None) as dataset:
            runs = [str(name) for name in dataset["sim"].values]
    except Exception:  # the names themselves are damaged
        runs = []
    return damaged_chunk(path, runs)


def _as_text(variable: xr.Variable) -> xr.Variable:
    """Text as numpy's own, which both forms on disk give in another way."""
    values = np.asarray(variable.values, object)
    text = np.array([str(value) for value in values.ravel()], dtype=str).reshape(values.shape)
    return xr.Variable(variable.dims, text, variable.attrs, fastpath=True)  # without it xarray imports Dask to ask it


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:160] or type(error).__name__


def dataset_checksum(dataset: str | Path | xr.Dataset) -> str:
    """SHA-256 of a dataset's content, taken anew from its values (`data_schema.checksum`), whatever its form on disk.

    Ingest keeps the same number in the attribute `checksum`.
    """
    if not isinstance(dataset, xr.Dataset):
        with opened_dataset(dataset) as opened:
            return dataset_checksum(opened)
    runs = range(dataset.sizes["sim"])
    return _checksum_from(dataset, [run_checksum(digests_of_run(dataset, k)) for k in runs])


def demo_data() -> Path:
    """The embedded campaign: 36 kart crashes in the HDF5 layout of the paper's public data."""
    return Path(__file__).parent / "data" / "kart_demo.h5"


def bumper_data() -> Path:
    """The embedded second structure: 30 impacts of a front-end module on a pole, in the same HDF5 layout.

    Seven parts that share nodes, quads and triangles, five parameters, elements that fail (`alive`), plastic strain and
    time histories. 26 runs for training (the campaign's numbers below 96), then 4 for testing: 98, 104, 106 and 118.
    """
    return Path(__file__).parent / "data" / "bumper_demo.h5"
