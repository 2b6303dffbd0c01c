"""What a dataset holds, as one SHA-256: the same for Zarr and NetCDF, any chunking and any number of workers.

A run's own checksum covers its results (displacement, `alive`, fields); the dataset's covers these, the runs'
names and parameters, and everything the runs share: times, nodes, faces, cells and parts with their numbers and names.
Attributes are left out: they tell how, not what.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from data_schema.layout import VARIABLES, fields, parameters

if TYPE_CHECKING:
    import xarray as xr

# Results are stored and hashed in blocks of all states and some nodes (faces, cells), of about this many bytes.
BLOCK_BYTES = 8 << 20
# They say again, for UGRID readers, what other variables say.
_COPIES = ("mesh", "node_x", "node_y", "node_z")


def blocks(states: int, length: int, entry_bytes: int) -> list[tuple[int, int]]:
    """Ranges first <= node < last of nearly equal size whose values of all states stay near `BLOCK_BYTES`.

    `length` counts nodes (faces, cells), `entry_bytes` the bytes of one of them in one state. This is the chunking
    of a dataset as well.
    """
    step = block_length(states, length, entry_bytes)
    return [(k, min(k + step, length)) for k in range(0, length, step)]


def block_length(states: int, length: int, entry_bytes: int) -> int:
    """Nodes (faces, cells) in a block; at least 1."""
    most = max(1, BLOCK_BYTES // max(1, states * entry_bytes))
    count = max(1, -(-length // most))
    return max(1, -(-length // count))


@dataclass(frozen=True)
class BlockDigest:
    """SHA-256 of one block (time, nodes of the block, ...), and whether all in it is the default."""

    sha256: bytes
    is_default: bool


def block_digest(block: NDArray[Any]) -> BlockDigest:
    """Digest of a block; the default is True for bools (alive) and NaN for numbers (missing)."""
    plain = np.ascontiguousarray(block, dtype=block.dtype.newbyteorder("<"))
    is_default = plain.all() if plain.dtype.kind == "b" else np.isnan(plain.flat[:1]).all() and np.isnan(plain).all()
    return BlockDigest(hashlib.sha256(plain.data).digest(), bool(is_default))


def array_digest(blocks: Iterable[BlockDigest]) -> str | None:
    """SHA-256 of the digests of one run's array, in order.

    None where all is the default: an all-default array is treated as absent, and left out of the run's checksum.
    """
    found = list(blocks)
    if all(block.is_default for block in found):
        return None
    return hashlib.sha256(b"".join(block.sha256 for block in found)).hexdigest()


def run_checksum(digests: Mapping[str, str]) -> str:
    """SHA-256 of a run from the digests of its arrays by name."""
    return _of(f"{name} {digests[name]}" for name in sorted(digests))


def results(dataset: xr.Dataset) -> list[str]:
    """Names of the variables that hold a run's results: displacement, alive, cell_alive and fields."""
    return [n for n in ("displacement", "alive", "cell_alive", *fields(dataset)) if n in dataset.variables]


def result_blocks(variable: xr.DataArray | xr.Variable) -> Iterator[tuple[int, int, NDArray[Any]]]:
    """(first, last, values (time, nodes, ...)) for one run's variable (time, node | face | cell, ...)."""
    entry = variable.dtype.itemsize * int(np.prod(variable.shape[2:], dtype=np.int64))
    for first, last in blocks(variable.shape[0], variable.shape[1], entry):
        yield first, last, variable[:, first:last].values


def digests_of_run(dataset: xr.Dataset, sim: int) -> dict[str, str]:
    """Digest of each result array of run number `sim` that says something, read block by block."""
    found = {
        name: array_digest(block_digest(block) for _, _, block in result_blocks(dataset[name].isel(sim=sim)))
        for name in results(dataset)
    }
    return {name: digest for name, digest in found.items() if digest is not None}


def shared(dataset: xr.Dataset) -> list[str]:
    """Names of the variables of the layout that all runs share, without those that only repeat others."""
    return [n for n in VARIABLES if n in dataset.variables and "sim" not in dataset[n].dims and n not in _COPIES]


def dataset_checksum(
    dataset: xr.Dataset,
    run_checksums: Iterable[str],
    positions: Callable[[int], NDArray[Any]] | None = None,
) -> str:
    """SHA-256 of a dataset whose runs have the given checksums, in their order; reads the small variables only.

    `positions(run number)` gives (node, 3) float64, m, where the runs differ in shape and `dataset` is without them.
    """
    reference = dataset.get("reference_position")
    if reference is not None and "sim" in reference.dims:
        positions = lambda k: reference.isel(sim=k).values  # noqa: E731
    lines = [
        f"{name} {_array(dataset[name].values)}"
        for name in shared(dataset)
        if positions is None or name != "reference_position"
    ]
    names = sorted(parameters(dataset))
    for k, (run, checksum) in enumerate(zip(dataset["sim"].values, run_checksums, strict=True)):
        values = [f"{name}={float(dataset[name].values[k]).hex()}" for name in names]
        shape = [_array(positions(k))] if positions is not None else []
        lines.append(" ".join([str(run), *values, *shape, checksum]))
    return _of(lines)


def _array(values: NDArray[Any]) -> str:
    """SHA-256 of shape and content, whatever the width of the numbers, or how text is kept."""
    if values.dtype.kind in "OTU":
        content = "\0".join(map(str, values.ravel())).encode()
    else:
        content = values.astype("<f8" if values.dtype.kind == "f" else "<i8").tobytes()
    return hashlib.sha256(f"{values.shape}".encode() + content).hexdigest()


def _of(lines: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()
