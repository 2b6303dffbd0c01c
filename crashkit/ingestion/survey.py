"""The first look at every run, before anything large is read: can it be used, and what do all runs share?

A run is refused here, by name and with the place in its file, if it is incomplete, has times that do not increase,
no known units, another mesh than the runs before it, or lacks a parameter. What the values hold is checked when they
are read (`crashkit.ingestion.transfer`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from string import Formatter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crashkit.display import listed
from crashkit.errors import CrashkitError, DataError, ReadError
from crashkit.ingestion.life import Dead, lives_at_start, never_alive
from crashkit.ingestion.parameter_table import ParameterTable, read_parameter_table
from crashkit.ingestion.structure import Structure, matched, structure_of
from crashkit.readers import passed_over, reader_for
from crashkit.readers.base import FieldInfo, Run, RunMesh, Runs
from crashkit.readers.checks import reading
from crashkit.readers.parameter_names import parameter_columns
from data_schema import DIMENSIONS, VARIABLES, to_si, unit_system
from data_schema.units import UnknownUnits, si_unit

# Reference positions closer than this fraction of the structure's size are the same: files keep seven digits.
SAME_SHAPE = 1e-6
# A run may end this many of its output steps before the end that was asked for: solvers stop on a time step.
_MISSING_STEPS = 1.5


@dataclass(frozen=True)
class Choice:
    """What of each run is wanted, and how it is to be understood; the options of `ingest` that decide the content.

    Attributes
    ----------
    names
        How runs are called in the dataset, from `{run}` (as its source calls it) and `{source}` (file or folder).
    """

    units: str | None = None
    parts: tuple[str, ...] = ()
    exclude_parts: tuple[str, ...] = ()
    keep_rigid_walls: bool = False
    fields: tuple[str, ...] = ()
    allow_incomplete: bool = False
    names: str = "{run}"
    reader: str | None = None
    reader_options: tuple[tuple[str, str], ...] = ()

    def structure(self, run: Run, without: Dead | None = None) -> Structure:
        """The chosen structure of a run, without the elements `without`."""
        return self.of_mesh(run.mesh, without)

    def of_mesh(self, mesh: RunMesh, without: Dead | None = None) -> Structure:
        """The chosen structure of a mesh, without the elements `without`."""
        return structure_of(
            mesh,
            without=without.of(mesh) if without else None,
            parts=self.parts,
            exclude_parts=self.exclude_parts,
            keep_rigid_walls=self.keep_rigid_walls,
        )


@dataclass(frozen=True)
class Field:
    """A result field as it goes into the dataset: `info` says where it lies; `unit` is "unknown" where nobody says."""

    info: FieldInfo
    unit: str


@dataclass(frozen=True)
class Found:
    """One run that can be used; small enough to send to a worker.

    Attributes
    ----------
    run, index
        Its name and place in the source; `name` is that in the dataset.
    time
        (state,) s, its own output times.
    parameters
        Name -> (value, unit), in the dataset's units.
    as_written
        Name -> unit in which the table or the source gave the parameter, such as MPa; "" where none is said.
    fields
        The wanted fields that it has.
    """

    source: Path
    run: str
    index: int
    name: str
    solver: str
    units: str
    time: NDArray[np.float64]
    parameters: Mapping[str, tuple[float, str]]
    fields: Mapping[str, Field]
    files: tuple[Path, ...]
    end_time: float | None
    complete: bool
    as_written: Mapping[str, str] = field(default_factory=dict)


@dataclass
class Survey:
    """What was found. `structure` is that of the first run (or of the dataset appended to, `appended`), in metres.

    `dead` are the elements that live in no run so far, `reference` the first run's mesh and its length unit in metres
    where there are any.
    """

    found: list[Found] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)
    structure: Structure | None = None
    one_shape: bool = True
    notes: list[str] = field(default_factory=list)
    appended: bool = False
    dead: Dead | None = None
    reference: tuple[RunMesh, float] | None = None

    def note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)

    def reasons(self) -> str:
        """Why runs were skipped, of the first few."""
        told = [f"{run}: {reason}" for run, reason in list(self.skipped.items())[:3]]
        more = [f"and {len(self.skipped) - 3} more"] if len(self.skipped) > 3 else []
        return "; ".join([*told, *more]) or "the sources hold none"

    def refuse(self, run: str, error: CrashkitError, stop: bool) -> None:
        """Skip a run and remember why, or give up."""
        if stop:
            raise type(error)(f"run {run}: {error}") from error
        self.skipped[run] = str(error)


def survey(
    sources: Sequence[Path],
    choice: Choice,
    *,
    params: Path | None = None,
    time: NDArray[np.float64] | None = None,
    structure: Structure | None = None,
    stop: bool = True,
    tell: Callable[[str], None] = lambda note: None,
) -> Survey:
    """Look at all runs in `sources`.

    Parameters
    ----------
    params
        Table of design parameters; its values go before those of the source.
    time
        The common times asked for, if any: a run needs to reach no further.
    structure
        Of the dataset the runs shall join; None for a new one.
    stop
        Raise at the first run that cannot be used; else it is skipped, with its reason.

    Raises
    ------
    CrashkitError
        For what concerns all runs (unknown format, unreadable table, a field nobody has).
    """
    table = read_parameter_table(params) if params is not None else None
    out = Survey(structure=structure, appended=structure is not None)
    used: dict[str, str] = {}
    for source in sources:
        for index, name, run in each_run(source, choice, out, stop):
            tell(name)
            try:
                with reading(source):
                    found = _look(run, name, source, index, choice, out)
                if table is not None:
                    row = table.rows[_row_of(table, name, used)]
                    written = {**found.as_written, **{n: unit for n, (_, unit) in row.items()}}
                    found = replace(found, parameters=_from_table(found, row, out, table.path), as_written=written)
                out.found.append(_same_parameters(found, out))
            except CrashkitError as error:
                out.refuse(name, error, stop)
            finally:
                run.close()
    if table is not None:
        for text in table.notes:
            out.note(text)
        by_number = [f"run {run} has row {key}" for key, run in used.items() if key.isdigit() and key != run]
        if by_number:
            more = f" and {len(by_number) - 3} more" if len(by_number) > 3 else ""
            out.note(f"{table.path}: knows runs by their numbers, so {', '.join(by_number[:3])}{more}")
        unused = [r for r in table.rows if r not in used and r not in out.skipped]
        if unused:
            out.note(f"{table.path}: {_listed(unused)} in the table, but no such run was given")
    _refuse_short(out, choice, time, stop)
    if not out.found:
        raise DataError(f"no run can be used ({out.reasons()})")
    _leave_out_dead(out, choice)
    for name in choice.fields:
        _note_missing(name, out)
    return out


def _leave_out_dead(out: Survey, choice: Choice) -> None:
    """Take the elements that live in no run out of the structure, and the nodes that only they use."""
    if not out.dead or out.reference is None or out.structure is None or out.appended:
        return
    mesh, length = out.reference
    reduced = choice.of_mesh(mesh, out.dead)
    nodes = out.structure.n_nodes - reduced.n_nodes
    elements = len(out.dead.faces) + len(out.dead.cells)
    out.note(
        f"{elements} element{'s' if elements > 1 else ''} that live{'' if elements > 1 else 's'} in no state of any run "
        f"left out, and {nodes} node{'' if nodes == 1 else 's'} that nothing else uses"
    )
    out.structure = replace(reduced, position=reduced.position * length)


def _row_of(table: ParameterTable, run: str, used: dict[str, str]) -> str:
    """The row of `run`; one that another run has taken by its number belongs to neither."""
    key = table.key(run)
    if used.setdefault(key, run) != run:
        raise DataError(
            f"{table.path}: row {key} could be that of run {used[key]} and of run {run}; name the rows as the runs"
        )
    return key


def each_run(source: Path, choice: Choice, out: Survey, stop: bool) -> Iterator[tuple[int, str, Run]]:
    """(place in the source, name in the dataset, run); runs that cannot be opened are refused."""
    with reading(source):
        reader = reader_for(source, choice.reader)
        runs = reader.runs(source, **dict(choice.reader_options))
    for text in (*getattr(runs, "passed_over", ()), *(passed_over(source, reader) if choice.reader is None else ())):
        out.note(text)
    index = -1
    while True:
        index += 1
        try:
            with reading(source):
                run = next(runs, None)
        except ReadError as error:
            if stop:
                raise
            if isinstance(runs, Runs):
                out.skipped[_named(runs.names[index], source, choice.names)] = str(error)
            else:
                out.skipped[f"{source.name}, run {index + 1}"] = str(error)
            continue
        if run is None:
            if index == 0:
                raise ReadError(f"{source}: holds no run")
            return
        yield index, _named(run.name, source, choice.names), run


def reader_options(mesh: str | Path | None, time_step: float | None) -> tuple[tuple[str, str], ...]:
    """Options for a reader beside the path, without those not given; it refuses options that it does not have."""
    if mesh is not None and not Path(mesh).is_file():
        raise DataError(f"--mesh is {mesh}, which is no file; give a mesh file with the faces, or leave it out")
    given = {"mesh": mesh, "time_step": time_step}
    return tuple((name, str(value)) for name, value in given.items() if value is not None)


def reopen(found: Found, choice: Choice) -> Run:
    """The run `found`, opened again where it was found."""
    runs = reader_for(found.source, choice.reader).runs(found.source, **dict(choice.reader_options))
    with reading(found.source):
        known = not isinstance(runs, Runs) or found.run in runs.names
        run = None if not known else runs.open(found.run) if isinstance(runs, Runs) else _at(runs, found.index)
    if run is None or run.name != found.run or len(run.time) != len(found.time):
        raise ReadError(f"{found.source}: run {found.name} has changed since it was first looked at; start again")
    return run


def _at(runs: Iterator[Run], place: int) -> Run | None:
    """The run at `place` of an iterator that knows no names; those before it are opened on the way."""
    for _ in range(place):
        try:
            before = next(runs, None)
        except ReadError:
            continue
        if before is not None:
            before.close()
    return next(runs, None)


def wanted_field(run: Run, name: str, units: str) -> Field | None:
    """The field `name` as the dataset keeps it, or None if the run has nothing of the kind.

    A field of shells also covers the skin of solids, with the values of the solid behind a face: `plastic_strain`
    takes in `solid_plastic_strain`, which can be asked for on all cells as well.
    """
    info = run.fields.get(name)
    if info is None:
        behind = cell_fields(run, name)
        if not behind:
            return None
        info = replace(run.fields[behind[0]], name=name, location="face")
    try:
        unit_system(units).factor(info.quantity)
        return Field(info, si_unit(info.quantity))
    except UnknownUnits:
        return Field(info, "unknown")


def cell_fields(run: Run, name: str) -> list[str]:
    """Fields of solids, thick shells, ... that mean the same as the shell field `name`."""
    return [n for n, info in run.fields.items() if info.location == "cell" and n.endswith(f"_{name}")]


def _named(run: str, source: Path, pattern: str) -> str:
    try:
        whole = source.resolve()
        asked = [(field, spec, how) for _, field, spec, how in Formatter().parse(pattern) if field is not None]
        if odd := [field for field, spec, how in asked if field not in ("run", "source") or spec or how]:
            raise ValueError(
                f"{{{odd[0]}}} with what stands behind it" if odd[0] in ("run", "source") else f"{{{odd[0]}}}"
            )
        return pattern.format(run=run, source=whole.name if whole.is_dir() else whole.stem)
    except (KeyError, IndexError, ValueError) as error:
        raise DataError(
            f"names {pattern!r} not understood ({error}); expected text with {{run}} and {{source}}"
        ) from error


def _look(run: Run, name: str, source: Path, index: int, choice: Choice, out: Survey) -> Found:
    if any(f.name == name for f in out.found):
        raise DataError(
            f"{source}: a run of this name was given already; rename its folder or file, or tell them apart with "
            "--names '{source}-{run}'"
        )
    units = _units(run, source, choice, out)
    time = np.asarray(run.time, np.float64)
    _check_time(time, source)
    problems = [*run.problems, *_ends_early(run, time, source)]
    if problems and not choice.allow_incomplete:
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise DataError(f"{problems[0]}{more}; mend the run, or take it as it is with --allow-incomplete")
    for problem in problems:
        out.note(f"run {name} is incomplete: {problem}")
    system = unit_system(units)
    dead = never_alive(run)
    structure = choice.structure(run)
    if dead is not None:
        if not lives_at_start(run, structure):
            raise DataError(
                f"{source}: no element lives in the first state (time {time[0]:g}); expected an element status of 1, or "
                "not 0, for living elements: is it written the other way round?"
            )
        if out.appended and out.structure is not None:
            dead = dead.outside(out.structure)
            structure = choice.structure(run, dead)
    structure = replace(structure, position=structure.position * system.length)
    if not np.isfinite(structure.position).all():
        node = int(np.argmin(np.isfinite(structure.position).all(axis=1)))
        raise DataError(f"{source}: node {structure.node_id[node]} has an undeformed position that is no number")
    for text in (*structure.notes, *run.notes):
        out.note(text)
    if out.structure is None:
        out.structure = structure
        out.dead, out.reference = dead, None if dead is None else (run.mesh, system.length)
    else:
        if not out.appended and out.dead is not None:
            out.dead = out.dead.both(dead) if dead is not None else None
        structure = matched(out.structure, structure)
        size = float(np.ptp(out.structure.position, axis=0).max(initial=0.0))
        out.one_shape &= bool(np.abs(structure.position - out.structure.position).max(initial=0.0) <= SAME_SHAPE * size)
    fields = {n: f for n in choice.fields if (f := wanted_field(run, n, units)) is not None}
    for field_name, wanted in fields.items():
        if wanted.unit == "unknown":
            out.note(f"field {field_name}: no source says its unit; the values stay as they are, labelled unknown")
    if run.left_out:
        out.note(f"left out of {source.name}: {', '.join(run.left_out)}")
    missing = [n for n in choice.fields if n not in fields]
    if missing:
        reasons = [f"{n}: {run.withheld[n]}" for n in missing if n in run.withheld]
        told = "; ".join(reasons) or f"it has {', '.join(run.fields) or 'no further field'}"
        out.note(f"run {name} has no {', '.join(missing)}; {told}")
    return Found(
        source=source,
        run=run.name,
        index=index,
        name=name,
        solver=run.solver,
        units=units,
        time=time * system.time,
        parameters=_in_dataset_units({k: (p.value, p.unit) for k, p in run.parameters.items()}, source),
        fields=fields,
        files=tuple(run.files),
        end_time=None if run.end_time is None else run.end_time * system.time,
        complete=not problems,
        as_written={k: p.unit for k, p in run.parameters.items()},
    )


def _units(run: Run, source: Path, choice: Choice, out: Survey) -> str:
    name = choice.units or run.units
    if name is None:
        raise DataError(f"{source}: its files state no units; say them, for example --units mm-ms-kg or --units SI")
    try:
        unit_system(name)
    except UnknownUnits as error:
        raise DataError(str(error)) from error
    if choice.units and run.units and choice.units != run.units:
        out.note(f"{source}: states the units {run.units}; read in {choice.units} as asked for")
    return name


def _check_time(time: NDArray[np.float64], source: Path) -> None:
    if len(time) == 0:
        raise DataError(f"{source}: holds no state")
    wrong = ~np.isfinite(time)
    wrong[1:] |= np.diff(time) <= 0
    if wrong.any():
        k = int(np.argmax(wrong))
        before = f", the one before {time[k - 1]:g}" if k else ""
        raise DataError(f"{source}: state {k} has time {time[k]:g}{before}; expected increasing times")


def _ends_early(run: Run, time: NDArray[np.float64], source: Path) -> list[str]:
    if run.end_time is None:
        return []
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if time[-1] >= run.end_time - _MISSING_STEPS * step:
        return []
    return [f"{source}: ends at time {time[-1]:g}, its control data asks for {run.end_time:g}"]


def _refuse_short(out: Survey, choice: Choice, time: NDArray[np.float64] | None, stop: bool) -> None:
    """Runs whose source states no end time must reach as far as the others do."""
    whole = [f for f in out.found if f.complete and len(f.time) > 1]
    if len(whole) < 2:
        return
    latest = max(whole, key=lambda f: float(f.time[-1]))
    goal = float(latest.time[-1]) if time is None else min(float(time[-1]), float(latest.time[-1]))
    for place, found in enumerate(out.found):
        short = (
            found.time[-1] < goal - _MISSING_STEPS * float(np.median(np.diff(found.time))) if found in whole else False
        )
        if not short or found.end_time is not None:
            continue
        problem = f"{found.source}: ends at {found.time[-1]:g} s, run {latest.name} at {latest.time[-1]:g} s"
        if choice.allow_incomplete:
            out.note(f"run {found.name} is incomplete: {problem}")
            out.found[place] = replace(found, complete=False)
        else:
            error = DataError(f"{problem}; mend the run, or take it as it is with --allow-incomplete")
            out.refuse(found.name, error, stop)
    out.found = [f for f in out.found if f.name not in out.skipped]


def _in_dataset_units(values: Mapping[str, tuple[float, str]], place: Any) -> dict[str, tuple[float, str]]:
    out = {}
    columns = parameter_columns(list(values), [unit for _, unit in values.values()], str(place))
    for (name, unit), (value, _) in zip(columns, values.values(), strict=True):
        if name in VARIABLES or name in DIMENSIONS:
            raise DataError(f"{place}: a parameter cannot be called {name!r}, which means something else; rename it")
        try:
            factor, si = to_si(unit)
        except UnknownUnits as error:
            raise DataError(f"{place}: parameter {name}: {error}") from error
        if not np.isfinite(value * factor):
            raise DataError(f"{place}: parameter {name} is {value}; expected a number")
        out[name] = (value * factor, si)
    return out


def _from_table(
    found: Found, row: Mapping[str, tuple[float, str]], out: Survey, path: Path
) -> dict[str, tuple[float, str]]:
    """Parameters of a run with those of its row, which go before the source's."""
    values = _in_dataset_units(row, path)
    both = [n for n in values if n in found.parameters and found.parameters[n] != values[n]]
    if both:
        out.note(f"{path}: {', '.join(both)} of the table taken instead of the source's own")
    for name, (value, unit) in row.items():
        if not unit:
            out.note(f"{path}: {name} has no unit and is taken for a plain number; name it as {name} [unit]")
        if value < 0 and "speed" in name.lower():
            out.note(f"{path}: {name} is negative in some rows; is that meant?")
    return {**found.parameters, **values}


def _same_parameters(found: Found, out: Survey) -> Found:
    """`found`, if it has the parameters of the first run, in the same units."""
    if not out.found:
        return found
    first = out.found[0]
    mine, theirs = ({n: u for n, (_, u) in f.parameters.items()} for f in (found, first))
    if mine != theirs:
        raise DataError(
            f"{found.source}: has the parameters {described(mine)}, run {first.name} has {described(theirs)}; "
            "expected the same in all runs"
        )
    return replace(found, parameters={n: found.parameters[n] for n in first.parameters})


def described(parameters: Mapping[str, str]) -> str:
    """Names with units, such as "impact_speed [m s-1]"."""
    return ", ".join(f"{n} [{u}]" for n, u in parameters.items()) or "none"


def _note_missing(name: str, out: Survey) -> None:
    infos = {f.fields[name] for f in out.found if name in f.fields}
    if not infos:
        told = next((n for n in out.notes if f"has no {name}" in n or f", {name}" in n), "")
        raise DataError(f"no run has a field {name!r}; {told or 'ask for another with --fields'}")
    if len(infos) > 1:
        raise DataError(f"field {name!r} lies elsewhere or has another unit in some runs; leave it out of --fields")


def _listed(names: Sequence[str], most: int = 5) -> str:
    return f"run{'s' if len(names) > 1 else ''} {listed(names, most)}"
