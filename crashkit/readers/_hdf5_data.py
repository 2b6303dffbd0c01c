"""Whether the values of an HDF5 dataset are there, and in which files: HDF5 itself reads what is absent as zeros."""

from __future__ import annotations

from math import ceil, prod
from pathlib import Path
from typing import Any

from crashkit.errors import ReadError

SIGNATURE = b"\x89HDF\r\n\x1a\n"
# Virtual datasets may be made of virtual datasets, at most this deep.
_DEPTH = 4


def files_behind(dataset: Any, opened: Path, depth: int = 0) -> set[Path]:
    """The files beside `opened` that hold values of the h5py dataset: targets of links, sources of virtual datasets.

    Raises
    ------
    ReadError
        Where values are absent (a source that is missing, chunks that were never written), where they lie as raw
        bytes in other files, or in files outside the folder of `opened`.
    """
    place = f"{opened}: {dataset.name}"
    own = Path(dataset.file.filename)
    out = set() if own.resolve() == opened.resolve() else {own}
    if dataset.is_virtual:
        mapped = 0
        for source in dataset.virtual_sources():
            mapped += source.vspace.get_select_npoints()
            file = own if source.file_name == "." else own.parent / source.file_name
            out |= {file} if file != own else set()
            _require_inside(file, opened, place)
            if not file.is_file():
                raise ReadError(f"{place} takes values from {file.name}, which is not there; copy it beside")
            out |= _files_of_source(file, source.dset_name, place, depth)
        if mapped < dataset.size:
            raise ReadError(f"{place}: {dataset.size - mapped} of its {dataset.size} values are in none of its sources")
    elif dataset.external:
        raise ReadError(
            f"{place} keeps its values in {dataset.external[0][0]} as raw bytes, which is not read; repack it (h5repack)"
        )
    elif dataset.chunks is not None:
        expected = prod(ceil(size / step) for size, step in zip(dataset.shape, dataset.chunks, strict=True))
        written = dataset.id.get_num_chunks()
        if written < expected:
            raise ReadError(
                f"{place}: {expected - written} of its {expected} chunks were never written; the program that wrote it "
                "was stopped, or the file is damaged"
            )
    elif dataset.size and not dataset.id.get_storage_size():
        raise ReadError(f"{place}: its values were never written; the program that wrote it was stopped")
    for file in out:
        _require_inside(file, opened, place)
    return out


def _files_of_source(file: Path, name: str, place: str, depth: int) -> set[Path]:
    import h5py

    if depth == _DEPTH:
        raise ReadError(f"{place} is virtual over more than {_DEPTH} levels, which is not read")
    with h5py.File(file, "r") as source:
        found = source.get(name)
        if not isinstance(found, h5py.Dataset):
            raise ReadError(f"{place} takes values from {name} in {file.name}, which is not there")
        return {file.parent / f.name for f in files_behind(found, file, depth + 1)}


def _require_inside(file: Path, opened: Path, place: str) -> None:
    if not file.resolve().is_relative_to(opened.resolve().parent):
        raise ReadError(f"{place} takes values from {file}, outside the folder of the file; copy it there")
