"""Runs on a coarser mesh that help to predict those on a fine one: matched by part, parameter and unit, or refused."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr
    from numpy.typing import NDArray

    from crashkit.api.source import Source
    from surrogates.data.campaign import Campaign, CoarseRuns, Labels
    from surrogates.surrogate import Surrogate

# The coarse mesh lies this close to the nodes of the fine one on average, in mean edges of the coarse mesh.
_WITHIN = 0.5
# A coarse run may end earlier by this share of the duration.
_SHORTER = 0.02
# Two meshes are the same where no node differs by more than this share of the diagonal.
_SAME_PLACE = 1e-4
# Two parameters are the same within this share of the range.
_SAME = 1e-6
_SUFFIXES = (".zarr", ".nc")
# A smaller share of the fine runs within the coarse ones' range of a parameter is told.
_WITHIN_RANGE = 0.1


def check_count(given: str | Path | xr.Dataset) -> None:
    """Raise DataError where the dataset `given` has too few runs to help, before anything is searched."""
    from crashkit.api.source import source_of

    source = source_of(given)
    with source.opened() as dataset:
        _enough(source.name, int(dataset.sizes["sim"]))


def _enough(name: str, count: int, of: str = "") -> None:
    from crashkit.errors import DataError
    from surrogates.data.campaign import FEWEST_COARSE

    if count < FEWEST_COARSE:
        runs = "run" if count == 1 else "runs"
        raise DataError(f"{name}: has {count} coarse {runs}{of}; expected at least {FEWEST_COARSE}")


def coarse_runs(given: str | Path | xr.Dataset, campaign: Campaign, source: Source) -> CoarseRuns:
    """The runs of the dataset `given`, on another mesh of the structure of `campaign`.

    Runs with the parameters of a fine run that is held out for testing are left out: with them, the test would be of
    predictions that know a coarse run of each query.

    Parameters
    ----------
    source
        Where `campaign` comes from.

    Raises
    ------
    ReadError, DataError
        For parts, parameters and units that do not match, for parameters in another range altogether, for meshes that
        are not those of one structure, and for coarse runs that end earlier or are too few.
    """
    import numpy as np

    from crashkit.api.campaign import open_campaign
    from crashkit.api.source import source_of
    from crashkit.errors import DataError
    from crashkit.mesh.part_map import part_map
    from surrogates.data.campaign import CoarseRuns

    below = source_of(given)
    found = open_campaign(below)
    if found.checksum and found.checksum == campaign.checksum:
        raise DataError(f"{below.name}: is {source.name} itself; expected further runs, on a coarser mesh")
    order = _order(found, campaign, below.name)
    parameters = found.parameters[:, order]
    notes = _ranges(parameters, campaign, below.name)
    matched = _parts(found, campaign, below.name)
    points, faces, labels = _mesh(found)
    fine_points, fine_faces, fine_labels = _mesh(campaign)
    to_fine, apart = part_map(fine_points, fine_faces, fine_labels.face_part, points, faces, matched[labels.face_part])
    sides = points[faces[:, :2]]
    edge = float(np.linalg.norm(sides[:, 1] - sides[:, 0], axis=1).mean())
    if apart.mean() > _WITHIN * edge:
        raise DataError(
            f"{below.name}: nodes of {source.name} lie {1e3 * apart.mean():.3g} mm from this mesh on average, and its edges are "
            f"{1e3 * edge:.3g} mm; expected another mesh of the same structure, in the same place and unit"
        )
    begin, end = float(campaign.time[0]), float(campaign.time[-1])
    if found.time[-1] < end - _SHORTER * (end - begin):
        raise DataError(
            f"{below.name}: its runs end at {found.time[-1]:g} s, those of {source.name} at {end:g} s; compute coarse runs as long"
        )
    tested = _tested(source, campaign)
    span = np.maximum(np.ptp(parameters, axis=0), 1e-300)
    own = (np.abs((parameters[:, None] - tested[None]) / span) <= _SAME).all(axis=2).any(axis=1)
    keep = np.flatnonzero(~own)
    if not len(keep):
        raise DataError(f"{below.name}: has the parameters of the test runs alone; expected further coarse runs")
    _enough(below.name, len(keep), " without those of the test runs" if own.any() else "")
    field = found.displacement(0)
    about = {**(found.attributes or {}), "units_read": _units(below), "of_test_runs": str(int(own.sum()))}
    runs = replace(
        found,
        parameters=parameters[keep],
        parameter_names=campaign.parameter_names,
        parameter_units=campaign.parameter_units,
        displacement=lambda level: _SomeRuns(field, keep),
        runs=tuple(found.runs[k] for k in keep),
        marked={},
        attributes=about,
        levels=(),
        targets=(),
        curves=(),
    )
    return CoarseRuns(runs, to_fine, notes)


def coarse_run_states(
    given: str | Path | xr.Dataset, surrogate: Surrogate, parameters: NDArray[np.float64], level: int | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Displacements (state, coarse node, 3), m, and times (state,), s, of one coarse run, in the order of the model's coarse mesh.

    Parameters
    ----------
    given
        A folder or file of a solver, a run of a dataset (`coarse.zarr:run_012`), a dataset of one run, or one in hand.
    parameters
        (parameter,) of the run, in the model's units: those that the run itself states must be the same.
    level
        On which the prediction is wanted; it must take something from coarse runs; default: the finest.

    Raises
    ------
    ReadError, DataError
        Where it cannot be read, holds several runs or another mesh, or was computed with other parameters.
    """
    import numpy as np

    from crashkit.errors import DataError
    from surrogates.errors import SurrogateError

    try:
        surrogate.check_takes_coarse(level)
    except SurrogateError as error:
        raise DataError(str(error)) from error
    mesh = surrogate.coarse_mesh
    assert mesh is not None
    with _opened(given, str(surrogate.record.coarse.get("units", ""))) as (name, run):
        place = {int(number): k for k, number in enumerate(run["node_id"].values)}
        missing = [int(number) for number in mesh.node_id if int(number) not in place]
        if missing:
            raise DataError(
                f"{name}: has {run.sizes['node']} nodes and not node {missing[0]}; expected the coarse mesh of "
                f"{len(mesh.node_id)} nodes that the model was trained with"
            )
        rows = np.array([place[int(number)] for number in mesh.node_id])
        at = run["reference_position"].values[rows]
        apart = float(np.linalg.norm(at - mesh.position, axis=1).max())
        size = float(np.linalg.norm(np.ptp(mesh.position, axis=0)))
        if not apart <= _SAME_PLACE * size:
            raise DataError(
                f"{name}: a node lies {1e3 * apart:.3g} mm from its place in the coarse mesh the model was trained with; "
                "expected a run on that mesh, in the same units"
            )
        _check_parameters(name, run, surrogate, parameters)
        states = np.asarray(run["displacement"].values, np.float32)[:, rows]
        time = run["time"].values.astype(np.float64)
    end = float(surrogate.record.time[-1])
    if time[-1] < end - _SHORTER * (end - float(surrogate.record.time[0])):
        raise DataError(f"{name}: ends at {time[-1]:g} s; expected a run until {end:g} s")
    return _held(states, name), time


class _SomeRuns:
    """Some runs of a field (sim, state, node, 3), read one by one."""

    def __init__(self, field: object, runs: NDArray[np.int64]) -> None:
        self._field, self._runs = field, runs
        self.shape = (len(runs), *field.shape[1:])  # type: ignore[attr-defined]

    def __getitem__(self, run: int) -> NDArray[np.float32]:
        out: NDArray[np.float32] = self._field[int(self._runs[run])]  # type: ignore[index]
        return out


def _mesh(campaign: Campaign) -> tuple[NDArray[np.float64], NDArray[np.int32], Labels]:
    from crashkit.errors import DataError

    points, faces, labels = campaign.points, campaign.faces, campaign.labels
    if points is None or faces is None or labels is None:
        raise DataError("runs on two meshes are joined by their faces and parts, and one of them has none")
    return points, faces, labels


def _order(found: Campaign, campaign: Campaign, name: str) -> list[int]:
    """Places of the fine campaign's parameters among the coarse ones."""
    from crashkit.errors import DataError

    missing = [n for n in campaign.parameter_names if n not in found.parameter_names]
    if missing:
        raise DataError(
            f"{name}: has no parameter {', '.join(missing)}; it has {', '.join(found.parameter_names)}, and coarse runs need all "
            "parameters of the fine ones"
        )
    order = [found.parameter_names.index(n) for n in campaign.parameter_names]
    for k, unit in zip(order, campaign.parameter_units, strict=True):
        if found.parameter_units[k] != unit:
            raise DataError(
                f"{name}: parameter {found.parameter_names[k]} is in {found.parameter_units[k] or 'no unit'}, in the fine runs in "
                f"{unit or 'no unit'}; ingest both with units"
            )
    return order


def _ranges(parameters: NDArray[np.float64], campaign: Campaign, name: str) -> tuple[str, ...]:
    """A line for each parameter (of the coarse runs `parameters`, (run, parameter)) in whose range few fine runs lie.

    Where the structure has mirror planes, a run counts with its mirrored value, too: its image may be the one that helps.

    Raises
    ------
    DataError
        With such a line, where the ranges of coarse and fine runs do not overlap.
    """
    import numpy as np

    from crashkit.errors import DataError

    lines = []
    units = campaign.table_units or [(unit, 1.0) for unit in campaign.parameter_units]
    for k, (parameter, (unit, factor)) in enumerate(zip(campaign.parameter_names, units, strict=True)):
        fine, coarse = campaign.parameters[:, k], parameters[:, k]
        if not (np.isfinite(fine).all() and np.isfinite(coarse).all()):
            continue  # told where values are checked
        low, high = float(coarse.min()), float(coarse.max())
        slack = _SAME * max(high - low, abs(low), abs(high))
        limits = [(low - slack, high + slack), *([(-high - slack, -low + slack)] if campaign.mirrors else [])]
        if any(np.mean((a <= fine) & (fine <= b)) >= _WITHIN_RANGE for a, b in limits):
            continue
        told = [f"{some.min() / factor:.4g} to {some.max() / factor:.4g} {unit}".strip() for some in (coarse, fine)]
        line = f"{name}: {parameter} is {told[0]} in the coarse runs and {told[1]} in the fine ones; check the value and its unit"
        if not any(fine.min() <= b and a <= fine.max() for a, b in limits):
            raise DataError(line)
        lines.append(line)
    return tuple(lines)


def _parts(found: Campaign, campaign: Campaign, name: str) -> NDArray[np.int64]:
    """(coarse part,) the fine part of the same name, else of the same number; -1 for one that the fine mesh lacks."""
    import numpy as np

    from crashkit.errors import DataError

    here, there = _mesh(found)[2], _mesh(campaign)[2]
    named = _keys(here, there)
    out = np.array([there.part_name.index(n) if n in there.part_name else -1 for n in here.part_name], np.int64)
    if not named:
        ids = there.part_id.tolist()
        out = np.array([ids.index(n) if n in ids else -1 for n in here.part_id.tolist()], np.int64)
    wanted = np.unique(there.face_part)
    with_faces = {int(out[p]) for p in np.unique(here.face_part)}
    missing = [f"{there.part_name[p] or 'without a name'} ({there.part_id[p]})" for p in wanted if p not in with_faces]
    if missing:
        has = ", ".join(f"{n or 'without a name'} ({i})" for n, i in zip(here.part_name, here.part_id, strict=True))
        raise DataError(
            f"{name}: has no part {', '.join(missing)}; parts are matched by name or number, and it has {has}"
        )
    return out


def _keys(here: Labels, there: Labels) -> bool:
    """Whether parts can be matched by name: every fine part with faces has a name that no other has, and the coarse mesh has it."""
    import numpy as np

    wanted = [there.part_name[p] for p in np.unique(there.face_part)]
    return all(wanted) and len(set(wanted)) == len(wanted) and set(wanted) <= set(here.part_name)


def _tested(source: Source, campaign: Campaign) -> NDArray[np.float64]:
    """(run, parameter) of the fine runs that are held out for testing."""
    import numpy as np

    with source.opened() as dataset:
        names = [str(n) for n in dataset["sim"].values]
        rows = [names.index(n) for n in campaign.held_out]
        columns = [dataset[n].values[rows].astype(np.float64) for n in campaign.parameter_names]
    return np.stack(columns, axis=1)


def _units(source: Source) -> str:
    with source.opened() as dataset:
        return str(dataset.attrs.get("units_read", ""))


@contextlib.contextmanager
def _opened(given: str | Path | xr.Dataset, units: str) -> Iterator[tuple[str, xr.Dataset]]:
    """One run, with its name: from a solver's files, a dataset, or a run of a dataset."""
    import xarray as xr

    if isinstance(given, xr.Dataset):
        yield _the_run(given, str(given.encoding.get("source") or "the coarse run"), None)
        return
    path, wanted = _path_and_run(str(given))
    dataset = _read(path, wanted, units)
    try:
        yield _the_run(dataset, str(given), wanted)
    finally:
        dataset.close()


def _the_run(dataset: xr.Dataset, name: str, wanted: str | None) -> tuple[str, xr.Dataset]:
    from crashkit.errors import DataError
    from crashkit.selection import runs_of

    if "sim" in dataset.dims:
        runs = [str(n) for n in dataset["sim"].values]
        if wanted is None and len(runs) > 1:
            raise DataError(f"{name}: holds {len(runs)} runs; expected one, such as {name}:{runs[0]}")
        known = wanted is not None and wanted in runs
        dataset = dataset.isel(sim=runs_of(runs, [wanted])[0] if wanted is not None and (known or len(runs) > 1) else 0)
    if "complete" in dataset and not bool(dataset["complete"]):
        raise DataError(f"{name}: is incomplete or damaged; a prediction needs the whole coarse run")
    return name, dataset


def _path_and_run(text: str) -> tuple[Path, str | None]:
    """`coarse.zarr:run_012` in its two parts; anything else whole."""
    before, colon, run = text.rpartition(":")
    if colon and run and Path(before).suffix in _SUFFIXES and Path(before).exists():
        return Path(before), run
    return Path(text), None


def _require(path: Path) -> None:
    from crashkit.errors import ReadError

    if not path.exists():
        raise ReadError(
            f"{path}: no such file or folder; expected a coarse run, such as its folder or coarse.zarr:run_012"
        )


def _read(path: Path, run: str | None, units: str) -> xr.Dataset:
    from crashkit.dataset import open_dataset
    from crashkit.engine import CrashBackend

    _require(path)
    if path.suffix in _SUFFIXES:
        return open_dataset(path, chunks=None)
    opened = CrashBackend().open_dataset(path, run=run)
    if opened.attrs.get("units_read") == "not stated" and units and units != "not stated":
        opened.close()
        opened = CrashBackend().open_dataset(path, run=run, units=units)
    return opened


def _check_parameters(name: str, run: xr.Dataset, surrogate: Surrogate, parameters: NDArray[np.float64]) -> None:
    """Raise DataError where the run states another value of a parameter."""
    from crashkit.errors import DataError

    ranges = surrogate.record.ranges
    for k, parameter in enumerate(ranges.names):
        if parameter not in run or run[parameter].ndim:
            continue
        stated, (unit, factor) = float(run[parameter]), ranges.written[k]
        span = max(float(ranges.high[k] - ranges.low[k]), abs(float(ranges.high[k])) * _SAME, 1e-300)
        if abs(stated - float(parameters[k])) > 1e-3 * span:
            raise DataError(
                f"{name}: was computed with {parameter} = {stated / factor:g} {unit}, and the prediction is for "
                f"{parameters[k] / factor:g} {unit}; give the coarse run of these parameters"
            )


def _held(states: NDArray[np.float32], name: str) -> NDArray[np.float32]:
    """Nodes that are gone keep their last displacement, as in training."""
    import numpy as np

    from crashkit.errors import DataError

    bad = np.asarray(~np.isfinite(states).all(axis=2))
    if not bad.any():
        return states
    if bad[0].any():
        raise DataError(f"{name}: a node has no displacement in the first state; check the run")
    last = np.where(bad, 0, np.arange(len(states))[:, None])
    np.maximum.accumulate(last, axis=0, out=last)
    out: NDArray[np.float32] = states[last, np.arange(states.shape[1])[None]]
    return out


def check_given(given: str | Path, rows: Sequence[str] | None) -> None:
    """Refuse what cannot be a coarse run, or with `rows` cannot hold one of each name, before anything is read.

    Raises
    ------
    ReadError, DataError
        Where there is nothing, a single run is given for several rows, or a row has none.
    """
    from crashkit.dataset import opened_dataset
    from crashkit.errors import DataError

    path, run = _path_and_run(str(given))
    if rows is not None and run is not None:
        raise DataError(
            f"{given}: names one coarse run, and a table asks for several; give the dataset, {path}, in which each row has a "
            f"run of its name, or ask for {run} alone with --param instead of --params"
        )
    _require(path)
    if rows is None:
        return
    has = {entry.name for entry in path.iterdir()} if path.is_dir() else set()
    if path.suffix in _SUFFIXES:
        with opened_dataset(path) as dataset:
            has = {str(n) for n in dataset["sim"].values}
    missing = [name for name in rows if name not in has]
    if missing:
        more = f", nor {len(missing) - 1} more of the table's" if missing[1:] else ""
        some = ", ".join(sorted(has)[:3]) + (", ..." if len(has) > 3 else "")
        raise DataError(
            f"{given}: has no run {missing[0]}{more}; expected a coarse run for each row, of the row's name; it has {some or 'none'}"
        )


def own_parameters(given: str | Path, names: Sequence[str]) -> dict[str, float]:
    """What a run of a dataset says of its own parameters, by name, in SI.

    Raises
    ------
    DataError
        Where several runs could be meant, and for files of a solver, which do not say.
    """
    from crashkit.dataset import opened_dataset
    from crashkit.errors import DataError
    from crashkit.selection import runs_of

    path, run = _path_and_run(str(given))
    if path.suffix not in _SUFFIXES:
        raise DataError(f"{given}: a solver's files do not say with which parameters; give them with --param")
    with opened_dataset(path) as dataset:
        runs = [str(n) for n in dataset["sim"].values]
        if run is None and len(runs) > 1:
            raise DataError(f"{given}: holds {len(runs)} runs; name one, such as {given}:{runs[0]}")
        place = 0 if run is None else runs_of(runs, [run])[0]
        return {n: float(dataset[n].values[place]) for n in names if n in dataset}
