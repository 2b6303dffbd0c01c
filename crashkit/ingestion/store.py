"""The two forms of a dataset on disk, a Zarr folder and a NetCDF4 file, and putting a new one in place of an old one.

Result arrays are kept one run a chunk row: every chunk holds all states of a block of nodes of one run
(`data_schema.checksum.blocks`), so the chunks of a run are files of their own, and a finished run moves from one
store into another as hard links.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from crashkit.chunks import KEYS, RUNS_WITH, codecs
from crashkit.errors import OutputError
from data_schema.checksum import block_length
from data_schema.replace import set_aside

if TYPE_CHECKING:
    import xarray as xr

SUFFIXES = (".zarr", ".nc")


@dataclass(frozen=True)
class ArraySpec:
    """A result array of one run: `dims` and `shape` without `sim`, e.g. (time, node, xyz)."""

    name: str
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: str
    attributes: Mapping[str, str] = field(default_factory=dict)

    @property
    def chunks(self) -> tuple[int, ...]:
        """All states of a block of nodes; reference positions (node, xyz) are one chunk."""
        if self.dims[0] != "time":
            return self.shape
        entry = np.dtype(self.dtype).itemsize * int(np.prod(self.shape[2:], dtype=np.int64))
        return (max(1, self.shape[0]), block_length(self.shape[0], self.shape[1], entry), *self.shape[2:])

    @property
    def fill(self) -> bool | float:
        """What stands where nothing was written: missing, or alive."""
        return True if self.dtype == "bool" else np.nan


@dataclass(frozen=True)
class RunSource:
    """Where the chunks of a run's arrays lie: a Zarr store and the run's place in it."""

    store: Path
    place: int


def check_output(output: Path) -> None:
    """Raise OutputError unless `output` can be made a dataset: its suffix, its folder, and that it can be written."""
    if output.suffix not in SUFFIXES:
        raise OutputError(f"{output}: a dataset is called NAME.zarr or NAME.nc; choose such a name")
    folder = output.absolute().parent
    if not folder.is_dir():
        raise OutputError(f"{output}: the folder {folder} does not exist; make it first")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"{output}: the folder {folder} cannot be written to; choose another")


# --- Zarr --------------------------------------------------------------------------------------------------------


def create_arrays(store: Path, specs: Sequence[ArraySpec], runs: int) -> dict[str, Any]:
    """A new Zarr store with empty arrays (sim, ...) for `runs` runs, by name."""
    import zarr

    group = zarr.open_group(str(store), mode="w")
    out = {}
    for spec in specs:
        out[spec.name] = group.create_array(
            spec.name,
            shape=(runs, *spec.shape),
            chunks=(1, *spec.chunks),
            dtype=spec.dtype,
            fill_value=spec.fill,
            compressors=codecs(),
            config={"write_empty_chunks": True},
            dimension_names=("sim", *spec.dims),
            chunk_key_encoding=KEYS,
            attributes=dict(spec.attributes),
        )
    return out


def write_zarr(target: Path, small: xr.Dataset, specs: Sequence[ArraySpec], runs: Sequence[RunSource]) -> None:
    """A whole dataset: `small` as it is, and of every array in `specs` the chunks that the `runs` have.

    A run without an array gets the array's fill value, which takes no space.
    """
    import zarr

    create_arrays(target, specs, len(runs))
    for spec in specs:
        chunks = {store: _chunks_of_runs(store / spec.name) for store in {source.store for source in runs}}
        having = [place for place, source in enumerate(runs) if chunks[source.store].get(source.place)]
        for place in having:
            source = runs[place]
            for chunk in chunks[source.store][source.place]:
                _link(chunk, target / spec.name / f"c.{place}.{chunk.name.split('.', 2)[2]}")
        if len(having) < len(runs):
            zarr.open_array(str(target / spec.name), mode="r+").attrs[RUNS_WITH] = json.dumps(having)
    group = zarr.open_group(str(target), mode="r+")
    for name, variable in small.variables.items():
        values = variable.values
        text = values.dtype.kind in "UOT"
        array = group.create_array(
            str(name),
            shape=values.shape,
            chunks=tuple(max(1, n) for n in values.shape),
            dtype=str if text else values.dtype,
            dimension_names=tuple(map(str, variable.dims)),
            fill_value=np.nan if values.dtype.kind == "f" else None,
            compressors=codecs(),
            config={"write_empty_chunks": True},
            chunk_key_encoding=KEYS,
            attributes=_coordinates_named(small, str(name), variable.attrs),
        )
        array[...] = values.astype(object) if text else values
    group.attrs.update(small.attrs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that Zarr 3 does not yet specify what xarray looks for first
        zarr.consolidate_metadata(str(target))


def _chunks_of_runs(array: Path) -> dict[int, list[Path]]:
    """Place of a run -> files of its chunks (`c.RUN.TIME.NODE...`)."""
    out: dict[int, list[Path]] = {}
    for chunk in sorted(array.glob("c.*")):
        out.setdefault(int(chunk.name.split(".")[1]), []).append(chunk)
    return out


def same_layout(store: Path, specs: Sequence[ArraySpec]) -> bool:
    """Whether the chunks of `store` can stand in a store of arrays `specs` as they are."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        create_arrays(Path(folder) / "like", specs, 1)
        return all(_layout(store / spec.name) in (None, _layout(Path(folder) / "like" / spec.name)) for spec in specs)


def _layout(array: Path) -> Any:
    """What decides how the chunks of an array are read; None where there is no such array."""
    with suppress(OSError, ValueError):
        found = json.loads((array / "zarr.json").read_text())
        return [found["shape"][1:], *(found[k] for k in ("chunk_grid", "codecs", "data_type", "chunk_key_encoding"))]
    return None


def _coordinates_named(small: xr.Dataset, name: str, attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Attributes of a variable; those of node_id also name the coordinates on nodes, for CF readers."""
    beside = [str(c) for c in small.coords if small[c].dims == small[name].dims and str(c) != name]
    if name in small.coords or not beside:
        return dict(attributes)
    return {**attributes, "coordinates": " ".join(beside)}


def _link(source: Path, target: Path) -> None:
    """A hard link, or a copy where the disk has none. Chunks are never written again, so sharing them is safe."""
    try:
        os.link(source, target)
    except OSError as error:
        if error.errno == errno.ENOSPC:
            raise
        shutil.copyfile(source, target)


# --- NetCDF ------------------------------------------------------------------------------------------------------


def write_netcdf(target: Path, small: xr.Dataset, specs: Sequence[ArraySpec], runs: Sequence[RunSource]) -> None:
    """The same content as `write_zarr`, as one NetCDF4 file, copied block by block."""
    import netCDF4

    from crashkit.netcdf import writing

    sizes = {str(d): n for d, n in small.sizes.items()} | {"sim": len(runs)}
    for spec in specs:
        sizes |= dict(zip(spec.dims, spec.shape))
    with writing(target), netCDF4.Dataset(str(target), "w") as out:
        out.setncatts(small.attrs)
        for dim, size in sizes.items():
            out.createDimension(dim, size)
        for name, variable in small.variables.items():
            attributes = _coordinates_named(small, str(name), variable.attrs)
            written = _create(out, str(name), tuple(map(str, variable.dims)), variable.dtype, attributes)
            written[...] = variable.values.astype(object) if written.dtype is str else variable.values
        for spec in specs:
            written = _create(
                out, spec.name, ("sim", *spec.dims), np.dtype(spec.dtype), dict(spec.attributes), (1, *spec.chunks)
            )
            for place, source in enumerate(runs):
                for block, values in _stored_blocks(source, spec):
                    written[(place, *block)] = values


def _create(
    out: Any, name: str, dims: tuple[str, ...], dtype: Any, attributes: dict[str, Any], chunks: Any = None
) -> Any:
    if dtype.kind in "UOT":
        variable = out.createVariable(name, str, dims)
    else:
        options: dict[str, Any] = {"fill_value": np.nan} if dtype.kind == "f" else {}
        if dims:
            options |= {
                "compression": "zlib",
                "complevel": 1,
                "shuffle": True,
                "chunksizes": chunks,
                "fletcher32": True,
            }
        variable = out.createVariable(name, "i1" if dtype.kind == "b" else dtype, dims, **options)
    if dtype.kind == "b":
        attributes["dtype"] = "bool"  # how xarray remembers what NetCDF has no type for
    variable.setncatts(attributes)
    return variable


def _stored_blocks(source: RunSource, spec: ArraySpec) -> Iterator[tuple[tuple[slice, ...], NDArray[Any]]]:
    """(where, values) of a run's array, block by block; the fill value where the run has no such array."""
    import zarr

    folder = source.store / spec.name
    array = zarr.open_array(str(folder), mode="r") if (folder / "zarr.json").exists() else None
    axis = 1 if spec.dims[0] == "time" else 0
    length, step = spec.shape[axis], spec.chunks[axis]
    for first in range(0, length, step):
        where = (slice(None),) * axis + (slice(first, min(first + step, length)),)
        if array is not None:
            yield where, np.asarray(array[(source.place, *where)])
        else:
            shape = list(spec.shape)
            shape[axis] = min(first + step, length) - first
            yield where, np.full(shape, spec.fill, spec.dtype)


def read_array(source: RunSource, name: str) -> NDArray[Any]:
    """A run's whole array."""
    import zarr

    return np.asarray(zarr.open_array(str(source.store / name), mode="r")[source.place])


def zarr_from(dataset: xr.Dataset, specs: Sequence[ArraySpec], target: Path) -> None:
    """The result arrays of an open dataset as a Zarr store of the layout `specs`, run by run and block by block."""
    arrays = create_arrays(target, [s for s in specs if s.name in dataset.variables], dataset.sizes["sim"])
    for spec in specs:
        if spec.name not in arrays:
            continue
        shared = "sim" not in dataset[spec.name].dims
        for run in range(dataset.sizes["sim"]):
            values = dataset[spec.name] if shared else dataset[spec.name].isel(sim=run)
            if spec.dims[0] != "time":
                arrays[spec.name][run] = values.values
                continue
            for first in range(0, spec.shape[1], spec.chunks[1]):
                part = slice(first, first + spec.chunks[1])
                arrays[spec.name][run, :, part] = values[:, part].values


# --- putting in place --------------------------------------------------------------------------------------------


def recover(staging: Path, output: Path) -> None:
    """Bring back a dataset that was set aside when the process died."""
    aside = set_aside(staging / "whole", output)
    if aside.exists() and not output.exists():
        aside.replace(output)
