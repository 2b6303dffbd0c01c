"""Runs of a solver become one dataset: checked, in SI units, at common times, written run by run.

Two passes. The survey opens every run, reads no displacement, and settles what all runs share: structure, time,
parameters, fields. Then each run is written on its own, by this process or by Dask workers, and noted in a journal;
a killed ingest goes on behind the last note, and ends with the same bytes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from crashkit import __version__, store
from crashkit.alignment import common_time, interpolate, nearest, same_time
from crashkit.errors import CrashkitError, DataError, OutputError, ReadError
from crashkit.parameter_table import read_parameter_table
from crashkit.readers import reader_for
from crashkit.readers.base import FieldInfo, Run, split_states
from crashkit.store import ArraySpec, Staging
from crashkit.structure import Structure, match_nodes, structure_of
from data_schema import CONVENTIONS, to_si, unit_system
from data_schema.units import UnknownUnits
from data_schema.validation import FIRST_STATE_TOLERANCE, validate

if TYPE_CHECKING:
    import xarray as xr

Progress = Callable[[int, int, str], None]

# Bytes of one field of one run held at once (own states of a group of nodes).
BUDGET = 160 << 20
# Reference positions closer than this fraction of the structure's size are the same position.
_SAME_SHAPE = 1e-6


@dataclass(frozen=True)
class IngestSummary:
    """What an ingest did: runs in the dataset, those written now, skipped runs with their reasons, and notes."""

    output: Path
    runs: tuple[str, ...]
    written: tuple[str, ...]
    skipped: Mapping[str, str]
    alignment_error: Mapping[str, float]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Options:
    """What decides the content of the dataset; part of the plan that a restart must share."""

    units: str | None = None
    parts: tuple[str, ...] = ()
    exclude_parts: tuple[str, ...] = ()
    keep_rigid_walls: bool = False
    fields: tuple[str, ...] = ()
    allow_incomplete: bool = False
    reader: str | None = None
    reader_options: tuple[tuple[str, Any], ...] = ()


@dataclass(frozen=True)
class _Found:
    """One run as the survey found it; small enough to send to a worker."""

    source: str
    name: str
    solver: str
    units: str
    time: NDArray[np.float64]  # s
    parameters: Mapping[str, tuple[float, str]]
    fields: Mapping[str, FieldInfo]
    files: tuple[str, ...]
    complete: bool
    erodes: bool


@dataclass(frozen=True)
class _Plan:
    """What all runs share."""

    options: _Options
    structure: Structure
    length: float
    time: NDArray[np.float64]
    fields: Mapping[str, FieldInfo]
    per_run_shape: bool
    erodes: bool
    n_source_state: int


@dataclass
class _Survey:
    found: list[_Found] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)
    structure: Structure | None = None
    length: float = 1.0
    per_run_shape: bool = False
    notes: list[str] = field(default_factory=list)


def ingest(
    sources: Sequence[str | Path],
    output: str | Path,
    *,
    params: str | Path | None = None,
    units: str | None = None,
    reader: str | None = None,
    reader_options: Mapping[str, Any] | None = None,
    parts: Sequence[str] = (),
    exclude_parts: Sequence[str] = (),
    keep_rigid_walls: bool = False,
    fields: Sequence[str] = (),
    time: Sequence[float] | None = None,
    on_error: Literal["stop", "skip"] = "stop",
    allow_incomplete: bool = False,
    overwrite: bool = False,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> IngestSummary:
    """Read all runs in `sources` and write them as one dataset to `output` (`.zarr` or `.nc`).

    params      table of design parameters (`crashkit.parameter_table`); without it those of the source
    units       unit system of the source, e.g. "mm-ms-kg"; needed where the source states none
    parts       only these parts (number, title or glob); exclude_parts: without these
    fields      further result fields to keep, by name
    time        common output times, s; by default those of the coarsest run
    on_error    "stop" at the first run that cannot be used, or "skip" it and say so in the summary
    workers     processes on this machine (needs the extra `distributed` above 1); scheduler: address of a Dask cluster
    overwrite   read runs again that the dataset already holds; without it they stay as they are

    An existing dataset gets the new runs appended. Raises CrashkitError with file and place.
    """
    output = Path(output)
    store.check_suffix(output)
    _check_writable(output)
    store.recover(output)
    options = _Options(
        units, tuple(parts), tuple(exclude_parts), keep_rigid_walls, tuple(fields), allow_incomplete, reader,
        tuple(sorted((reader_options or {}).items())),
    )  # fmt: skip
    tell = progress or (lambda done, total, note: None)

    survey = _survey([Path(s) for s in sources], options, on_error, tell)
    _apply_table(survey, params, on_error)
    if not survey.found:
        raise DataError("no run can be used: " + "; ".join(f"{k}: {v}" for k, v in survey.skipped.items()))
    old = _Existing.open(output)
    fresh = _fresh_runs(survey, old, overwrite)
    if not fresh:
        return IngestSummary(output, tuple(old.names if old else ()), (), survey.skipped, {}, ("nothing new to read",))
    plan = _plan(survey, fresh, options, time, old)
    return _write(output, plan, survey, fresh, old, on_error, workers, scheduler, tell)


# --- survey ------------------------------------------------------------------------------------------------------


def _survey(sources: list[Path], options: _Options, on_error: str, tell: Progress) -> _Survey:
    out = _Survey()
    for source in sources:
        chosen = reader_for(source, options.reader)
        count = 0
        for name, run in _each_run(chosen.runs(source, **dict(options.reader_options)), source, on_error, out.skipped):
            count += 1
            tell(len(out.found), 0, f"looking at {name}")
            try:
                _look(run, source, options, out)
            except CrashkitError as error:
                text = f"run {name}: {error}"
                if on_error == "stop":
                    raise type(error)(text) from error
                out.skipped[name] = str(error)
            finally:
                run.close()
        if count == 0 and not out.skipped:
            raise ReadError(f"{source}: holds no run")
    return out


def _each_run(runs: Iterator[Run], source: Path, on_error: str, skipped: dict[str, str]) -> Iterator[tuple[str, Run]]:
    while True:
        try:
            run = next(runs)
        except StopIteration:
            return
        except ReadError as error:
            if on_error == "stop":
                raise
            skipped[f"{source.name} #{len(skipped) + 1}"] = str(error)
            continue
        yield run.name, run


def _look(run: Run, source: Path, options: _Options, out: _Survey) -> None:
    if run.problems and not options.allow_incomplete:
        raise DataError(
            f"{run.problems[0]}{f' (and {len(run.problems) - 1} more)' if len(run.problems) > 1 else ''}; "
            "mend it, or take it as it is with --allow-incomplete"
        )
    complete = not run.problems
    own_time = np.asarray(run.time, np.float64)
    if len(own_time) == 0:
        raise DataError("holds no state")
    if not np.isfinite(own_time).all() or (np.diff(own_time) <= 0).any():
        bad = int(np.argmax(~(np.diff(own_time, prepend=-np.inf) > 0)))
        raise DataError(
            f"state {bad}: its time {own_time[bad]:g} is not after the one before; expected increasing times"
        )
    if run.end_time is not None and len(own_time) > 1:
        step = float(np.median(np.diff(own_time)))
        if own_time[-1] < run.end_time - 1.5 * step:
            if not options.allow_incomplete:
                raise DataError(
                    f"ends at {own_time[-1]:g}, but its control data asks for {run.end_time:g}; it was cut short, or files are "
                    "missing (take it as it is with --allow-incomplete)"
                )
            complete = False
    units = _units(run, options)
    system = unit_system(units)
    if any(f.name == run.name for f in out.found):
        raise DataError("a run of this name is there already; give each run a folder or file name of its own")
    structure = structure_of(
        run.mesh, parts=options.parts, exclude_parts=options.exclude_parts, keep_rigid_walls=options.keep_rigid_walls
    )
    if out.structure is None:
        out.structure, out.length = structure, system.length
        out.notes.extend(structure.notes)
    else:
        structure = match_nodes(out.structure, structure)
        size = float(np.ptp(out.structure.position, axis=0).max()) * out.length
        apart = np.abs(structure.position * system.length - out.structure.position * out.length).max()
        out.per_run_shape |= bool(apart > _SAME_SHAPE * size)
    missing = [n for n in options.fields if n not in run.fields]
    if missing:
        out.notes.append(f"run {run.name}: no field {', '.join(missing)}; it has {', '.join(run.fields) or 'none'}")
    out.found.append(
        _Found(
            source=str(source),
            name=run.name,
            solver=run.solver,
            units=units,
            time=own_time * system.time,
            parameters={k: _parameter(p.value, p.unit) for k, p in run.parameters.items()},
            fields={n: run.fields[n] for n in options.fields if n in run.fields},
            files=tuple(str(f) for f in run.files),
            complete=complete,
            erodes=run.alive(0, 1) is not None or run.alive_cells(0, 1) is not None,
        )
    )


def _units(run: Run, options: _Options) -> str:
    name = options.units or run.units
    if name is None:
        raise DataError("its files state no units; say them, for example --units mm-ms-kg or --units SI")
    try:
        unit_system(name)
    except UnknownUnits as error:
        raise DataError(str(error)) from error
    return name


def _parameter(value: float, unit: str) -> tuple[float, str]:
    factor, si = to_si(unit)
    return value * factor, si


def _apply_table(survey: _Survey, params: str | Path | None, on_error: str) -> None:
    if params is not None:
        table = read_parameter_table(Path(params))
        problems = table.match([f.name for f in survey.found] + list(survey.skipped))
        if problems and on_error == "stop":
            raise DataError("; ".join(problems))
        survey.notes.extend(problems)
        kept = []
        for found in survey.found:
            if found.name in table.rows:
                values = {k: _parameter(p.value, p.unit) for k, p in table.rows[found.name].items()}
                kept.append(replace(found, parameters=values))
            else:
                survey.skipped[found.name] = f"no row in {params}"
        survey.found = kept
    if survey.found:
        first = survey.found[0]
        for found in survey.found[1:]:
            if {k: u for k, (_, u) in found.parameters.items()} != {k: u for k, (_, u) in first.parameters.items()}:
                raise DataError(
                    f"run {found.name} has the parameters {_names(found)}, but run {first.name} has {_names(first)}; "
                    "expected the same names and units in all"
                )


def _names(found: _Found) -> str:
    return ", ".join(f"{k} [{u}]" for k, (_, u) in found.parameters.items()) or "none"


# --- what is there already ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Existing:
    path: Path
    dataset: xr.Dataset  # everything but the large arrays, loaded
    names: tuple[str, ...]

    @classmethod
    def open(cls, path: Path) -> _Existing | None:
        if not path.exists():
            return None
        from crashkit.dataset import open_dataset

        with open_dataset(path) as dataset:
            problems = validate(dataset, values=False)
            if problems:
                raise OutputError(f"{path}: exists and is no crash dataset ({problems[0]}); choose another name")
            small = dataset.drop_vars([n for n in dataset.data_vars if dataset[n].dims[:2] == ("sim", "time")]).load()
        return cls(path, small, tuple(map(str, small["sim"].values)))


def _fresh_runs(survey: _Survey, old: _Existing | None, overwrite: bool) -> list[_Found]:
    if old is None:
        return survey.found
    known = set(old.names)
    again = [f.name for f in survey.found if f.name in known]
    if again and overwrite:
        return survey.found
    for found in survey.found:
        if found.name in known:
            _refuse_changed(found, old)
    return [f for f in survey.found if f.name not in known]


def _refuse_changed(found: _Found, old: _Existing) -> None:
    """A run that the dataset holds may be named again only if its files are still the same."""
    recorded = {e["file"]: e for e in json.loads(old.dataset.attrs["source_files"]) if e["run"] in (found.name, "*")}
    for file in found.files:
        entry = recorded.get(Path(file).name)
        if entry is not None and entry["bytes"] == Path(file).stat().st_size:
            continue
        raise DataError(
            f"{old.path}: holds run {found.name} already, read from another {Path(file).name}; "
            "give the run another name, or replace it with --overwrite"
        )


# --- plan --------------------------------------------------------------------------------------------------------


def _plan(
    survey: _Survey, fresh: list[_Found], options: _Options, time: Sequence[float] | None, old: _Existing | None
) -> _Plan:
    structure = survey.structure
    if structure is None:
        raise DataError("no run can be used")
    fields: dict[str, FieldInfo] = {}
    for name in options.fields:
        infos = {f.fields[name] for f in fresh if name in f.fields}
        if not infos:
            raise DataError(
                f"field {name!r} is in no run; " + (survey.notes[-1] if survey.notes else "ask for another")
            )
        if len(infos) > 1:
            raise DataError(f"field {name!r} lies on different places or has different units in different runs")
        fields[name] = infos.pop()
    wanted = np.asarray(time, np.float64) if time is not None else None
    if old is not None:
        _check_append(old, structure, survey, fields)
        wanted = old.dataset["time"].values
    return _Plan(
        options=options,
        structure=structure,
        length=survey.length,
        time=common_time([f.time for f in fresh], wanted),
        fields=fields,
        per_run_shape=survey.per_run_shape if old is None else "sim" in old.dataset["reference_position"].dims,
        erodes=any(f.erodes for f in fresh),
        n_source_state=max(len(f.time) for f in fresh),
    )


def _check_append(old: _Existing, structure: Structure, survey: _Survey, fields: Mapping[str, FieldInfo]) -> None:
    ds = old.dataset
    if not np.array_equal(ds["node_id"].values, structure.node_id) or not np.array_equal(
        ds["face_nodes"].values, structure.face_nodes
    ):
        raise DataError(f"{old.path}: has another mesh than the new runs; ingest them into a dataset of their own")
    here = {str(n): ds[n].attrs["units"] for n in ds.data_vars if ds[n].attrs.get("role") == "parameter"}
    new = {k: u for k, (_, u) in survey.found[0].parameters.items()}
    if here != new:
        raise DataError(f"{old.path}: has the parameters {here}, the new runs {new}; expected the same")
    size = float(np.ptp(structure.position, axis=0).max()) * survey.length
    if "sim" not in ds["reference_position"].dims and (
        survey.per_run_shape
        or np.abs(ds["reference_position"].values - structure.position * survey.length).max() > _SAME_SHAPE * size
    ):
        raise DataError(f"{old.path}: its runs share one shape, the new ones have another; ingest them apart")
    with_fields = json.loads(ds.attrs.get("field_names", "[]"))
    if set(with_fields) != set(fields):
        raise DataError(
            f"{old.path}: holds the fields {with_fields}, not {sorted(fields)}; ask for the same with --fields"
        )


# --- writing -----------------------------------------------------------------------------------------------------


def _write(
    output: Path,
    plan: _Plan,
    survey: _Survey,
    fresh: list[_Found],
    old: _Existing | None,
    on_error: str,
    workers: int,
    scheduler: str | None,
    tell: Progress,
) -> IngestSummary:
    kept = list(old.names) if old else []
    names = kept + [f.name for f in fresh if f.name not in kept]
    slots = {name: k for k, name in enumerate(names)}
    erodes = plan.erodes or (old is not None and json.loads(old.dataset.attrs.get("erodes", "false")))
    plan = replace(plan, erodes=erodes)
    specs = _specs(plan, len(names))
    staging = Staging(output)
    with _lock(staging):
        if not staging.begin(_fingerprint(plan, fresh, names, on_error)):
            staging.create(specs)
            if old is not None:
                _adopt(staging, old, specs, [k for k, n in enumerate(kept) if n not in {f.name for f in fresh}])
            staging.ready()
        done = staging.finished()
        todo = [(slots[f.name], f) for f in fresh if slots[f.name] not in done]
        tell(len(done), len(fresh), f"{len(done)} of {len(fresh)} runs were finished before" if done else "")
        for record in _execute(todo, plan, staging.output, workers, scheduler):
            if record.get("error") and on_error == "stop":
                raise DataError(f"run {names[record['slot']]}: {record['error']}")
            staging.note(record)
            done[record["slot"]] = record
            tell(len(done), len(fresh), names[record["slot"]])
        for slot, record in done.items():
            if record.get("error"):
                survey.skipped[names[slot]] = record["error"]
        good = [k for k in range(len(names)) if not done.get(k, {}).get("error")]
        if not good:
            raise DataError("no run can be used: " + "; ".join(f"{k}: {v}" for k, v in survey.skipped.items()))
        staging.compact(good, [s.name for s in specs])
        tell(len(done), len(fresh), "finishing")
        staging.publish(_constants(plan, survey, fresh, old, [names[k] for k in good], done, slots))
    return IngestSummary(
        output=output,
        runs=tuple(names[k] for k in good),
        written=tuple(f.name for f in fresh if slots[f.name] in good),
        skipped=survey.skipped,
        alignment_error={
            f.name: float(done[slots[f.name]].get("alignment_error", 0.0)) for f in fresh if slots[f.name] in good
        },
        notes=tuple(dict.fromkeys(survey.notes)),
    )


def _specs(plan: _Plan, n: int) -> list[ArraySpec]:
    t, s = len(plan.time), plan.structure
    out = [
        ArraySpec(
            "displacement", ("sim", "time", "node", "xyz"), (n, t, s.n_nodes, 3), "float32",
            {"units": "m", "long_name": "displacement from the reference position"},
        )
    ]  # fmt: skip
    if plan.per_run_shape:
        out.append(
            ArraySpec("reference_position", ("sim", "node", "xyz"), (n, s.n_nodes, 3), "float64", {"units": "m"})
        )
    if plan.erodes:
        out.append(ArraySpec("alive", ("sim", "time", "face"), (n, t, len(s.face_nodes)), "bool", {}))
    sizes = {"node": s.n_nodes, "face": len(s.face_nodes), "cell": len(s.cell_nodes)}
    for name, info in plan.fields.items():
        dims: tuple[str, ...] = ("sim", "time", info.location)
        shape: tuple[int, ...] = (n, t, sizes[info.location])
        if info.components > 1:
            dims, shape = (*dims, "xyz" if info.components == 3 else f"{name}_component"), (*shape, info.components)
        out.append(ArraySpec(name, dims, shape, "float32", {"units": _SI[info.quantity], "role": "field"}))
    return out


_SI = {
    "length": "m", "time": "s", "mass": "kg", "velocity": "m s-1", "acceleration": "m s-2", "force": "N",
    "stress": "Pa", "energy": "J", "density": "kg m-3", "one": "1",
}  # fmt: skip


def _execute(
    todo: list[tuple[int, _Found]], plan: _Plan, output: Path, workers: int, scheduler: str | None
) -> Iterator[dict[str, Any]]:
    """Write the runs and yield a record of each, in whatever order they finish."""
    if workers <= 1 and scheduler is None:
        for slot, found in todo:
            yield _write_run(slot, found, plan, output)
        return
    try:
        from distributed import Client, LocalCluster, as_completed
    except ImportError as error:
        raise CrashkitError("parallel ingest needs Dask; install crashkit[distributed], or use one worker") from error
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        cluster = None
        if scheduler is None:
            cluster = LocalCluster(
                n_workers=min(workers, max(1, len(todo))), threads_per_worker=1, dashboard_address=None,
                host="127.0.0.1", local_directory=folder,
            )  # fmt: skip
        try:
            with Client(cluster if cluster is not None else scheduler) as client:
                shared = client.scatter(plan, broadcast=True)
                futures = [
                    client.submit(_write_run, slot, found, shared, output.absolute(), pure=False)
                    for slot, found in todo
                ]
                for future in as_completed(futures):
                    yield future.result()
        finally:
            if cluster is not None:
                cluster.close()


def _write_run(slot: int, found: _Found, plan: _Plan, output: Path) -> dict[str, Any]:
    """Write one run into its slot. A run that turns out to be unusable gives a record with `error`."""
    try:
        run = _reopen(found, plan.options)
        try:
            return _copy_run(run, slot, found, plan, Staging(output))
        finally:
            run.close()
    except CrashkitError as error:
        return {"slot": slot, "name": found.name, "error": str(error)}


def _reopen(found: _Found, options: _Options) -> Run:
    runs = reader_for(Path(found.source), options.reader).runs(Path(found.source), **dict(options.reader_options))
    skipped: dict[str, str] = {}
    for name, run in _each_run(runs, Path(found.source), "skip", skipped):
        if name == found.name:
            return run
        run.close()
    raise ReadError(f"{found.source}: run {found.name} is gone since it was looked at")


def _copy_run(run: Run, slot: int, found: _Found, plan: _Plan, staging: Staging) -> dict[str, Any]:
    system = unit_system(found.units)
    structure = match_nodes(
        plan.structure,
        structure_of(
            run.mesh,
            parts=plan.options.parts,
            exclude_parts=plan.options.exclude_parts,
            keep_rigid_walls=plan.options.keep_rigid_walls,
        ),
    )
    digest = hashlib.sha256()
    alive = _alive(run, structure, found, plan) if plan.erodes else None
    gone = _gone_nodes(structure, alive, run, found, plan) if alive is not None else None
    error = _copy_field(
        staging.array("displacement"), slot, run.displacement, structure.node, system.length, found, plan, digest, gone
    )
    if alive is not None:
        staging.array("alive")[slot] = nearest(alive, found.time, plan.time)
        digest.update(nearest(alive, found.time, plan.time).tobytes())
    for name, info in plan.fields.items():
        if name not in found.fields:
            continue  # stays missing
        source = {"node": structure.node, "face": structure.face_source, "cell": structure.cell_source}[info.location]
        _copy_field(
            staging.array(name), slot, lambda a, b, n=name: run.field(n, a, b), source, system.factor(info.quantity),
            found, plan, digest, None, first_is_zero=False,
        )  # fmt: skip
    reference = structure.position * system.length
    digest.update(np.ascontiguousarray(reference, "<f8").tobytes())
    record: dict[str, Any] = {
        "slot": slot,
        "name": found.name,
        "alignment_error": error,
        "checksum": digest.hexdigest(),
        "files": [{"run": found.name, **entry} for entry in map(_file_entry, found.files)],
    }
    if plan.per_run_shape:
        staging.array("reference_position")[slot] = reference
    return record


def _copy_field(
    target: Any,
    slot: int,
    read: Callable[[int, int], NDArray],
    source: NDArray[np.int64],
    factor: float,
    found: _Found,
    plan: _Plan,
    digest: Any,
    gone: NDArray[np.bool_] | None,
    first_is_zero: bool = True,
) -> float:
    """Copy one field of one run, a group of nodes at a time, all states; returns the alignment error, m.

    The source is read in blocks of states; only `BUDGET` bytes are held, so a very large run is read several times.
    """
    states, count = len(found.time), len(source)
    width = int(np.prod(target.shape[3:], dtype=int)) if target.ndim > 3 else 1
    group = max(store.NODE_BLOCK, BUDGET // max(1, states * width * 4) // store.NODE_BLOCK * store.NODE_BLOCK)
    aligned = same_time(found.time, plan.time)
    worst = 0.0
    for begin in range(0, max(count, 1), group):
        rows = source[begin : begin + group]
        values = np.full((states, len(rows), *target.shape[3:]), np.nan, np.float32)
        there = rows >= 0  # a skin face of a solid has no shell behind it: its shell field stays missing
        for first, last in split_states(states, max(count, len(rows)), BUDGET // 4):
            block = read(first, last)
            values[first:last, there] = block[:, rows[there]]
        if factor != 1.0:
            values *= np.float32(factor)
        if gone is not None:
            values[gone[:, begin : begin + group]] = np.nan
        if first_is_zero:
            _check_displacement(values, begin, found, gone)
        if not aligned:
            values, error = interpolate(values, found.time, plan.time)
            worst = max(worst, error)
        digest.update(np.ascontiguousarray(values).tobytes())
        target[slot, :, begin : begin + len(rows)] = values
    return worst


def _check_displacement(values: NDArray[np.float32], begin: int, found: _Found, gone: NDArray[np.bool_] | None) -> None:
    bad = ~np.isfinite(values).all(axis=-1)
    if gone is not None:
        bad &= ~gone[:, begin : begin + values.shape[1]]
    if bad.any():
        state, node = map(int, np.argwhere(bad)[0])
        raise DataError(
            f"{_file_of(found, state)}, state {state} (t = {found.time[state]:g} s), node {begin + node}: the displacement is "
            f"{values[state, node].tolist()}; the solution blew up, or the file is damaged"
        )
    largest = float(np.nan_to_num(np.abs(values[0])).max(initial=0.0))
    if largest > FIRST_STATE_TOLERANCE:
        node = int(np.nan_to_num(np.abs(values[0])).max(axis=-1).argmax())
        raise DataError(
            f"{_file_of(found, 0)}: in its first state (t = {found.time[0]:g} s) node {begin + node} is displaced by {largest:.3g} m; "
            "expected zero: are the first states missing, or are these positions instead of displacements?"
        )


def _file_of(found: _Found, state: int) -> str:
    return (
        found.files[state] if len(found.files) == len(found.time) else (found.files[0] if found.files else found.source)
    )


def _alive(run: Run, structure: Structure, found: _Found, plan: _Plan) -> NDArray[np.bool_]:
    """(own state, face): shells by their own flag, the skin of solids by that of the solid behind it."""
    states = len(found.time)
    out = np.ones((states, len(structure.face_source)), bool)
    shell = structure.face_source >= 0
    for first, last in split_states(states, len(structure.face_source), BUDGET // 4):
        faces, cells = run.alive(first, last), run.alive_cells(first, last)
        if faces is not None:
            out[first:last, shell] = faces[:, structure.face_source[shell]]
        if cells is not None and (~shell).any():
            out[first:last, ~shell] = cells[:, -1 - structure.face_source[~shell]]
    return out


def _gone_nodes(
    structure: Structure, alive: NDArray[np.bool_], run: Run, found: _Found, plan: _Plan
) -> NDArray[np.bool_]:
    """(own state, node): nodes that had faces, have no living one, and that no solid or beam holds."""
    corners = structure.face_nodes
    valid = corners >= 0
    used = np.zeros(structure.n_nodes, bool)
    used[corners[valid]] = True
    held = np.zeros(structure.n_nodes, bool)
    held[structure.cell_nodes[structure.cell_nodes >= 0]] = True
    out = np.zeros((len(alive), structure.n_nodes), bool)
    for state, faces in enumerate(alive):
        if not faces.all():
            living = np.zeros(structure.n_nodes, bool)
            living[corners[faces][valid[faces]]] = True
            out[state] = used & ~held & ~living
    return out


_hashed: dict[tuple[str, int, int], dict[str, Any]] = {}


def _file_entry(name: str) -> dict[str, Any]:
    """Name, size and SHA-256 of a source file; a file that holds many runs is read once in a process."""
    path = Path(name)
    status = path.stat()
    key = (name, status.st_size, status.st_mtime_ns)
    if key not in _hashed:
        digest = hashlib.sha256()
        with path.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
        _hashed[key] = {"file": path.name, "bytes": status.st_size, "sha256": digest.hexdigest()}
    return _hashed[key]


# --- what does not depend on time --------------------------------------------------------------------------------


def _constants(
    plan: _Plan,
    survey: _Survey,
    fresh: list[_Found],
    old: _Existing | None,
    names: list[str],
    done: Mapping[int, Mapping[str, Any]],
    slots: Mapping[str, int],
) -> xr.Dataset:
    """Coordinates, mesh, parameters and attributes: everything that is small."""
    import xarray as xr

    s = plan.structure
    by_name = {f.name: f for f in fresh}
    records = {f.name: done[slots[f.name]] for f in fresh if f.name in names}
    before = {n: k for k, n in enumerate(old.names)} if old is not None else {}

    def per_run(new: Callable[[_Found, Mapping[str, Any]], Any], name: str) -> list[Any]:
        return [
            new(by_name[n], records[n]) if n in records else old.dataset[name].values[before[n]]  # type: ignore[union-attr]
            for n in names
        ]

    ds = xr.Dataset(
        {
            "node_id": ("node", s.node_id),
            "face_nodes": (("face", "corner"), s.face_nodes, {"start_index": 0, "cf_role": "face_node_connectivity"}),
            "face_part": ("face", s.face_part),
            "face_id": ("face", s.face_id),
            "part_id": ("part", np.array([p.id for p in s.parts], np.int64)),
            "part_name": ("part", np.array([p.name for p in s.parts], dtype="U")),
            "complete": ("sim", np.array(per_run(lambda f, r: f.complete, "complete"), bool)),
            "alignment_error": (
                "sim",
                np.array(per_run(lambda f, r: r["alignment_error"], "alignment_error"), np.float64),
                {"units": "m"},
            ),
            "run_checksum": ("sim", np.array(per_run(lambda f, r: r["checksum"], "run_checksum"), dtype="U64")),
            "source_time": (("sim", "source_state"), _source_time(names, by_name, old, before), {"units": "s"}),
            "mesh": ((), np.int32(0), {"cf_role": "mesh_topology", "topology_dimension": 2,
                                       "node_coordinates": "node_x node_y node_z", "face_node_connectivity": "face_nodes"}),
        },
        coords={"sim": np.array(names, dtype="U"), "time": ("time", plan.time, {"units": "s", "long_name": "time"})},
    )  # fmt: skip
    if not plan.per_run_shape:
        position = old.dataset["reference_position"].values if old is not None else s.position * plan.length
        ds["reference_position"] = (("node", "xyz"), position, {"units": "m"})
        ds = ds.assign_coords({f"node_{a}": ("node", position[:, k], {"units": "m"}) for k, a in enumerate("xyz")})
    if len(s.cell_nodes):
        ds["cell_nodes"] = (("cell", "cell_corner"), s.cell_nodes)
        ds["cell_type"], ds["cell_part"], ds["cell_id"] = (
            ("cell", s.cell_type),
            ("cell", s.cell_part),
            ("cell", s.cell_id),
        )
    for name, (_, unit) in fresh[0].parameters.items():
        values = per_run(lambda f, r, n=name: f.parameters[n][0], name)
        ds[name] = ("sim", np.array(values, np.float64), {"units": unit, "role": "parameter"})
    files = [e for r in records.values() for e in r["files"]]
    if old is not None:
        files = [e for e in json.loads(old.dataset.attrs["source_files"]) if e["run"] not in records] + files
    units = sorted({f.units for f in fresh})
    command = f"crashkit {__version__}: ingest of {len(records)} runs from {', '.join(sorted({Path(f.source).name for f in fresh}))}"
    ds.attrs = {
        "Conventions": CONVENTIONS,
        "title": f"{len(names)} crash runs",
        "solver": ", ".join(sorted({f.solver for f in fresh})),
        "source_files": json.dumps(files),
        "units_read": ", ".join(units),
        "units_written": "SI",
        "crashkit_version": __version__,
        "history": "\n".join(filter(None, [old.dataset.attrs["history"] if old is not None else "", command])),
        "field_names": json.dumps(sorted(plan.fields)),
        "erodes": json.dumps(plan.erodes),
        "arrays": json.dumps([spec.name for spec in _specs(plan, len(names))]),
    }
    ds.attrs["checksum"] = _dataset_checksum(ds)
    return ds


def _source_time(
    names: list[str], fresh: Mapping[str, _Found], old: _Existing | None, before: Mapping[str, int]
) -> NDArray:
    own = [
        fresh[n].time if n in fresh else old.dataset["source_time"].values[before[n]]  # type: ignore[union-attr]
        for n in names
    ]
    out = np.full((len(names), max(len(t) for t in own)), np.nan)
    for row, times in zip(out, own, strict=True):
        row[: len(times)] = times
    return out


def _dataset_checksum(ds: xr.Dataset) -> str:
    """SHA-256 over the runs' checksums, parameters and times: the same for Zarr and NetCDF, any workers."""
    digest = hashlib.sha256()
    digest.update(np.ascontiguousarray(ds["time"].values, "<f8").tobytes())
    for name in sorted(str(n) for n in ds.data_vars if ds[n].attrs.get("role") == "parameter"):
        digest.update(name.encode() + np.ascontiguousarray(ds[name].values, "<f8").tobytes())
    for run, checksum in zip(ds["sim"].values, ds["run_checksum"].values, strict=True):
        digest.update(f"{run}:{checksum}".encode())
    return digest.hexdigest()


def _adopt(staging: Staging, old: _Existing, specs: list[ArraySpec], slots: list[int]) -> None:
    """Take the runs `slots` of the old dataset over, unread where both are Zarr."""
    from crashkit.dataset import open_dataset

    there = [s for s in specs if s.name in json.loads(old.dataset.attrs["arrays"])]
    if old.path.is_dir():
        staging.adopt(old.path, there, slots)
    else:
        with open_dataset(old.path) as dataset:
            for spec in there:
                for k in slots:
                    staging.array(spec.name)[k] = dataset[spec.name].isel(sim=k).values
    for spec in specs:
        if spec.name == "alive" and spec not in there:  # nothing could erode so far
            for k in slots:
                staging.array("alive")[k] = True


def _fingerprint(plan: _Plan, fresh: list[_Found], names: list[str], on_error: str) -> dict[str, Any]:
    """What must be the same for a restart to go on: the files (size and date), the options and the result's layout."""
    files = {f: [(s := Path(f).stat()).st_size, s.st_mtime_ns] for found in fresh for f in found.files}
    return {
        "version": __version__,
        "files": files,
        "options": json.loads(json.dumps(plan.options.__dict__, default=str)),
        "names": names,
        "fresh": [f.name for f in fresh],
        "parameters": {f.name: dict(f.parameters) for f in fresh},
        "time": plan.time.tolist(),
        "on_error": on_error,
    }


def _check_writable(output: Path) -> None:
    folder = output.absolute().parent
    if not folder.is_dir():
        raise OutputError(f"{output}: the folder {folder} does not exist; make it first")
    import os

    if not os.access(folder, os.W_OK):
        raise OutputError(f"{output}: the folder {folder} cannot be written to")


class _lock:
    """One ingest at a time into one output: two would write into the same staging folder."""

    def __init__(self, staging: Staging) -> None:
        self._path = staging.folder.with_name(staging.folder.name + ".lock")
        self._output = staging.output

    def __enter__(self) -> None:
        import fcntl

        try:
            self._stream = self._path.open("w")
        except OSError as error:
            raise OutputError(f"{self._path}: cannot be written ({error.strerror})") from error
        try:
            fcntl.flock(self._stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._stream.close()
            raise OutputError(f"{self._output}: another ingest is writing it; wait for it to end") from error

    def __exit__(self, *_: object) -> None:
        self._stream.close()
        self._path.unlink(missing_ok=True)
