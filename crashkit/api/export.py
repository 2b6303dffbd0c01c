"""Runs of a dataset as files for ParaView."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import xarray as xr


def export_run(dataset: str | Path | xr.Dataset, run: str | int, output: str | Path) -> list[Path]:
    """Write one run of a dataset for ParaView: displacement, fields, numbers, part names and parameters.

    Parameters
    ----------
    dataset
        A crash dataset, or the path of one.
    run
        Name or place of the run.
    output
        `.pvd` or `.vtkhdf` (`.vtu` or `.vtp` for a dataset of one state).

    Returns
    -------
    list of Path
        The files written, the one to open first.

    Raises
    ------
    DataError
        If there is no such run.
    ReadError
        If the dataset is damaged.
    OutputError
        If `output` cannot be written.
    """
    from crashkit.dataset import open_dataset, reading_dataset
    from crashkit.selection import runs_of
    from crashkit.writers.run import write_run

    if isinstance(dataset, (str, Path)):
        with open_dataset(dataset, chunks=None) as opened, reading_dataset(dataset):
            return export_run(opened, run, output)
    names = [str(name) for name in dataset["sim"].values]
    place = runs_of(names, [run])[0]
    return write_run(dataset.isel(sim=place), Path(output), {"run": names[place]})
