"""Ask a stored model about a crash that nobody computed, and write the answer."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crashkit.writers import paraview

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import ArrayLike

    from crashkit.api.model import Model
    from surrogates.surrogate import Surrogate


SUFFIXES = (*paraview.SUFFIXES, ".npz", ".zarr")
# A folder of this name, and one in it, is an LS-DYNA family.
D3PLOT = "d3plot"


def load_model(folder: str | Path) -> Model:
    """The model stored in `folder`.

    Raises
    ------
    ModelFolderError
        If it is none, was altered, or does not fit together.
    """
    from crashkit.api.model import Model
    from crashkit.extras import need

    need("loading a model", "train")
    from surrogates.storage.folder import load

    return Model(load(Path(folder)), Path(folder))


def model_in_hand(model: Model | Surrogate | str | Path) -> Model:
    """A model however it is given: as such, as the arrays-only surrogate in it, or as the folder it is stored in."""
    from crashkit.api.model import Model

    if isinstance(model, Model):
        return model
    return load_model(model) if isinstance(model, (str, Path)) else Model(model)


def predict(
    model: Model | Surrogate | str | Path,
    parameters: Mapping[str, Any],
    time: ArrayLike | None = None,
    level: int | None = None,
    full: bool | None = None,
    *,
    extrapolate: bool = False,
    band: float | None = None,
    sensitivity: bool = False,
    coarse_run: str | Path | xr.Dataset | None = None,
) -> xr.Dataset:
    """Displacements of one run, or of several, from a model or the folder it is stored in.

    Parameters
    ----------
    model
        As `crashkit.train` or `crashkit.load_model` return it, or the path of its folder.
    parameters, time, level, full, extrapolate, band, sensitivity, coarse_run
        As for `crashkit.Model.predict`, which says what is returned and raised.
    """
    return model_in_hand(model).predict(
        parameters, time, level, full, extrapolate=extrapolate, band=band, sensitivity=sensitivity,
        coarse_run=coarse_run,
    )  # fmt: skip


def beside_truth(prediction: xr.Dataset, truth: xr.Dataset) -> xr.Dataset:
    """`prediction` with the truth beside it: displacement (true), predicted, their distance `error`, m, and its fields.

    Parameters
    ----------
    prediction
        As `predict` returns it, at the times of the truth.
    truth
        One run of a crash dataset.

    Raises
    ------
    DataError
        Where the two do not have the same nodes and times.
    """
    import numpy as np

    from crashkit.errors import DataError
    from data_schema import fields

    level = int(prediction.attrs["level"])
    nodes = prediction["node_id"].values if "node_id" in prediction else truth["node_id"].values
    at = {int(number): k for k, number in enumerate(truth["node_id"].values)}
    missing = [int(n) for n in nodes if int(n) not in at]
    if missing or (not level and len(nodes) != truth.sizes["node"]):
        raise DataError(
            f"the model has {len(nodes)} nodes and the run {truth.sizes['node']}"
            + (f", of which node {missing[0]} is none" if missing else "")
            + "; give the dataset the model was trained on"
        )
    if prediction.sizes["time"] != truth.sizes["time"]:
        raise DataError("the prediction was asked for other times than those of the run; leave out --time")
    true = truth["displacement"].values[:, [at[int(n)] for n in nodes]]
    predicted = prediction["displacement"].values
    out = prediction.assign(
        displacement=(("time", "node", "xyz"), true, {"units": "m"}),
        predicted=(("time", "node", "xyz"), predicted, {"units": "m", "role": "field"}),
        error=(("time", "node"), np.linalg.norm(predicted - true, axis=-1), {"units": "m", "role": "field"}),
    )
    if level:
        return out
    both = [n for n in fields(truth) if n in out and out[n].dims == truth[n].dims]
    out = out.rename({n: f"predicted_{n}" for n in both})
    more = {n: truth[n].variable for n in fields(truth) if truth[n].dims[1] in ("node", "face") and n not in out}
    if "alive" in truth:
        more["alive"] = truth["alive"].variable
    return out.assign(more)


def hidden_above(prediction: xr.Dataset, share: float) -> xr.Dataset:
    """`prediction` with `alive`: False where the probability that an element is gone is above `share`.

    Where it is beside its truth, `alive` stays that of the truth; without `removal_probability` nothing changes.
    """
    if "removal_probability" not in prediction or "alive" in prediction:
        return prediction
    probability = prediction["removal_probability"]
    return prediction.assign(alive=(probability.dims, probability.values <= share))


def write_prediction(
    prediction: xr.Dataset,
    output: str | Path,
    about: Mapping[str, str] | None = None,
    template: str | Path | None = None,
) -> list[Path]:
    """Write what `predict` returned for one run to `output` by its suffix.

    A folder called d3plot becomes an LS-DYNA family, `.zarr` (and `.vtp` of several states) the layout of PhysicsNeMo
    Curator.

    Parameters
    ----------
    about
        Texts to stand in ParaView files: the name of the model, of the run.
    template
        A d3plot of the same model, whose geometry and units a d3plot gets.

    Raises
    ------
    OutputError
        Where `output` cannot be written.
    DataError
        Where a single-state file was asked for several states.
    """
    import numpy as np

    from crashkit.errors import DataError, OutputError
    from crashkit.writers.run import write_run
    from data_schema.replace import beside

    output = Path(output)
    if output.suffix not in SUFFIXES and not _is_family(output):
        raise OutputError(
            f"{output}: the suffix says what is written; expected one of {', '.join(SUFFIXES)}, or a folder {D3PLOT}"
        )
    if template is not None and not _is_family(output):
        raise OutputError(f"{output}: a template is for LS-DYNA; expected a folder called {D3PLOT}")
    if "sim" in prediction.dims:
        count = prediction.sizes["sim"]
        raise DataError(f"{output}: holds one run, and {count} were predicted; choose one with .isel(sim=0)")
    if "reference_position" not in prediction or "face_nodes" not in prediction:
        raise DataError(f"{output}: the model was stored without its mesh; train it again from a dataset")
    states = prediction.sizes["time"]
    if _is_family(output):
        from crashkit.writers.d3plot import write_d3plot

        predicted = prediction.assign(displacement=prediction["predicted"]) if "predicted" in prediction else prediction
        named = (about or {}).get("run") or "prediction"
        return write_d3plot(predicted, output, template, f"{named} by {prediction.attrs['model']}")
    if output.suffix == ".zarr" or (output.suffix == ".vtp" and states > 1):
        from crashkit.writers.physicsnemo import write_physicsnemo

        predicted = prediction.assign(displacement=prediction["predicted"]) if "predicted" in prediction else prediction
        return write_physicsnemo(predicted, output)
    if output.suffix != ".npz":
        if output.suffix == ".vtu" and states != 1:
            raise DataError(f"{output}: holds one state, and {states} were asked for; choose one with --time, or .pvd")
        return write_run(prediction, output, {"model": str(prediction.attrs["model"]), **(about or {})})
    names = ["displacement", "reference_position", "node_id", "predicted", "error"]
    names += ["history", "history_time", "channel", "history_half_width"]
    names += [
        str(n) for n, v in prediction.data_vars.items() if v.attrs.get("role") in ("field", "parameter", "number")
    ]
    arrays = {n: prediction[n].values for n in dict.fromkeys(["node", *names]) if n in prediction.variables}
    try:
        with beside(output) as new, new.open("wb") as file:
            np.savez_compressed(
                file, time=prediction["time"].values, faces=prediction["face_nodes"].values, **arrays  # type: ignore[arg-type]
            )  # fmt: skip
    except OSError as error:
        raise OutputError(
            f"{output}: cannot be written ({error.strerror or error}); check permissions and free space, or choose "
            f"another place with -o"
        ) from error
    return [output]


def _is_family(output: Path) -> bool:
    return not output.suffix and D3PLOT in (output.name, output.parent.name)
