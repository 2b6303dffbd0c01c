"""From a dataset to what a surrogate is trained on: the training runs as arrays, the test runs left out."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

_log = logging.getLogger(__name__)

# Steps between samples that differ by more than this share of their mean are uneven.
_EVEN = 0.02
# Bytes of a level's displacements up to which they are read at once.
_AT_ONCE = 128 << 20

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr
    from numpy.typing import NDArray

    from crashkit.api.source import Source
    from crashkit.selection import WhichRuns
    from data_schema.mirror import MirrorPlane
    from surrogates.data.campaign import Campaign, Labels


class RunField:
    """Displacements (sim, state, node, 3) of chosen runs, m; a run is read when it is asked for."""

    def __init__(self, source: Source, runs: Sequence[int], shape: tuple[int, int]) -> None:
        self._source = source
        self._runs = list(runs)
        self.shape = (len(self._runs), *shape, 3)

    def __getitem__(self, run: int) -> NDArray[np.float32]:
        from crashkit.dataset import reading_dataset

        with self._source.opened() as dataset, reading_dataset(self._source.name):
            values: NDArray[np.float32] = dataset["displacement"].isel(sim=self._runs[run]).values
        return values


class LevelField:
    """Displacements (sim, state, node of a level, 3) of chosen runs, m, from the dataset's stored hierarchy, run by run."""

    def __init__(self, path: Path, level: int, runs: Sequence[int], shape: tuple[int, int]) -> None:
        self._path, self._level, self._runs = path, level, list(runs)
        self.shape = (len(self._runs), *shape, 3)

    def __getitem__(self, run: int) -> NDArray[np.float32]:
        from crashkit.mesh.store import level_displacement

        values: NDArray[np.float32] = level_displacement(self._path, self._level, [self._runs[run]])[0]
        return values


class ElementValues:
    """A variable on the faces (sim, state, face) of chosen runs; a run is read when it is asked for."""

    def __init__(self, source: Source, name: str, runs: Sequence[int], shape: tuple[int, int]) -> None:
        self._source, self._variable, self._runs = source, name, list(runs)
        self.shape = (len(self._runs), *shape)

    def __getitem__(self, run: int) -> NDArray[Any]:
        from crashkit.dataset import reading_dataset

        with self._source.opened() as dataset, reading_dataset(self._source.name):
            values: NDArray[Any] = dataset[self._variable].isel(sim=self._runs[run]).values
        return values


def open_campaign(
    source: Source, test: WhichRuns | None = None, *, symmetry: bool = False, odd: Sequence[str] = ()
) -> Campaign:
    """The runs of a dataset without the test runs, as `crashkit.selection.runs_of` understands `test`.

    symmetry  look for mirror planes of the mesh, where a parameter could say on which side something happens: one with
              values on both sides of zero, or one of those declared `odd`

    The full field is read run by run by those models that need it; the cascade reads its levels only.

    Raises
    ------
    ReadError, DataError
        Where the dataset cannot be opened, or `test` names no runs, or all.
    """
    import numpy as np

    from crashkit.dataset import reading_dataset
    from crashkit.errors import DataError
    from crashkit.mesh.store import level_displacement
    from crashkit.selection import runs_of
    from data_schema import fields, parameters, table_unit
    from data_schema.dimensions import dimension
    from surrogates.data.campaign import Campaign, CurveTarget, ElementTarget
    from surrogates.physics.symmetry import check_odd

    with source.opened() as opened, reading_dataset(source.name):
        on_faces = [
            (n, str(opened[n].attrs.get("units", "")))
            for n in fields(opened)
            if opened[n].dims == ("sim", "time", "face")
        ]
        loses_faces = "alive" in opened
        erodes = "alive" in opened or "cell_alive" in opened
        unread = [n for n in ("displacement", "alive", "cell_alive", "history") if n in opened]
        dataset = opened.drop_vars([*unread, *fields(opened)]).load()
        states, nodes = opened.sizes["time"], opened.sizes["node"]
        curve_time, channels = histories(opened)
    runs = [str(n) for n in dataset["sim"].values]
    held_out = [] if test is None else runs_of(runs, test)
    chosen = [k for k in range(len(runs)) if k not in set(held_out)]
    if not chosen:
        raise DataError(f"{source.name}: all {len(runs)} runs would be test runs; leave some for training")
    names = parameters(dataset)
    if not names:
        raise DataError(f"{source.name}: no run has a parameter; give them with crashkit ingest --params")
    at = dataset["reference_position"]
    levels = () if source.hierarchy is None else source.hierarchy.levels
    field = RunField(source, chosen, (states, nodes))

    def displacement(level: int) -> Any:
        if level == 0:
            return field
        if source.stored and source.path is not None:
            shape = (states, levels[level - 1].n_nodes)
            if 12 * len(chosen) * states * shape[1] > _AT_ONCE:
                return LevelField(source.path, level, chosen, shape)
            return level_displacement(source.path, level, chosen)
        kept = levels[level - 1].kept
        return np.stack([field[run][:, kept] for run in range(len(chosen))])

    marks = [str(note) for note in dataset["quality_note"].values] if "quality_note" in dataset else [""] * len(runs)
    per_element = (states, dataset.sizes["face"])
    values = np.stack([dataset[n].values[chosen].astype(np.float64) for n in names], axis=1)
    check_odd(odd, names, values, [table_unit(dataset, n) for n in names])
    two_sided = bool(((values.min(axis=0) < 0) & (values.max(axis=0) > 0)).any())
    return Campaign(
        parameters=values,
        parameter_names=tuple(names),
        parameter_units=tuple(str(dataset[n].attrs.get("units", "")) for n in names),
        time=dataset["time"].values.astype(np.float64),
        displacement=displacement,
        n_nodes=nodes,
        levels=levels,
        full_edges=dataset.crash.edges(),
        runs=tuple(runs[k] for k in chosen),
        checksum=str(dataset.attrs.get("checksum", "")),
        attributes={"dataset": Path(source.name).name, "solver": str(dataset.attrs.get("solver", ""))},
        held_out=tuple(runs[k] for k in held_out),
        erodes=erodes,
        marked={runs[k]: note for k in chosen if (note := marks[k])},
        alive=ElementValues(source, "alive", chosen, per_element) if loses_faces else None,
        targets=tuple(
            ElementTarget(name, unit, ElementValues(source, name, chosen, per_element)) for name, unit in on_faces
        ),
        curves=tuple(CurveTarget(n, u, values[chosen]) for n, u, values in channels),
        curve_time=curve_time,
        points=np.asarray((at.isel(sim=0) if "sim" in at.dims else at).values, np.float64),
        faces=dataset["face_nodes"].values.astype(np.int32),
        labels=labels_of(dataset),
        table_units=tuple(table_unit(dataset, n) for n in names),
        dimensions=tuple(dimension(str(dataset[n].attrs.get("units", ""))) for n in names),
        mirrors=_mirrors(dataset) if symmetry and (two_sided or odd) else (),
    )


def histories(dataset: xr.Dataset) -> tuple[NDArray[np.float64] | None, list[tuple[str, str, NDArray[np.float64]]]]:
    """Times (sample,), s, that runs share, and of each channel its name, unit and values (sim, sample); NaN behind a run's end.

    Runs that were sampled at other times are interpolated. Solvers write a sample at the end of the time step in which it is
    due; where that makes the samples uneven, they are brought to even times, which filters need.
    """
    import numpy as np

    if "history" not in dataset:
        return None, []
    values = dataset["history"].transpose("sim", "sample", "channel").values.astype(np.float64)
    times = dataset["history_time"].values.astype(np.float64)
    ends = np.nanmax(times, axis=1)
    longest = times[int(np.argmax(np.isfinite(times).sum(axis=1)))]
    time = longest[np.isfinite(longest)]
    time = time[time <= float(np.median(ends)) * (1 + 1e-6)]
    if len(time) > 2 and np.ptp(np.diff(time)) > _EVEN * np.diff(time).mean():
        time = np.linspace(time[0], time[-1], len(time))
    out = np.full((len(values), len(time), values.shape[2]), np.nan)
    # The last samples of runs of one length differ by less than a time step.
    slack = np.diff(time).max() if len(time) > 1 else 0.0
    for run, (mine, curves) in enumerate(zip(times, values, strict=True)):
        there = np.isfinite(mine)
        for k in range(values.shape[2]):
            known = there & np.isfinite(curves[:, k])
            if known.any():
                out[run, :, k] = np.interp(time, mine[known], curves[known, k])
                out[run, time > mine[known].max() + slack, k] = np.nan
    names = [str(n) for n in dataset["channel"].values]
    units = [str(u) for u in dataset["channel_unit"].values] if "channel_unit" in dataset else [""] * len(names)
    return time, [(n, u, out[:, :, k]) for k, (n, u) in enumerate(zip(names, units, strict=True))]


def labels_of(dataset: xr.Dataset) -> Labels:
    """The solver's numbers and names on the mesh of `dataset`."""
    from surrogates.data.campaign import Labels

    ids = {n: dataset[n].values.astype("int64") for n in ("node_id", "face_part", "part_id")}
    face_id = dataset["face_id"].values.astype("int64") if "face_id" in dataset.variables else None
    return Labels(**ids, part_name=tuple(map(str, dataset["part_name"].values)), face_id=face_id)


def _mirrors(dataset: Any) -> tuple[MirrorPlane, ...]:
    """The mirror planes of the dataset's mesh, without those of a mesh that differs from run to run."""
    from crashkit.errors import MeshError
    from crashkit.mesh.symmetry import mirror_planes

    at = dataset["reference_position"]
    if "sim" in at.dims and float((at.max("sim") - at.min("sim")).max()) > 1e-9:
        return ()
    at = at.isel(sim=0) if "sim" in at.dims else at
    _log.info("mirror planes of the mesh")
    part = dataset["face_part"].values if "face_part" in dataset else None
    try:
        return tuple(mirror_planes(at.values, dataset["face_nodes"].values, part))
    except MeshError:
        return ()
