"""How a dataset gets to disk so that a killed process loses nothing that was finished.

Runs are written into a Zarr store `NAME.partial/data` beside the wanted output. A chunk never spans two runs, so each
run is a set of files of its own; once they are all there, one line in `NAME.partial/journal` says so (written and
synchronised last). At the end the store is completed, brought to its final form and renamed into place. A later start
with the same plan goes on behind the last line of the journal.
"""

from __future__ import annotations

import json
import os
import shutil
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import OutputError

if TYPE_CHECKING:
    import xarray as xr
    import zarr

# Nodes a chunk: 101 states x 16384 nodes x 3 x 4 bytes are 20 MB, small enough to read alone, large enough to be quick.
NODE_BLOCK = 16384


@dataclass(frozen=True)
class ArraySpec:
    """One array on (sim, time, ...) or (sim, ...): what is needed to create it before any run is read."""

    name: str
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: str
    attributes: Mapping[str, Any]

    @property
    def chunks(self) -> tuple[int, ...]:
        sizes = list(self.shape)
        sizes[0] = 1
        for axis, dim in enumerate(self.dims):
            if dim in ("node", "face", "cell"):
                sizes[axis] = max(1, min(sizes[axis], NODE_BLOCK))
        return tuple(max(1, s) for s in sizes)


class Staging:
    """The folder `NAME.partial` while a dataset is being made."""

    def __init__(self, output: Path) -> None:
        self.output = output
        self.folder = output.with_name(output.name + ".partial")
        self.data = self.folder / "data"
        self._plan = self.folder / "plan.json"
        self._journal = self.folder / "journal"

    def begin(self, plan: Mapping[str, Any]) -> bool:
        """Start, or go on where an earlier start with the same plan was; True if it goes on.

        Anything left by a different plan is thrown away: it belongs to a command that was given up.
        """
        text = json.dumps(plan, sort_keys=True)
        try:
            if self._plan.exists() and self._plan.read_text() == text:
                return True
            if self.folder.exists():
                shutil.rmtree(self.folder)
            self.folder.mkdir(parents=True)
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be written ({error.strerror or error})") from error
        self._fresh_plan = text
        return False

    def ready(self) -> None:
        """Note that the empty arrays are all there; from here on a restart goes on instead of starting over."""
        temporary = self._plan.with_suffix(".new")
        temporary.write_text(self._fresh_plan)
        temporary.replace(self._plan)

    def create(self, specs: list[ArraySpec]) -> None:
        """Make the empty arrays."""
        root = self._root("w")
        for spec in specs:
            fill: Any = False if spec.dtype == "bool" else (np.nan if spec.dtype.startswith("float") else 0)
            array = root.create_array(
                spec.name,
                shape=spec.shape,
                chunks=spec.chunks,
                dtype=spec.dtype,
                fill_value=fill,
                dimension_names=spec.dims,
                compressors=_compressor(spec.dtype),
                config={"write_empty_chunks": True},
            )
            array.attrs.update(dict(spec.attributes))

    def array(self, name: str) -> zarr.Array:
        array: Any = self._root("r+")[name]
        return array.with_config({"write_empty_chunks": True})

    def _root(self, mode: Any) -> zarr.Group:
        import zarr

        return zarr.open_group(str(self.data), mode=mode)

    def finished(self) -> dict[int, dict[str, Any]]:
        """What the journal says: record by slot. A torn last line is ignored; its run is written again."""
        if not self._journal.exists():
            return {}
        out = {}
        for line in self._journal.read_text().splitlines():
            try:
                record = json.loads(line)
            except ValueError:
                continue
            out[int(record["slot"])] = record
        return out

    def note(self, record: Mapping[str, Any]) -> None:
        """Add a finished run to the journal."""
        with self._journal.open("a") as stream:
            stream.write("\n" + json.dumps(dict(record)) + "\n")
            stream.flush()
            os.fsync(stream.fileno())

    def compact(self, slots: list[int], names: list[str]) -> None:
        """Keep only `slots` (increasing) of the arrays `names`, moved together at the front.

        A chunk's file lies under `c/<sim>/`, since no chunk spans two runs: moving a run is renaming a folder. They
        are gathered in a folder beside `c`, so that a start after a kill sees which were moved before.
        """
        root = self._root("r+")
        for name in names:
            array: Any = root[name]
            if array.shape[0] == len(slots):
                continue
            chunks, kept = self.data / name / "c", self.data / name / "c.kept"
            kept.mkdir(exist_ok=True)
            for new, old in enumerate(slots):
                if (chunks / str(old)).exists() and not (kept / str(new)).exists():
                    (chunks / str(old)).replace(kept / str(new))
            if chunks.exists():
                shutil.rmtree(chunks)
            kept.replace(chunks)
            array.resize((len(slots), *array.shape[1:]))

    def adopt(self, dataset: Path, specs: list[ArraySpec], slots: list[int]) -> None:
        """Take the runs `slots` of an existing Zarr dataset over, as hard links where the disk allows."""
        for spec in specs:
            for slot in slots:
                source = dataset / spec.name / "c" / str(slot)
                if source.exists():
                    shutil.copytree(
                        source, self.data / spec.name / "c" / str(slot), copy_function=_link, dirs_exist_ok=True
                    )

    def publish(self, constants: xr.Dataset) -> None:
        """Add what does not depend on the run, bring the store to the form of the output, and rename it into place."""
        check_suffix(self.output)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Zarr says of text arrays that their format is young
            constants.to_zarr(str(self.data), mode="a", consolidated=False, encoding={})
        try:
            if self.output.suffix == ".nc":
                finished = self.folder / "data.nc"
                _to_netcdf(self.data, finished)
            else:
                finished = self.data
            replace(finished, self.output)
            shutil.rmtree(self.folder, ignore_errors=True)
        except OSError as error:
            raise OutputError(f"{self.output}: cannot be put into place ({error.strerror or error})") from error


def check_suffix(output: Path) -> None:
    """Raise OutputError unless the name ends in .zarr or .nc."""
    if output.suffix not in (".zarr", ".nc"):
        raise OutputError(f"{output}: a dataset is called something.zarr or something.nc")


def replace(new: Path, old: Path) -> None:
    """Put `new` where `old` is. At any moment one of the two is whole, under its name or `NAME.replaced`."""
    aside = old.with_name(old.name + ".replaced")
    if old.is_dir():
        if aside.exists():
            shutil.rmtree(aside)
        old.replace(aside)
    new.replace(old)
    if aside.exists():
        shutil.rmtree(aside)


def recover(output: Path) -> None:
    """Undo a replacement that was killed between its two steps."""
    aside = output.with_name(output.name + ".replaced")
    if aside.exists() and not output.exists():
        aside.replace(output)


def _compressor(dtype: str) -> Any:
    from zarr.codecs import BloscCodec

    # Displacements are noise in their low bytes: bitshuffle with lz4 keeps pace with a disk and still halves them.
    return BloscCodec(cname="lz4", clevel=3, shuffle="bitshuffle" if dtype != "bool" else "shuffle")


def _link(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def _to_netcdf(store: Path, file: Path) -> None:
    """The same content as one NetCDF4 file, copied run by run."""
    import netCDF4
    import xarray as xr

    with (
        xr.open_dataset(str(store), engine="zarr", consolidated=False, chunks=None, decode_cf=False) as source,
        netCDF4.Dataset(str(file), "w") as out,
    ):
        out.setncatts(source.attrs)
        for dim, size in source.sizes.items():
            out.createDimension(str(dim), size)
        for name, variable in source.variables.items():
            _copy_variable(out, str(name), variable)


def _copy_variable(out: Any, name: str, variable: xr.Variable) -> None:
    text = variable.dtype.kind in "UOT"
    kind: Any = str if text else ("i1" if variable.dtype.kind == "b" else variable.dtype)
    options: dict[str, Any] = {}
    if not text and variable.ndim:
        options = {"compression": "zlib", "complevel": 1, "shuffle": True}
        if variable.dims[0] == "sim" and variable.ndim > 1:
            options["chunksizes"] = ArraySpec(name, tuple(map(str, variable.dims)), variable.shape, "", {}).chunks
    if variable.dtype.kind == "f":
        options["fill_value"] = np.nan
    target = out.createVariable(name, kind, variable.dims, **options)
    attributes = {k: v for k, v in variable.attrs.items() if k != "_FillValue"}
    if variable.dtype.kind == "b":
        attributes["dtype"] = "bool"  # how xarray remembers what NetCDF has no type for
    target.setncatts(attributes)
    for block in _blocks(variable):
        values: NDArray[Any] = np.asarray(variable[block].values)
        target[block] = values.astype(object) if text else (values.astype("i1") if values.dtype.kind == "b" else values)


def _blocks(variable: xr.Variable) -> Iterator[Any]:
    if variable.ndim and variable.dims[0] == "sim" and variable.ndim > 1:
        for k in range(variable.shape[0]):
            yield (slice(k, k + 1),)
    else:
        yield (Ellipsis,)
