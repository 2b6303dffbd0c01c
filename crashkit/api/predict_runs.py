"""Runs predicted and written to files: of one set of parameters, of every row of a table, or of a run that is known."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crashkit.api.series import SeriesNote, stored_model
from crashkit.presence import require_dataset
from data_schema.progress import Progress, silent
from data_schema.replace import sweep
from surrogates.storage.presence import require_model_folder

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import ArrayLike

    from crashkit.api.model import Model
    from surrogates.record import Record
    from surrogates.surrogate import Surrogate


@dataclass(frozen=True)
class PredictedBand:
    """How wide a band is, what it comes from, and what it held.

    Attributes
    ----------
    share
        Of nodes and states that it should contain.
    mean_half_width_m, largest_half_width_m
        m, over nodes and states.
    runs_behind
        Left-out runs whose errors it comes from.
    inside
        Share of the nodes and states of a run that is known that lie within it; None for others.
    on_test_runs
        What a band of 90 % held in the last evaluation, in words; None where the model was not evaluated.
    """

    share: float
    mean_half_width_m: float
    largest_half_width_m: float
    runs_behind: int
    inside: float | None = None
    on_test_runs: str | None = None


@dataclass(frozen=True)
class PredictedRun:
    """A run that was predicted, and where it was written.

    Attributes
    ----------
    run
        Its name; empty where parameters alone were given.
    files
        The files, the one to open first.
    arrays
        Names of the results in them.
    model, level
        What predicted it; level 0 is the full mesh.
    states, nodes
        How many.
    largest_displacement_m
        Of any predicted node, m.
    warnings
        What lies outside the trained range, and whether the model has seen the run.
    mean_error_m, largest_error_m
        m, over the nodes and states of a run that is known; None for others.
    relative_error
        The mean error over the mean true displacement.
    band
        Of the band that was asked for, if one was.
    expected_removed, hidden
        Elements that are gone in the last state: the sum of their probabilities, and how many are hidden; None where
        nothing is said of them.
    numbers
        Name -> value, unit and half_width (with a band) of each number by formula; None without any.
    resumed
        It was written before, by the series that was resumed.
    """

    run: str
    files: list[Path]
    arrays: list[str]
    model: str
    level: int
    states: int
    nodes: int
    largest_displacement_m: float
    warnings: list[str]
    mean_error_m: float | None = None
    largest_error_m: float | None = None
    relative_error: float | None = None
    band: PredictedBand | None = None
    expected_removed: float | None = None
    hidden: int | None = None
    numbers: dict[str, dict[str, Any]] | None = None
    resumed: bool | None = None

    def as_dict(self) -> dict[str, Any]:
        """As plain values, without those that are None."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    @classmethod
    def of_dict(cls, values: Mapping[str, Any]) -> PredictedRun:
        """What `as_dict` gave."""
        band = values.get("band")
        return cls(**{**values, "band": None if band is None else PredictedBand(**band)})


@dataclass(frozen=True)
class _Wanted:
    """One run to predict: its name, parameters and file, and the truth where it is known."""

    run: str
    parameters: Mapping[str, Any]
    output: Path
    truth: xr.Dataset | None = None


def predict_runs(
    model: Model | Surrogate | str | Path,
    output: str | Path,
    *,
    parameters: Mapping[str, Any] | None = None,
    table: str | Path | None = None,
    run: str | int | None = None,
    dataset: str | Path | None = None,
    time: ArrayLike | None = None,
    level: int | None = None,
    full: bool | None = None,
    extrapolate: bool = False,
    band: float | None = None,
    sensitivity: bool = False,
    hide_above: float = 0.5,
    template: str | Path | None = None,
    coarse_run: str | Path | None = None,
    workers: int = 1,
    overwrite: bool = False,
    resume: bool = False,
    report: Progress = silent,
) -> list[PredictedRun]:
    """Predict runs and write them. Give one of `parameters`, `table` and `run`.

    Parameters
    ----------
    model
        As `crashkit.train` or `crashkit.load_model` return it, or the path of its folder.
    output
        `.pvd`, `.vtkhdf`, `.vtu`, `.vtp`, `.npz` or `.zarr`, or a folder called d3plot (`crashkit.api.predict`); of a table
        a folder, or a name with such a suffix, to which the name of the run is added. In a folder d3plot every run of a
        table has a family in a folder of its own.
    parameters
        Values by name, as `crashkit.Model.predict` takes them.
    table
        A table of parameters: every row is predicted, under its name in the column `run`, else as row_2, row_3, ...
    run, dataset
        A run of this dataset, by name or place: it is written with the truth beside it and the error.
    time, level, full, extrapolate, band, sensitivity
        As for `crashkit.Model.predict`. By default a known run is predicted at its own times.
    hide_above
        Elements that are gone with more than this probability are hidden in ParaView files, where no truth says more.
    template
        A d3plot of the same model, whose geometry and units a d3plot gets.
    coarse_run
        As for `crashkit.Model.predict`. Without `parameters` they are those that the run itself states; of a table, a
        folder that holds a run by the name of each row, or a dataset with these runs.
    workers
        Processes that share the rows of a table; the model must then be a folder.
    overwrite
        Replace files that are there; without it they are refused before anything is predicted.
    resume
        Go on with a table that was interrupted, or has got further rows: what is written stays. Only with the same model
        and the same further arguments.
    report
        Called with (what, runs done, runs, "").

    Raises
    ------
    DataError, SurrogateError
        As for `crashkit.Model.predict`; for a run that is not there, or a dataset without the model's parameters.
    ReadError
        For a table or a dataset that cannot be read.
    OutputError
        Where `output` cannot be written, or is there.
    """
    from crashkit.api.predict import model_in_hand
    from crashkit.errors import DataError, OutputError
    from crashkit.output import refuse_there
    from crashkit.parallel import as_finished

    if isinstance(model, (str, Path)):
        require_model_folder(model)
    if dataset is not None:
        require_dataset(dataset)
    rows = () if table is None else tuple(_rows(Path(output), Path(table)))
    if coarse_run is not None:
        from crashkit.api.coarse_runs import check_given

        check_given(coarse_run, None if table is None else [row.run for row in rows])
    if table is not None and not (resume or overwrite) and SeriesNote(Path(output), {}).is_there():
        raise OutputError(
            f"{output}: holds runs of a series; go on with it with --resume, replace it with --overwrite, or choose another "
            "place"
        )
    if not resume:
        refuse_there([Path(output)] if table is None else [row.output for row in rows], overwrite)
    asked = model_in_hand(model)
    if coarse_run is not None and table is None and run is None and not parameters:
        from crashkit.api.coarse_runs import own_parameters

        parameters = own_parameters(coarse_run, asked.record.ranges.names)
    wanted = _wanted(asked.record, Path(output), parameters, table, rows, run, dataset)
    how = _How(
        time, level, full, extrapolate, band, sensitivity, hide_above, template, coarse_run, several=table is not None
    )
    series = None if table is None or asked.folder is None else SeriesNote(Path(output), _identity(asked.folder, how))
    if resume and series is None:
        raise DataError("resume goes on with the rows of a table, by a model in its folder; give both")
    found = _written_before(series, wanted) if series is not None and resume else {}
    refuse_there((one.output for one in wanted if series is None or not series.owns(one.output)), overwrite)
    if table is not None:
        _check_rows(asked, wanted, table, time, extrapolate)
    if series is not None:
        series.begin(one.output for one in wanted)
    left = [k for k in range(len(wanted)) if k not in found]

    def keep(place: int, row: PredictedRun) -> None:
        found[place] = row
        if series is not None:
            summary = {name: value for name, value in row.as_dict().items() if name != "files"}
            series.add(row.run, wanted[place].parameters, row.files, summary)

    if workers == 1 or len(left) < 2:
        for k in left:
            one = wanted[k]
            report(f"predicting {one.run or asked.name}", len(found), len(wanted) if len(wanted) > 1 else 0, "")
            keep(k, _one(asked, one, how))
        return [found[k] for k in range(len(wanted))]
    if asked.folder is None:
        raise DataError("several processes each load the model; give its folder, or workers=1")
    report("runs", len(found), len(wanted), "")
    try:
        for place, row in as_finished(
            _one_elsewhere, [wanted[k] for k in left], (asked.folder.resolve(), how), workers=workers,
            label=lambda w: w.run,
        ):  # fmt: skip
            keep(left[place], row)
            report("runs", len(found), len(wanted), row.run)
    except KeyboardInterrupt:
        for one in wanted:  # what killed processes were writing
            sweep(one.output)
        raise
    return [found[k] for k in range(len(wanted))]


def _identity(folder: Path, how: _How) -> dict[str, Any]:
    """What must be the same for a series to go on: the model, and what all runs are asked alike."""
    import numpy as np

    asked = {name: value for name, value in vars(how).items() if name not in ("several", "extrapolate")}
    asked["time"] = None if how.time is None else np.ravel(how.time).astype(float).tolist()
    for name in ("template", "coarse_run"):
        asked[name] = None if asked[name] is None else str(asked[name])
    return {"model": stored_model(folder), **asked}


def _written_before(series: SeriesNote, wanted: Sequence[_Wanted]) -> dict[int, PredictedRun]:
    """Place -> run, of those that the series has written already. Raises OutputError for another series."""
    series.read()
    summaries = ((k, series.whole(one.run, one.parameters)) for k, one in enumerate(wanted))
    return {k: PredictedRun.of_dict({**summary, "resumed": True}) for k, summary in summaries if summary is not None}


def _check_rows(
    model: Model, wanted: Sequence[_Wanted], table: str | Path, time: ArrayLike | None, extrapolate: bool
) -> None:
    """Refuse a table with a row that cannot be predicted before any of them is, naming it."""
    from crashkit.errors import DataError
    from surrogates.errors import SurrogateError

    for one in wanted:
        try:
            model.check(one.parameters, time, extrapolate=extrapolate)
        except (DataError, SurrogateError) as error:
            raise DataError(f"{table}: run {one.run}: {error}") from error


@dataclass(frozen=True)
class _How:
    """What all runs are asked alike; see `predict_runs`."""

    time: ArrayLike | None
    level: int | None
    full: bool | None
    extrapolate: bool
    band: float | None
    sensitivity: bool
    hide_above: float
    template: str | Path | None
    coarse_run: str | Path | None = None
    several: bool = False

    def coarse_run_of(self, run: str) -> str | Path | None:
        """The coarse run that belongs to `run`: of several, the one of its name in what was given."""
        if self.coarse_run is None or not self.several:
            return self.coarse_run
        given = Path(self.coarse_run)
        return f"{given}:{run}" if given.suffix in (".zarr", ".nc") else given / run


def _one(asked: Model, wanted: _Wanted, how: _How) -> PredictedRun:
    """Predict one run and write it."""
    from crashkit.api.predict import beside_truth, hidden_above, write_prediction

    truth, time = wanted.truth, how.time
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # they are kept in the result
        prediction = asked.predict(
            wanted.parameters, truth["time"].values if time is None and truth is not None else time, how.level, how.full,
            extrapolate=how.extrapolate, band=how.band, sensitivity=how.sensitivity,
            coarse_run=how.coarse_run_of(wanted.run),
        )  # fmt: skip
    if truth is not None:
        prediction = beside_truth(prediction, truth)
    prediction = hidden_above(prediction, how.hide_above)
    about = {"model_name": f"{prediction.attrs['model']} of {asked.name}"} | ({"run": wanted.run} if wanted.run else {})
    files = write_prediction(prediction, wanted.output, about, how.template)
    row = _predicted(wanted, prediction, files, asked.record, how.hide_above)
    return (
        row if how.band is None else replace(row, band=_band(prediction, how.band, asked, how.coarse_run is not None))
    )


# The model of a worker, which is loaded once for all its runs.
_loaded: dict[Path, Model] = {}


def _one_elsewhere(wanted: _Wanted, shared: tuple[Path, _How]) -> PredictedRun:
    from crashkit.api.predict import load_model

    folder, how = shared
    if folder not in _loaded:
        _loaded.clear()
        _loaded[folder] = load_model(folder)
    return _one(_loaded[folder], wanted, how)


def _band(prediction: xr.Dataset, share: float, model: Model, from_coarse: bool = False) -> PredictedBand:
    import numpy as np

    from surrogates.storage.tested import held_on_tests

    width, surrogate = prediction["half_width"].values, model.surrogate
    name, full = str(prediction.attrs["model"]), prediction.attrs["level"] == 0
    number = surrogate.level_names[name]
    behind = (surrogate.run_bands if from_coarse else surrogate.bands)[number, full and number > 0]
    inside = None
    if "error" in prediction:
        error = prediction["error"].values
        inside = float((error <= width)[np.isfinite(error)].mean())
    tested = model.folder is not None and full and not from_coarse
    held = held_on_tests(model.folder).get(name) if tested and model.folder is not None else None
    return PredictedBand(
        share=share,
        mean_half_width_m=float(np.nanmean(width)),
        largest_half_width_m=float(np.nanmax(width)),
        runs_behind=behind.runs,
        inside=inside,
        on_test_runs=None if held is None else held.told,
    )


def _wanted(
    record: Record,
    output: Path,
    parameters: Mapping[str, Any] | None,
    table: str | Path | None,
    rows: Sequence[_Row],
    run: str | int | None,
    dataset: str | Path | None,
) -> list[_Wanted]:
    from crashkit.errors import DataError

    if sum(given is not None for given in (parameters, table, run)) != 1 or (run is None) != (dataset is None):
        raise DataError("expected either parameters, or a table, or a run with its dataset")
    if table is not None:
        return [_of_row(record, Path(table), row) for row in rows]
    if run is not None and dataset is not None:
        return [_known(record, output, run, Path(dataset))]
    return [_Wanted("", parameters or {}, output)]


@dataclass(frozen=True)
class _Row:
    """A row of a table: its run, what stands in it (value, unit) by name, and its file."""

    run: str
    values: Mapping[str, tuple[float, str]]
    output: Path


def _rows(output: Path, table: Path) -> list[_Row]:
    """The rows of a table, each with a file of its own; nothing of the model is needed.

    Raises
    ------
    ReadError, DataError
        For the table.
    OutputError
        Where two rows would be written to one file, or nothing of the kind can be.
    """
    from crashkit.api.predict import D3PLOT, SUFFIXES
    from crashkit.errors import OutputError
    from crashkit.ingestion.parameter_table import read_parameter_table
    from crashkit.output import file_name

    if output.suffix and output.suffix not in SUFFIXES:
        raise OutputError(f"{output}: of a table, expected a folder, or NAME.pvd, NAME.vtkhdf or NAME.npz")

    def file_of(run: str) -> Path:
        if output.name == D3PLOT:
            return output / file_name(run)
        if output.suffix:
            return output.with_name(f"{output.stem}_{file_name(run)}{output.suffix}")
        return output / f"{file_name(run)}.pvd"

    found = read_parameter_table(table, numbered=True)
    rows = [_Row(run, values, file_of(run)) for run, values in found.rows.items()]
    runs: dict[str, str] = {}  # by the file's name, in which some systems do not tell capitals apart
    for one in rows:
        other = runs.setdefault(one.output.name.lower(), one.run)
        if other != one.run:
            raise OutputError(
                f"{table}: rows {other!r} and {one.run!r} would both be written to {one.output.name}; rename one of them"
            )
    return rows


def _of_row(record: Record, table: Path, row: _Row) -> _Wanted:
    """What is asked for in a row: the parameters of the model, whatever their capitals; other columns are left aside.

    Raises
    ------
    DataError
        For a column that would be a parameter of the model if what stands behind its name were a unit.
    """
    from crashkit.errors import DataError

    spelled = {name.lower(): name for name in row.values}
    parameters = {}
    for name in record.ranges.names:
        found = name if name in row.values else spelled.get(name.lower())
        if found is None:
            longer = [n for n in row.values if n.lower().startswith(f"{name.lower()}_")]
            longer = [n for n in longer if n not in record.ranges.names]
            if longer:
                behind, unit = longer[0][len(name) + 1 :], record.ranges.written[record.ranges.names.index(name)][0]
                raise DataError(
                    f"{table}: {behind!r} behind {name} is no unit that is known; the model has it in "
                    f"{unit or 'no unit'}: name the column '{name} [{unit or '1'}]'"
                )
            continue
        value, unit = row.values[found]
        parameters[name] = f"{value!r}{unit}"
    return _Wanted(row.run, parameters, row.output)


def _known(record: Record, output: Path, run: str | int, dataset: Path) -> _Wanted:
    from crashkit.dataset import opened_dataset
    from crashkit.errors import DataError
    from crashkit.selection import runs_of

    with opened_dataset(dataset) as opened:
        place = runs_of([str(n) for n in opened["sim"].values], [run])[0]
        missing = [n for n in record.ranges.names if n not in opened]
        if missing:
            raise DataError(f"{dataset}: has no parameter {', '.join(missing)}; give the dataset of the model")
        truth = opened.isel(sim=place).load()
    return _Wanted(str(truth["sim"].values), {n: float(truth[n]) for n in record.ranges.names}, output, truth)


def _predicted(
    wanted: _Wanted, prediction: xr.Dataset, files: list[Path], record: Record, hide_above: float
) -> PredictedRun:
    import numpy as np

    known = wanted.truth is not None
    sentences = str(prediction.attrs["warnings"]).splitlines()
    for seen, what in ((record.fitted_runs, "trained"), (record.validation_runs, "tuned")):
        if known and wanted.run in seen:
            sentences.append(f"the model was {what} on {wanted.run}; its error there says nothing about new runs")
    moved = prediction["predicted" if known else "displacement"].values
    errors: dict[str, Any] = {}
    if known:
        error = prediction["error"].values
        motion = np.linalg.norm(prediction["displacement"].values, axis=-1)
        errors = {
            "mean_error_m": float(np.nanmean(error)),
            "largest_error_m": float(np.nanmax(error)),
            "relative_error": float(np.nanmean(error) / max(float(np.nanmean(motion)), 1e-12)),
        }
    last = prediction["removal_probability"].values[-1] if "removal_probability" in prediction else None
    return PredictedRun(
        run=wanted.run,
        files=files,
        arrays=[str(n) for n, v in prediction.data_vars.items() if v.dims[:2] in (("time", "node"), ("time", "face"))],
        model=str(prediction.attrs["model"]),
        level=int(prediction.attrs["level"]),
        states=prediction.sizes["time"],
        nodes=prediction.sizes["node"],
        largest_displacement_m=max(float(np.einsum("nx,nx->n", u, u).max()) for u in moved) ** 0.5,
        warnings=sentences,
        expected_removed=None if last is None else float(last.sum()),
        hidden=None if last is None else int((last > hide_above).sum()),
        numbers=_numbers(prediction),
        **errors,
    )


def _numbers(prediction: xr.Dataset) -> dict[str, dict[str, Any]] | None:
    of_role = [str(n) for n, v in prediction.data_vars.items() if v.attrs.get("role") == "number"]
    names = [n for n in of_role if n.removesuffix("_half_width") not in of_role or not n.endswith("_half_width")]
    out: dict[str, dict[str, Any]] = {}
    for name in names:
        out[name] = {"value": float(prediction[name]), "unit": str(prediction[name].attrs["units"])}
        if f"{name}_half_width" in of_role:
            out[name]["half_width"] = float(prediction[f"{name}_half_width"])
    return out or None
