"""Chunks of a Zarr store: each carries a checksum, and those that are damaged or lost are named.

Zarr takes a lost chunk for one that was never written, and gives NaN or zero in its place. The stores of this package
write every chunk, so that a file that is not there is a loss; runs without an array are listed in its attributes. They
are known by how chunks are called: what a user stores with xarray (`ds.isel(sim=...).to_zarr(path)`) keeps the codecs, but
calls its chunks otherwise and leaves out those that hold fill values alone.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

# Attribute of an array on `sim`: JSON list of the places of the runs that have it, where not all have.
RUNS_WITH = "runs_with"
CHECKSUM = "crc32c"
# One folder an array, not one a chunk.
KEYS: Any = {"name": "default", "separator": "."}

_GOOD: dict[Path, tuple[Any, ...]] = {}


def codecs() -> list[Any]:
    """What array chunks are compressed with, and their checksum.

    LZ4 behind a byte shuffle keeps pace with the disk; what compresses better writes at half the speed or less.
    """
    from zarr.codecs import BloscCodec, Crc32cCodec

    return [BloscCodec(cname="lz4", clevel=5, shuffle="shuffle"), Crc32cCodec()]


def lost_chunks(store: Path, runs: Sequence[str] = ()) -> list[str]:
    """What is missing in the arrays of the Zarr folder `store`, in words; empty where nothing is.

    Parameters
    ----------
    runs
        Names of the runs, for the words.
    """
    arrays = sorted(p.parent for p in store.rglob("zarr.json"))
    state = tuple((a, a.stat().st_mtime_ns) for a in arrays)
    if _GOOD.get(store.absolute()) == state:
        return []
    found = [said for array in arrays for said in _lost_in(store, array, runs)]
    if not found:
        _GOOD[store.absolute()] = state
    return found


def _lost_in(store: Path, array: Path, runs: Sequence[str]) -> Iterator[str]:
    about = _about(array)
    if about is None or 0 in about[0]:
        return
    shape, chunks, dims, attributes = about
    counts = [max(1, math.ceil(n / c)) for n, c in zip(shape, chunks, strict=True)]
    if not shape:
        if not (array / "c").exists():
            yield f"chunk {array.relative_to(store)}/c is lost"
        return
    by_run = bool(dims) and dims[0] == "sim" and counts[0] == shape[0]
    expected = set(json.loads(attributes[RUNS_WITH])) if RUNS_WITH in attributes else set(range(counts[0]))
    there = {entry.name for entry in array.iterdir()}
    for place in itertools.product(*map(range, counts)):
        name = "c." + ".".join(map(str, place))
        if name not in there and place[0] in expected:
            run = f" of run {runs[place[0]] if place[0] < len(runs) else place[0]}" if by_run else ""
            yield f"chunk {array.relative_to(store)}/{name}{run} is lost"
            return


def damaged_chunk(store: Path, runs: Sequence[str] = ()) -> str | None:
    """The first chunk that cannot be read, in words: reads everything, so it is for when something failed."""
    import zarr

    for array in sorted(p.parent for p in store.rglob("zarr.json")):
        try:
            opened = zarr.open_array(str(array), mode="r")
        except Exception:  # a group, or metadata that xarray complained of already
            continue
        if 0 in opened.shape:
            continue
        if not opened.shape:
            try:
                opened[...]
            except Exception:
                return f"chunk {array.relative_to(store)}/c is damaged"
            continue
        grid = [range(0, n, max(1, c)) for n, c in zip(opened.shape, opened.chunks, strict=True)]
        for corner in itertools.product(*grid):
            try:
                opened[tuple(slice(a, a + c) for a, c in zip(corner, opened.chunks, strict=True))]
            except Exception:
                name = ".".join(str(a // c) for a, c in zip(corner, opened.chunks, strict=True))
                by_run = opened.chunks[0] == 1 and opened.shape[0] == len(runs)
                run = f" of run {runs[corner[0]]}" if by_run else ""
                return f"chunk {array.relative_to(store)}/c.{name}{run} is damaged"
    return None


def _about(array: Path) -> tuple[list[int], list[int], list[str], dict[str, Any]] | None:
    """Shape, chunks, dimensions and attributes; None of a group, and of an array that was not written by this package."""
    try:
        found = json.loads((array / "zarr.json").read_text())
        if found.get("node_type") != "array" or CHECKSUM not in [c["name"] for c in found["codecs"]]:
            return None
        if found["chunk_key_encoding"].get("configuration", {}).get("separator") != KEYS["separator"]:
            return None
        chunks = found["chunk_grid"]["configuration"]["chunk_shape"]
        return found["shape"], chunks, found.get("dimension_names") or [], found.get("attributes") or {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
