"""`crashkit predict`: ask a stored model about crashes that nobody computed."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from crashkit.cli._console import fail, print_json, say, table, what_next
from crashkit.cli._progress import Progress

if TYPE_CHECKING:
    import xarray as xr

    from surrogates.surrogate import Surrogate


def command(
    model: Annotated[Path, typer.Argument(help="Model folder.", show_default=False)],
    param: Annotated[
        list[str] | None,
        typer.Option(
            "--param",
            "-p",
            help="One parameter: impact_speed=20 (in the unit of the parameter table) or yield_stress=400MPa.",
        ),
    ] = None,
    params: Annotated[
        Path | None,
        typer.Option(help="Predict every row of this table (CSV, TSV, JSON or XLSX) instead.", show_default="none"),
    ] = None,
    run: Annotated[
        str, typer.Option(help="Predict this run of --dataset instead, with the truth beside it.", show_default="none")
    ] = "",
    dataset: Annotated[Path | None, typer.Option(help="Dataset of --run.", show_default="none")] = None,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help="run.pvd, run.vtkhdf (ParaView), run.vtu (one state) or run.npz; of a table: a folder or NAME.pvd.",
        ),
    ] = Path("prediction.pvd"),
    time: Annotated[
        str, typer.Option(help="Times in s: 0.015 or 0,0.01,0.02.", show_default="those of the training runs")
    ] = "",
    level: Annotated[
        int | None, typer.Option(help="Mesh level, on its own nodes.", show_default="full mesh, from the finest level")
    ] = None,
    full: Annotated[
        bool, typer.Option("--full", help="With --level: interpolate from that level to the full mesh.")
    ] = False,
    band: Annotated[
        float | None,
        typer.Option(
            help="Also write a prediction band that should contain this share of nodes, e.g. 0.9.", show_default="none"
        ),
    ] = None,
    sensitivity: Annotated[
        bool, typer.Option("--sensitivity", help="Also write the derivative by each parameter.")
    ] = False,
    extrapolate: Annotated[
        bool, typer.Option("--extrapolate", help="Predict even far outside the trained range.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Predict runs and write them for ParaView or as arrays."""
    if sum((bool(param), params is not None, bool(run))) > 1:
        fail("give one of --param, --params and --run", code=2)
    if bool(run) != (dataset is not None):
        fail("--run and --dataset belong together: --run run_008 --dataset crash.zarr", code=2)
    asked = _given(param or ())
    times = _times(time)
    with Progress(f"reading {model}", quiet=json) as shown:
        from crashkit.api.predict import beside_truth, load_model, write_prediction

        loaded = load_model(model)
        surrogate = loaded.surrogate
        rows = []
        for name, values, target, true in _wanted(surrogate, asked, params, run, dataset, output):
            shown.stage(f"predicting {name or model}")
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                prediction = loaded.predict(
                    values, times if true is None or times else true["time"].values, level,
                    full or None, extrapolate=extrapolate, band=band, sensitivity=sensitivity,
                )  # fmt: skip
            if true is not None:
                prediction = beside_truth(prediction, true)
            about = {
                "model_name": f"{prediction.attrs['model']} of {model.resolve().name}",
                **({"run": name} if name else {}),
            }
            rows.append(_row(name, prediction, write_prediction(prediction, target, about), surrogate, true))
    if json:
        print_json(rows if params is not None else rows[0])
        return
    for row in rows:
        for sentence in row["warnings"]:
            say(f"warning: {row['run'] + ': ' if row['run'] else ''}{sentence}")
    _show(rows)


def _wanted(
    surrogate: Surrogate,
    asked: Mapping[str, str],
    params: Path | None,
    run: str,
    dataset: Path | None,
    output: Path,
) -> Iterator[tuple[str, Mapping[str, Any], Path, xr.Dataset | None]]:
    """Name, parameters, file and truth of every run that was asked for."""
    names = surrogate.record.ranges.names
    if params is not None:
        from crashkit.api.predict import SUFFIXES
        from crashkit.errors import OutputError
        from crashkit.ingestion.parameter_table import read_parameter_table
        from crashkit.output import file_name

        if output.suffix in SUFFIXES:
            targets = {r: output.with_name(f"{output.stem}_{file_name(r)}{output.suffix}") for r in _rows(params)}
        elif output.suffix:
            raise OutputError(f"{output}: of a table, expected a folder, or NAME.pvd, NAME.vtkhdf or NAME.npz")
        else:
            targets = {r: output / f"{file_name(r)}.pvd" for r in _rows(params)}
        for row, values in read_parameter_table(params).rows.items():
            yield row, {n: f"{v!r}{unit}" for n, (v, unit) in values.items() if n in names}, targets[row], None
    elif dataset is not None:
        from crashkit.dataset import open_dataset, reading_dataset
        from crashkit.errors import DataError
        from crashkit.selection import runs_of

        with open_dataset(dataset, chunks=None) as opened, reading_dataset(dataset):
            runs = [str(n) for n in opened["sim"].values]
            true = opened.isel(sim=runs_of(runs, [run])[0])
            missing = [n for n in names if n not in true]
            if missing:
                raise DataError(f"{dataset}: has no parameter {', '.join(missing)}; give the dataset of the model")
            yield str(true["sim"].values), {n: float(true[n]) for n in names}, output, true
    else:
        yield "", asked, output, None


def _rows(params: Path) -> list[str]:
    from crashkit.ingestion.parameter_table import read_parameter_table

    return list(read_parameter_table(params).rows)


def _row(
    name: str, prediction: xr.Dataset, files: list[Path], surrogate: Surrogate, true: xr.Dataset | None
) -> dict[str, Any]:
    import numpy as np

    moved = prediction["predicted" if true is not None else "displacement"].values
    sentences = [s for s in str(prediction.attrs["warnings"]).split("; ") if s]
    record = surrogate.record
    for seen, what in ((record.fitted_runs, "trained"), (record.validation_runs, "tuned")):
        if true is not None and name in seen:
            sentences.append(f"the model was {what} on {name}; its error there says nothing about new runs")
    row: dict[str, Any] = {
        "run": name,
        "files": files,
        "arrays": [
            str(n) for n, v in prediction.data_vars.items() if v.dims[:2] in (("time", "node"), ("time", "face"))
        ],
        "model": prediction.attrs["model"],
        "level": prediction.attrs["level"],
        "states": prediction.sizes["time"],
        "nodes": prediction.sizes["node"],
        "largest_displacement_m": float(np.linalg.norm(moved, axis=-1).max()),
        "warnings": sentences,
    }
    if true is not None:
        error = prediction["error"].values
        motion = np.linalg.norm(prediction["displacement"].values, axis=-1)
        row |= {
            "mean_error_m": float(np.nanmean(error)),
            "largest_error_m": float(np.nanmax(error)),
            "relative_error": float(np.nanmean(error) / max(float(np.nanmean(motion)), 1e-12)),
        }
    return row


def _show(rows: list[dict[str, Any]]) -> None:
    first = rows[0]
    where = f"{first['model']}, {first['states']} states of {first['nodes']} nodes"
    if len(rows) > 1:
        table(
            f"{len(rows)} runs predicted: {where}",
            ("run", "largest displacement (cm)", "file"),
            ((r["run"], f"{100 * r['largest_displacement_m']:.1f}", r["files"][0]) for r in rows),
        )
    else:
        say(f"{first['files'][0]}: {where}, largest displacement {100 * first['largest_displacement_m']:.1f} cm")
    if "mean_error_m" in first:
        say(
            f"error: mean {100 * first['mean_error_m']:.2f} cm, {100 * first['relative_error']:.1f} % of the motion, "
            f"largest of any node {100 * first['largest_error_m']:.1f} cm"
        )
    shown = first["files"][-1] if str(first["files"][-1]).endswith("_view.py") else None
    what_next(
        f"{first['files'][0]} in ParaView; {shown} shows it in fixed colour ranges (File > Load State)"
        if shown is not None
        else first["files"][0]
    )


def _given(texts: Iterable[str]) -> dict[str, str]:
    out: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name.strip() or not value.strip():
            raise typer.BadParameter(f"{text!r}; expected name=value, such as impact_speed=20", param_hint="--param")
        if name.strip() in out:
            raise typer.BadParameter(f"{name.strip()} is given twice", param_hint="--param")
        out[name.strip()] = value
    return out


def _times(text: str) -> list[float] | None:
    if not text:
        return None
    try:
        times = [float(piece) for piece in text.split(",")]
    except ValueError as error:
        raise typer.BadParameter(
            f"{text!r}; expected seconds, such as 0.015 or 0,0.01,0.02", param_hint="--time"
        ) from error
    if any(b <= a for a, b in itertools.pairwise(times)):
        raise typer.BadParameter(f"{text!r}; expected increasing times, each once", param_hint="--time")
    return times
