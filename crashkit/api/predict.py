"""Ask a stored model about a crash that nobody computed, and write the answer."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr
    from numpy.typing import ArrayLike, NDArray

    from surrogates.data.inputs import Ranges
    from surrogates.surrogate import Surrogate


SUFFIXES = (".pvd", ".vtkhdf", ".vtu", ".vtp", ".npz")


def load_model(folder: str | Path) -> Surrogate:
    """The model stored in `folder`; raises ModelFolderError if it is none, was altered or does not fit."""
    from crashkit.extras import need

    need("loading a model", "train")
    from surrogates.storage.folder import load

    return load(Path(folder))


def predict(
    model: Surrogate | str | Path,
    parameters: Mapping[str, float | str],
    time: ArrayLike | None = None,
    level: int | None = None,
    full: bool | None = None,
    *,
    extrapolate: bool = False,
) -> xr.DataArray:
    """Displacements (time, node, xyz), m, of one run.

    The coordinate `node` says which node of the full mesh each one is; the parameters are scalar coordinates.
    Parameters and times outside the trained range get a warning that names the range, also in the attribute `warnings`.

    Parameters
    ----------
    parameters
        By name: numbers in the dataset's unit (SI), or text, with a unit ("400MPa") or in the unit in which the
        parameter's table was written ("400").
    time
        s; without it the states of the training runs.
    level
        A mesh level of the model, on its own nodes; without it all nodes of the mesh, from the finest level.
    full
        With `level`: on all nodes of the mesh, interpolated from that level.
    extrapolate
        Also far outside the trained range: by more than a quarter of it.

    Raises
    ------
    DataError
        For parameters that are unknown, missing or no numbers, and far outside the trained range unless
        `extrapolate`.
    SurrogateError
        For a level it lacks.
    """
    import numpy as np
    import xarray as xr

    from crashkit.errors import DataError
    from surrogates.data.inputs import far_outside

    surrogate = load_model(model) if isinstance(model, (str, Path)) else model
    ranges = surrogate.record.ranges
    values = parameter_values(parameters, ranges)
    at = surrogate.record.time if time is None else np.atleast_1d(np.asarray(time, np.float64))
    number = surrogate.number(level)
    full = level is None if full is None else full
    outside = surrogate.outside(values, at)
    far = [] if extrapolate else far_outside(ranges, values, at)
    if far:
        said = "; ".join(s for s in outside if s.split(" = ")[0] in far)
        raise DataError(
            f"{said}: that is far outside, and nothing is known there; check the value and its unit, or extrapolate with --extrapolate"
        )
    u = surrogate.predict_full(values, at, number) if full else surrogate.predict(values, at, number)
    if not np.isfinite(u).all():
        raise DataError("the model gives numbers that are not finite for these parameters; train it again")
    for sentence in outside:
        warnings.warn(sentence, stacklevel=2)
    return xr.DataArray(
        u,
        dims=("time", "node", "xyz"),
        coords={
            "time": ("time", at, {"units": "s"}),
            "node": ("node", surrogate.graphs.kept(0 if full else number)),
            **{n: ((), v, {"units": unit}) for n, v, unit in zip(ranges.names, values, ranges.units, strict=True)},
        },
        name="displacement",
        attrs={
            "units": "m",
            "model": next(name for name, k in surrogate.level_names.items() if k == number),
            "level": 0 if full else number,
            "warnings": "; ".join(outside),
        },
    )


def parameter_values(given: Mapping[str, float | str], ranges: Ranges) -> NDArray[np.float64]:
    """Values (parameter,) in the order of `ranges.names`, in its units; raises DataError listing them where one is amiss."""
    import numpy as np

    from crashkit.errors import DataError

    spans = zip(ranges.names, ranges.low, ranges.high, ranges.written, strict=True)
    known = "; the model takes " + ", ".join(f"{n} ({a / f:g} to {b / f:g} {unit})" for n, a, b, (unit, f) in spans)
    unknown = [n for n in given if n not in ranges.names]
    if unknown:
        raise DataError(f"parameter {unknown[0]!r} is not known{known}")
    missing = [n for n in ranges.names if n not in given]
    if missing:
        raise DataError(f"parameter {', '.join(missing)} is missing{known}")
    return np.array(
        [
            _value(n, given[n], unit, written)
            for n, unit, written in zip(ranges.names, ranges.units, ranges.written, strict=True)
        ]
    )


def _value(name: str, given: float | str, unit: str, written: tuple[str, float]) -> float:
    """A number in `unit`: text carries another unit of the same kind, or is in the `written` one (unit, its value)."""
    import math

    from crashkit.errors import DataError
    from data_schema import to_si

    if not isinstance(given, str):
        value = float(given)
    else:
        found = re.fullmatch(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*", given)
        if found is None or re.match(r",\s*\d", found[2]):
            comma = "; the decimal sign is a point" if "," in given else ""
            raise DataError(
                f"{name}={given}: expected a number, with a unit if you like, such as {name}=1{written[0]}{comma}"
            )
        value = float(found[1])
        if found[2]:
            factor, si = to_si(found[2])
            if si != to_si(unit)[1]:
                raise DataError(
                    f"{name}={given}: the unit {found[2]!r} is not one of {name}, which is in {written[0] or 'no unit'}"
                )
            value *= factor / to_si(unit)[0]
        else:
            value *= written[1]
    if not math.isfinite(value):
        raise DataError(f"{name}={given}: expected a finite number")
    return value


def further_arrays(
    surrogate: Surrogate, run: xr.DataArray, band: float | None = None, sensitivity: bool = False
) -> dict[str, tuple[NDArray[np.float32], str]]:
    """What else can be said of the prediction `run`: name -> (array (time, node) or (time, node, xyz), unit).

    half_width  m, with `band`: that share of nodes and states lies as near to the truth, as far as validation runs tell
    displacement_by_NAME  with `sensitivity`: derivative by each parameter

    Raises
    ------
    SurrogateError
        Where too few validation runs were held out for a band.
    """
    import numpy as np

    number, full = surrogate.level_names[run.attrs["model"]], run.attrs["level"] == 0
    out: dict[str, tuple[NDArray[np.float32], str]] = {}
    if band is not None:
        at = [float(run[name]) for name in surrogate.record.ranges.names]
        out["half_width"] = (surrogate.band(band, run["time"].values, number, full=full, parameters=at), "m")
    if sensitivity:
        ranges = surrogate.record.ranges
        at = [float(run[name]) for name in ranges.names]
        by = surrogate.sensitivity(at, run["time"].values, number)
        for k, (name, unit) in enumerate(zip(ranges.names, ranges.units, strict=True)):
            slope = np.ascontiguousarray(by[..., k])
            out[f"displacement_by_{name}"] = (surrogate.lift(slope, number) if full else slope, f"m ({unit})-1")
    return out


def as_dataset(
    surrogate: Surrogate,
    run: xr.DataArray,
    further: Mapping[str, tuple[NDArray[np.float32], str]] | None = None,
) -> xr.Dataset:
    """What `predict` gave, and `further_arrays`, as a crash dataset of one run, with the mesh from the model folder.

    Raises
    ------
    DataError
        Where the model was stored without its mesh.
    """
    import numpy as np
    import xarray as xr

    from crashkit.errors import DataError
    from data_schema.edges import without_sides

    if surrogate.points is None or surrogate.faces is None:
        raise DataError("the model was stored without its mesh; train it again from a dataset")
    level, nodes = int(run.attrs["level"]), run["node"].values
    faces = surrogate.graphs[level].faces if level else surrogate.faces
    dims = ("time", "node", "xyz")
    arrays: dict[str, object] = {
        "displacement": (dims, run.values, {"units": "m"}),
        "reference_position": (("node", "xyz"), surrogate.points[nodes], {"units": "m"}),
        "face_nodes": (("face", "corner"), faces),
    }
    for name, (values, unit) in (further or {}).items():
        arrays[name] = (dims[: values.ndim], values, {"units": unit, "role": "field"})
    if level:
        arrays["line_nodes"] = (("line", "end"), without_sides(surrogate.graphs[level].edges, faces))
    labels = surrogate.labels
    if labels is not None:
        arrays["node_id"] = ("node", labels.node_id[nodes])
        if not level:
            arrays |= {"face_part": ("face", labels.face_part), "part_id": ("part", labels.part_id)}
            arrays["part_name"] = ("part", np.array(labels.part_name, dtype=str))
            arrays |= {} if labels.face_id is None else {"face_id": ("face", labels.face_id)}
    ranges = surrogate.record.ranges
    for name, unit, (written, _) in zip(ranges.names, ranges.units, ranges.written, strict=True):
        arrays[name] = ((), float(run[name]), {"units": unit, "table_units": written, "role": "parameter"})
    return xr.Dataset(
        arrays, coords={"time": ("time", run["time"].values, {"units": "s"}), "node": ("node", nodes)}, attrs=run.attrs
    )


def beside_truth(prediction: xr.Dataset, truth: xr.Dataset) -> xr.Dataset:
    """`prediction` with the truth beside it: displacement (true), predicted, their distance `error`, m, and its fields.

    Parameters
    ----------
    prediction
        As `as_dataset` gives it, at the times of the truth.
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
    more = {n: truth[n].variable for n in fields(truth) if truth[n].dims[1] in ("node", "face") and n not in out}
    if "alive" in truth:
        more["alive"] = truth["alive"].variable
    return out.assign(more)


def write_prediction(prediction: xr.Dataset, output: str | Path, about: Mapping[str, str] | None = None) -> list[Path]:
    """Write what `as_dataset` gave to `output` by its suffix.

    Parameters
    ----------
    about
        Texts to stand in ParaView files: the name of the model, of the run.

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
    if output.suffix not in SUFFIXES:
        raise OutputError(f"{output}: the suffix says what is written; expected one of {', '.join(SUFFIXES)}")
    if output.suffix != ".npz":
        states = prediction.sizes["time"]
        if output.suffix in (".vtu", ".vtp") and states != 1:
            raise DataError(f"{output}: holds one state, and {states} were asked for; choose one with --time, or .pvd")
        return write_run(prediction, output, {"model": str(prediction.attrs["model"]), **(about or {})})
    names = ["displacement", "reference_position", "node_id", "predicted", "error"]
    names += [str(n) for n, v in prediction.data_vars.items() if v.attrs.get("role") in ("field", "parameter")]
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
