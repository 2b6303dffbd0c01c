"""A crash dataset as evaluation sees it, with files that turn out to be damaged named when they are read."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr
    from numpy.typing import NDArray

    from data_schema.levels import Level
    from evaluation.comparison.reference import Reference

T = TypeVar("T")


def read_reference(name: str, dataset: xr.Dataset, levels: Sequence[Level] = ()) -> Reference:
    """The runs of a dataset; whatever is read of one later raises ReadError where it is damaged or missing.

    The displacements asked for last are kept until those of another run are: who asks for a run several times in a row
    reads it once. They must not be changed.

    Parameters
    ----------
    name
        What messages call the dataset: its path.
    levels
        Those of its mesh hierarchy.
    """
    from crashkit.dataset import reading_dataset
    from crashkit.errors import ReadError
    from data_schema.finite import all_finite
    from evaluation.comparison.reference import reference_of

    def guarded(read: Callable[[int], T]) -> Callable[[int], T]:
        def from_file(run: int) -> T:
            with reading_dataset(name):
                return read(run)

        return from_file

    recent: dict[int, NDArray[np.floating]] = {}

    def displacement(run: int) -> NDArray[np.floating]:
        if run not in recent:
            recent.clear()  # before the next one is read
            recent[run] = checked(run)
        return recent[run]

    def checked(run: int) -> NDArray[np.floating]:
        u = found.displacement(run).view()
        u.flags.writeable = False
        if not erodes and not all_finite(u):
            raise ReadError(
                f"{name}: displacements of run {found.runs[run]} are missing though nothing erodes; expected "
                f"numbers everywhere: see crashkit validate, and ingest the run again"
            )
        return u

    with reading_dataset(name):
        found = reference_of(dataset, levels)
    erodes = "alive" in dataset or "cell_alive" in dataset
    return dataclasses.replace(
        found,
        displacement=guarded(displacement),
        positions=None if found.positions is None else guarded(found.positions),
        alive=None if found.alive is None else guarded(found.alive),
        fields=None if found.fields is None else guarded(found.fields),
    )
