"""Runs of a dataset as files for ParaView, and models for programs without this package."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import xarray as xr

    from crashkit.api.model import Model
    from surrogates.surrogate import Surrogate


def export_run(
    dataset: str | Path | xr.Dataset, run: str | int, output: str | Path, *, overwrite: bool = False
) -> list[Path]:
    """Write one run of a dataset for ParaView: displacement, fields, numbers, part names and parameters.

    Parameters
    ----------
    dataset
        A crash dataset, or the path of one.
    run
        Name or place of the run.
    output
        `.pvd` or `.vtkhdf` (`.vtu` or `.vtp` for a dataset of one state).
    overwrite
        Replace a file that is there.

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
        If `output` cannot be written, or is there.
    """
    from crashkit.dataset import opened_dataset
    from crashkit.errors import OutputError
    from crashkit.output import refuse_there
    from crashkit.selection import runs_of
    from crashkit.writers.paraview import SUFFIXES
    from crashkit.writers.run import write_run

    if Path(output).suffix not in SUFFIXES:
        raise OutputError(f"{output}: a run is written as .pvd or .vtkhdf (.vtu or .vtp for a single state)")
    refuse_there([Path(output)], overwrite)
    if isinstance(dataset, (str, Path)):
        with opened_dataset(dataset) as opened:
            return export_run(opened, run, output, overwrite=overwrite)
    names = [str(name) for name in dataset["sim"].values]
    place = runs_of(names, [run])[0]
    return write_run(dataset.isel(sim=place), Path(output), {"run": names[place]})


def export_model(
    model: Model | Surrogate | str | Path,
    output: str | Path,
    level: int | None = None,
    *,
    full: bool = False,
    overwrite: bool = False,
) -> float:
    """Write a level of a model for programs without this package.

    Parameters
    ----------
    model
        As `crashkit.train` or `crashkit.load_model` return it, or the path of its folder.
    output
        `.onnx`, or `.pt2` for torch.export.
    level
        A mesh level of the model; without it the finest it has.
    full
        Include the interpolation to the full mesh.
    overwrite
        Replace a file that is there.

    Returns
    -------
    float
        The largest difference between what was written and the model, over the largest displacement.

    Raises
    ------
    SurrogateError
        For a level that the model does not have, or what cannot be exported.
    OutputError
        Where `output` is there.
    """
    from crashkit.extras import need

    need("exporting a model", "train")
    from crashkit.output import refuse_there
    from surrogates.storage.presence import require_model_folder

    refuse_there([Path(output)], overwrite)
    if isinstance(model, (str, Path)):
        require_model_folder(model)
    from crashkit.api.predict import model_in_hand
    from surrogates.storage.export import export

    return export(model_in_hand(model).surrogate, Path(output), level, full=full)
