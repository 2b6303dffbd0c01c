"""From staged runs, and those of an older dataset, to the whole dataset: everything that is small, and who has what."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from crashkit.errors import OutputError, ReadError
from crashkit.ingestion import store
from crashkit.ingestion.alignment import same_time
from crashkit.ingestion.curves import CURVES, Curves, curves_of, read_curves, with_curves
from crashkit.ingestion.staging import BackgroundHashes, StagedRun, Staging
from crashkit.ingestion.store import ArraySpec, RunSource
from crashkit.ingestion.structure import Structure
from crashkit.ingestion.survey import Found
from crashkit.ingestion.transfer import Layout
from crashkit.quality import MEASURES, Quality
from crashkit.readers.base import Part
from crashkit.version import __version__
from data_schema import CONVENTIONS, VARIABLES, dataset_checksum, digests_of_run, parameters, run_checksum, validate
from data_schema import fields as fields_of
from data_schema.replace import put_in_place, remove

if TYPE_CHECKING:
    import xarray as xr

# Variables that chunks are moved for; everything else is small and written anew.
_SMALL = ("alignment_error", "complete", "run_checksum", "source_time", "quality_note", *MEASURES, *CURVES)


@dataclass(frozen=True)
class Existing:
    """The dataset that runs are added to. `small` holds its variables on `sim` alone, and its attributes."""

    path: Path
    small: xr.Dataset
    names: tuple[str, ...]
    time: NDArray[np.float64]
    structure: Structure
    parameters: Mapping[str, str]
    fields: tuple[str, ...]
    arrays: frozenset[str]
    one_shape: bool
    has_hierarchy: bool

    @classmethod
    def open(cls, path: Path) -> Existing | None:
        """The dataset at `path`, None if nothing is there.

        Raises
        ------
        OutputError
            If it is something else.
        """
        if not path.exists():
            return None
        from crashkit.dataset import open_dataset
        from crashkit.mesh.store import has_hierarchy

        try:
            dataset = open_dataset(path, chunks=None)
        except ReadError as error:
            raise OutputError(f"{error}; choose another name for the output") from error
        with dataset:
            problems = validate(dataset, values=False)
            if problems:
                raise OutputError(f"{path}: exists and is no crash dataset ({problems[0]}); choose another name")
            names = tuple(map(str, dataset["sim"].values))
            position = dataset["reference_position"]
            one_shape = "sim" not in position.dims
            small = dataset[[n for n in (*_SMALL, *parameters(dataset)) if n in dataset]].load()
            if "run_checksum" not in small:
                checksums = [run_checksum(digests_of_run(dataset, k)) for k in range(len(names))]
                small["run_checksum"] = ("sim", np.array(checksums, dtype="U64"))
            return cls(
                path=path,
                small=small,
                names=names,
                time=np.asarray(dataset["time"].values, np.float64),
                structure=_structure_in(dataset, (position if one_shape else position.isel(sim=0)).values),
                parameters={n: str(dataset[n].attrs["units"]) for n in parameters(dataset)},
                fields=tuple(fields_of(dataset)),
                arrays=frozenset(str(n) for n in dataset.data_vars),
                one_shape=one_shape,
                has_hierarchy=has_hierarchy(path),
            )

    def difference(self, found: Found, hashes: BackgroundHashes) -> str | None:
        """In what a run given again differs from the one in the dataset; None if it is the same."""
        recorded = {e["file"]: e for e in self.files() if e["run"] == found.name}
        for file in found.files:
            entry = recorded.pop(file.name, None)
            if entry is None or entry["bytes"] != file.stat().st_size or entry["sha256"] != hashes.result(file)[1]:
                return f"read from another {file.name}"
        if recorded:
            return f"read from {next(iter(recorded))} as well"
        place = self.names.index(found.name)
        for name, (value, unit) in found.parameters.items():
            before = float(self.small[name].values[place])
            if before != value:
                return f"with {name} {before:g} {unit}, here it is {value:g}"
        return None

    def files(self) -> list[dict[str, Any]]:
        """The recorded source files: run, file, bytes, sha256."""
        return list(json.loads(self.small.attrs["source_files"]))


def publish(
    staging: Staging,
    layout: Layout,
    fresh: Sequence[Found],
    staged: Mapping[str, StagedRun],
    old: Existing | None,
    hashes: BackgroundHashes,
    marked: Mapping[str, str],
) -> tuple[str, ...]:
    """Put the dataset together in the staging folder, then in its place; returns the names of its runs, in order.

    `marked` says of new runs what is beyond its limit.

    Runs of `old` that are not among `fresh` are kept, unread where the output is a Zarr folder.
    """
    new = {f.name: f for f in fresh}
    before = {name: k for k, name in enumerate(old.names)} if old is not None else {}
    names = (*before, *(f.name for f in fresh if f.name not in before))
    kept = [n for n in before if n not in new]

    def has(name: str) -> bool:
        return any(name in run.digests for run in staged.values()) or bool(kept and old and name in old.arrays)

    specs = layout.specs(alive=has("alive"), cell_alive=has("cell_alive"))
    kept_in = _kept_store(staging, old, specs) if old is not None and kept else Path()
    runs = [RunSource(staging.place(staged[n].key), 0) if n in new else RunSource(kept_in, before[n]) for n in names]
    small = _small(layout, names, new, staged, old, runs, hashes, marked)
    write = store.write_netcdf if staging.output.suffix == ".nc" else store.write_zarr
    remove(staging.whole)
    write(staging.whole, small, specs, runs)
    put_in_place(staging.whole, staging.output, durable=True)
    return names


def _kept_store(staging: Staging, old: Existing, specs: Sequence[ArraySpec]) -> Path:
    """A Zarr store with the old runs' chunks: the dataset itself where its layout is still ours, else a copy."""
    from crashkit.dataset import open_dataset

    if old.path.is_dir() and store.same_layout(old.path, specs):
        return old.path
    copy = staging.folder / "whole-before.zarr"
    remove(copy)
    with open_dataset(old.path, chunks=None) as dataset:
        store.zarr_from(dataset, specs, copy)
    return copy


def _small(
    layout: Layout,
    names: Sequence[str],
    new: Mapping[str, Found],
    staged: Mapping[str, StagedRun],
    old: Existing | None,
    runs: Sequence[RunSource],
    hashes: BackgroundHashes,
    marked: Mapping[str, str],
) -> xr.Dataset:
    """Coordinates, mesh, parameters and attributes: everything but the results."""
    import xarray as xr

    s, fresh = layout.structure, next(iter(new.values()))
    places = dict(zip(names, (r.store for r in runs), strict=True))
    rows = [
        _OfRun.kept(old, n)
        if old is not None and n not in new
        else _OfRun.new(new[n], staged[n], layout.time, read_curves(places[n]), marked.get(n, ""))
        for n in names
    ]
    ds = xr.Dataset(
        {
            "mesh": ((), np.int32(0), _UGRID),
            "node_id": ("node", s.node_id, {"long_name": "the solver's node number"}),
            "face_nodes": (("face", "corner"), s.face_nodes, {"cf_role": "face_node_connectivity", "start_index": 0}),
            "face_part": ("face", s.face_part, {"long_name": "place of the part in part_id"}),
            "face_id": ("face", s.face_id, {"long_name": "the solver's element number"}),
            "part_id": ("part", np.array([p.id for p in s.parts], np.int64)),
            "part_name": ("part", np.array([p.name for p in s.parts], dtype=str)),
            "complete": ("sim", np.array([r.complete for r in rows], bool)),
            "alignment_error": (
                "sim",
                np.array([r.alignment_error for r in rows], np.float64),
                {"units": "m", "long_name": "estimated largest error of the change to the common time"},
            ),
            "run_checksum": ("sim", np.array([r.checksum for r in rows], dtype=str)),
        },
        coords={
            "sim": np.array(names, dtype=str),
            "time": ("time", layout.time, {"units": "s", "long_name": "time"}),
            **{
                f"node_{axis}": ("node", s.position[:, k].copy(), {"units": "m", "long_name": f"undeformed {axis}"})
                for k, axis in enumerate("xyz")
            },
        },
    )
    if layout.one_shape:
        attributes = {"units": "m", "long_name": "undeformed position"}
        ds["reference_position"] = (("node", "xyz"), s.position, attributes)
    if len(s.cell_nodes):
        ds["cell_nodes"] = (("cell", "cell_corner"), s.cell_nodes, {"start_index": 0})
        ds["cell_type"] = ("cell", s.cell_type, {"long_name": "VTK cell type"})
        ds["cell_part"] = ("cell", s.cell_part, {"long_name": "place of the part in part_id"})
        ds["cell_id"] = ("cell", s.cell_id, {"long_name": "the solver's element number"})
    if any(r.source_time is not None for r in rows):
        ds["source_time"] = (("sim", "source_state"), _padded(rows, layout.time), {"units": "s"})
    ds = with_curves(ds, [r.curves for r in rows])
    for name in MEASURES:
        measured = np.array([r.quality.get(name, np.nan) for r in rows], np.float64)
        if np.isfinite(measured).any():
            ds[name] = ("sim", measured, {"units": VARIABLES[name].unit, "long_name": MEASURES[name]})
    if any(r.quality or r.quality_note for r in rows):
        ds["quality_note"] = ("sim", np.array([r.quality_note for r in rows], dtype=str))
    units = old.parameters if old is not None else {n: u for n, (_, u) in fresh.parameters.items()}
    for name, unit in units.items():
        values = np.array([r.parameters[name] for r in rows], np.float64)
        written = (
            str(old.small[name].attrs.get("table_units", "")) if old is not None else fresh.as_written.get(name, "")
        )
        ds[name] = (
            "sim",
            values,
            {"units": unit, "role": "parameter", **({"table_units": written} if written else {})},
        )
    files = [e for e in old.files() if e["run"] in names and e["run"] not in new] if old is not None else []
    for found in new.values():
        for file in found.files:
            size, sha256 = hashes.result(file)
            files.append({"run": found.name, "file": file.name, "bytes": size, "sha256": sha256})
    past = old.small.attrs if old is not None else {}
    ds.attrs = {
        "Conventions": CONVENTIONS,
        "title": f"{len(names)} crash runs",
        "solver": _joined(past.get("solver"), *(f.solver for f in new.values())),
        "source_files": json.dumps(files),
        "units_read": _joined(past.get("units_read"), *(f.units for f in new.values())),
        "units_written": "SI",
        "parameters": json.dumps(list(units)),
        "crashkit_version": __version__,
        "history": "\n".join(filter(None, [past.get("history"), _history(tuple(new.values()), layout)])),
    }
    positions = None if layout.one_shape else lambda k: store.read_array(runs[k], "reference_position")
    ds.attrs["checksum"] = dataset_checksum(ds, [r.checksum for r in rows], positions)
    return ds


@dataclass(frozen=True)
class _OfRun:
    """What the small variables say of one run; `source_time` (state,) s only where it was brought to other times."""

    complete: bool
    alignment_error: float
    checksum: str
    parameters: Mapping[str, float]
    source_time: NDArray[np.float64] | None
    curves: Curves | None
    quality: Mapping[str, float]
    quality_note: str

    @classmethod
    def new(
        cls, found: Found, staged: StagedRun, time: NDArray[np.float64], curves: Curves | None, quality_note: str
    ) -> _OfRun:
        own = None if same_time(found.time, time) else found.time
        values = {n: v for n, (v, _) in found.parameters.items()}
        quality = Quality(**staged.quality).values
        checksum = run_checksum(staged.digests)
        return cls(found.complete, staged.error, checksum, values, own, curves, quality, quality_note)

    @classmethod
    def kept(cls, old: Existing, name: str) -> _OfRun:
        of = old.small.isel(sim=old.names.index(name))
        own = of["source_time"].values if "source_time" in of else np.full(1, np.nan)
        own = own[np.isfinite(own)]
        return cls(
            complete=bool(of["complete"]) if "complete" in of else True,
            alignment_error=float(of["alignment_error"]) if "alignment_error" in of else 0.0,
            checksum=str(of["run_checksum"].values),
            parameters={n: float(of[n]) for n in old.parameters},
            source_time=None if len(own) == 0 or same_time(own, old.time) else own,
            curves=curves_of(of),
            quality={n: float(of[n]) for n in MEASURES if n in of and np.isfinite(of[n])},
            quality_note=str(of["quality_note"].values) if "quality_note" in of else "",
        )


def _padded(rows: Sequence[_OfRun], time: NDArray[np.float64]) -> NDArray[np.float64]:
    """(sim, source_state) own times, the common ones where they are the same; NaN behind the last."""
    own = [time if r.source_time is None else r.source_time for r in rows]
    out = np.full((len(own), max(map(len, own))), np.nan)
    for row, times in zip(out, own, strict=True):
        row[: len(times)] = times
    return out


def _joined(past: Any, *values: str) -> str:
    """Different values once each, with commas, those of the past first."""
    before = str(past).split(", ") if past else []
    return ", ".join(dict.fromkeys([*before, *values]))


def _history(new: Sequence[Found], layout: Layout) -> str:
    """What this ingest did. Without a date: the same runs give the same bytes, and a file has a date of its own."""
    sources = ", ".join(dict.fromkeys(f.source.resolve().name for f in new))
    choice = layout.choice
    options = [
        f"{name} {', '.join(values)}"
        for name, values in (
            ("parts", choice.parts),
            ("without parts", choice.exclude_parts),
            ("fields", choice.fields),
        )
        if values
    ]
    options += ["with rigid walls"] if choice.keep_rigid_walls else []
    options += ["incomplete runs allowed"] if choice.allow_incomplete else []
    told = f" ({'; '.join(options)})" if options else ""
    return f"crashkit {__version__} ingest: {len(new)} runs from {sources}{told}"


def _structure_in(dataset: xr.Dataset, position: NDArray[np.float64]) -> Structure:
    """The structure of a dataset, as the one that new runs are brought to."""

    def values(name: str, otherwise: NDArray[Any]) -> NDArray[Any]:
        return dataset[name].values if name in dataset else otherwise

    faces = dataset["face_nodes"].values
    cells = values("cell_nodes", np.empty((0, 0), np.int32))
    names = zip(dataset["part_id"].values, dataset["part_name"].values, strict=True)
    return Structure(
        node=np.arange(dataset.sizes["node"]),
        node_id=dataset["node_id"].values,
        position=np.asarray(position, np.float64),
        face_nodes=faces,
        face_part=dataset["face_part"].values,
        face_id=values("face_id", np.arange(1, len(faces) + 1)),
        face_source=np.arange(len(faces)),
        cell_nodes=cells,
        cell_type=values("cell_type", np.empty(0, np.uint8)),
        cell_part=values("cell_part", np.empty(0, np.int32)),
        cell_id=values("cell_id", np.empty(0, np.int64)),
        cell_source=np.arange(len(cells)),
        parts=tuple(Part(int(number), str(name)) for number, name in names),
        notes=(),
    )


_UGRID = {
    "cf_role": "mesh_topology",
    "topology_dimension": 2,
    "node_coordinates": "node_x node_y node_z",
    "face_node_connectivity": "face_nodes",
    "face_dimension": "face",
}
