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
    full: bool = False,
) -> xr.DataArray:
    """Displacements (time, node, xyz), m, of one run.

    The coordinate `node` says which node of the full mesh each one is; the parameters are scalar coordinates.
    Parameters and times outside the trained range get a warning that names the range, also in the attribute `warnings`.

    Parameters
    ----------
    parameters
        By name, as numbers in the units of the training data or as text with a unit ("400MPa").
    time
        s; without it the states of the training runs.
    level
        A mesh level of the model; without it the finest it has.
    full
        On all nodes of the mesh, lifted from the level.

    Raises
    ------
    DataError
        For parameters that are unknown, missing or no numbers.
    SurrogateError
        For a level it lacks.
    """
    import numpy as np
    import xarray as xr

    surrogate = load_model(model) if isinstance(model, (str, Path)) else model
    ranges = surrogate.record.ranges
    values = parameter_values(parameters, ranges)
    at = surrogate.record.time if time is None else np.atleast_1d(np.asarray(time, np.float64))
    number = min(surrogate.level_names.values()) if level is None else level
    u = surrogate.predict_full(values, at, number) if full else surrogate.predict(values, at, number)
    outside = surrogate.outside(values, at)
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

    spans = zip(ranges.names, ranges.low, ranges.high, ranges.units, strict=True)
    known = "; the model takes " + ", ".join(f"{n} ({a:g} to {b:g} {unit})" for n, a, b, unit in spans)
    unknown = [n for n in given if n not in ranges.names]
    if unknown:
        raise DataError(f"parameter {unknown[0]!r} is not known{known}")
    missing = [n for n in ranges.names if n not in given]
    if missing:
        raise DataError(f"parameter {', '.join(missing)} is missing{known}")
    return np.array([_value(n, given[n], unit) for n, unit in zip(ranges.names, ranges.units, strict=True)])


def _value(name: str, given: float | str, unit: str) -> float:
    """A number in `unit`, which text may carry in another unit of the same kind."""
    import math

    from crashkit.errors import DataError
    from data_schema import UnknownUnits, to_si

    if not isinstance(given, str):
        value = float(given)
    else:
        found = re.fullmatch(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*", given)
        if found is None:
            raise DataError(f"{name}={given}: expected a number, with a unit if you like, such as {name}=1{unit}")
        value = float(found[1])
        if found[2] and found[2] != unit:
            try:
                (factor, si), (own, label) = to_si(found[2]), to_si(unit)
            except UnknownUnits as error:
                raise DataError(f"{name}={given}: {error}") from error
            if si != label:
                raise DataError(
                    f"{name}={given}: the unit {found[2]!r} is not one of {name}, which is in {unit or 'no unit'}"
                )
            value *= factor / own
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
        out["half_width"] = (surrogate.band(band, run["time"].values, number, full=full), "m")
    if sensitivity:
        ranges = surrogate.record.ranges
        at = [float(run[name]) for name in ranges.names]
        by = surrogate.sensitivity(at, run["time"].values, number)
        for k, (name, unit) in enumerate(zip(ranges.names, ranges.units, strict=True)):
            slope = np.ascontiguousarray(by[..., k])
            out[f"displacement_by_{name}"] = (surrogate.lift(slope, number) if full else slope, f"m ({unit})-1")
    return out


def write_prediction(
    surrogate: Surrogate,
    run: xr.DataArray,
    output: Path,
    further: Mapping[str, tuple[NDArray[np.float32], str]] | None = None,
) -> list[Path]:
    """Write what `predict` gave, and `further_arrays`, to `output` by its suffix; the mesh comes from the model folder.

    Raises
    ------
    OutputError
        Where `output` cannot be written.
    DataError
        Where the model has no mesh or a single-state file was asked for several states.
    """
    import numpy as np

    from crashkit.errors import DataError, OutputError
    from crashkit.writers.paraview import write_paraview
    from data_schema.edges import without_sides

    further = further or {}
    level = int(run.attrs["level"])
    if surrogate.points is None or surrogate.faces is None:
        raise DataError(f"{output}: the model was stored without its mesh; train it again from a dataset")
    points = surrogate.points[run["node"].values]
    faces = surrogate.graphs[level].faces if level else surrogate.faces
    lines = without_sides(surrogate.graphs[level].edges, faces) if level else None
    if output.suffix == ".npz":
        try:
            output.parent.mkdir(parents=True, exist_ok=True)
            with output.open("wb") as file:
                np.savez_compressed(
                    file, displacement=run.values, time=run["time"].values, node=run["node"].values,
                    reference_position=points, faces=faces, **{k: v for k, (v, _) in further.items()},  # type: ignore[arg-type]
                )  # fmt: skip
        except OSError as error:
            raise OutputError(
                f"{output}: cannot be written ({error.strerror}); choose another place with -o"
            ) from error
        return [output]
    if output.suffix in (".vtu", ".vtp") and run.sizes["time"] != 1:
        raise DataError(
            f"{output}: holds one state, and {run.sizes['time']} were asked for; choose one with --time, or .pvd"
        )
    arrays = {"displacement": (run.values, "m"), **further}
    return write_paraview(
        output, points, faces, run["time"].values, point_data={name: values for name, (values, _) in arrays.items()},
        lines=lines, units={name: unit for name, (_, unit) in arrays.items()},
    )  # fmt: skip
