"""The rules of a crash dataset, each a small function that yields what it finds broken."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from data_schema.checksum import (
    array_digest,
    block_digest,
    dataset_checksum,
    result_blocks,
    results,
    run_checksum,
)
from data_schema.layout import ATTRIBUTES, CONVENTIONS, VARIABLES, fields, parameters

if TYPE_CHECKING:
    import xarray as xr

# A displacement of the first state below this many metres is rounding of single precision positions.
FIRST_STATE_TOLERANCE = 1e-5


@dataclass(frozen=True)
class Violation:
    """One broken rule: where it is, what was found, what was expected."""

    where: str
    found: str
    expected: str

    def __str__(self) -> str:
        return f"{self.where}: found {self.found}, expected {self.expected}"


def validate(dataset: xr.Dataset, *, values: bool = True) -> list[Violation]:
    """Every violation of the crash dataset layout; an empty list means the dataset is good.

    Values are looked at where the layout is right, and results where the mesh is.

    `values=False` looks at names, dimensions, types, units and attributes only and reads no displacement.
    With values, results are read once, a block of nodes of one run at a time, so memory stays small; the checksums
    written at ingest are taken again on the way.
    """
    structural = [v for rule in _STRUCTURE for v in rule(dataset)]
    if structural or not values:
        return structural
    found = [v for rule in _VALUES for v in rule(dataset)]
    # Which nodes are gone is told by the faces: without good ones the results cannot be judged.
    return found + ([] if any(_indices(dataset)) else list(_results(dataset)))


def _variables(dataset: xr.Dataset) -> Iterator[Violation]:
    for spec in VARIABLES.values():
        if spec.name not in dataset.variables:
            if spec.required:
                yield Violation(spec.name, "nothing", f"a variable on {_dims(spec.dims[0])}: {spec.meaning}")
            continue
        variable = dataset[spec.name]
        if variable.dims not in spec.dims:
            yield Violation(spec.name, f"dimensions {_dims(variable.dims)}", " or ".join(map(_dims, spec.dims)))
        kind = variable.dtype.kind
        if not (kind == spec.kind or (spec.kind == "i" and kind == "u") or (spec.kind == "U" and kind in "OT")):
            yield Violation(spec.name, f"type {variable.dtype}", f"numpy kind {spec.kind!r}")
        unit = variable.attrs.get("units", "")
        if spec.unit not in ("", "1") and unit != spec.unit:
            yield Violation(spec.name, f"units {unit!r}", repr(spec.unit))


def _sizes(dataset: xr.Dataset) -> Iterator[Violation]:
    for name, size in (("xyz", 3),):
        if name in dataset.sizes and dataset.sizes[name] != size:
            yield Violation(f"dimension {name}", str(dataset.sizes[name]), str(size))
    if "corner" in dataset.sizes and dataset.sizes["corner"] not in (3, 4):
        yield Violation("dimension corner", str(dataset.sizes["corner"]), "3 or 4")
    for name in ("sim", "time", "node"):
        if dataset.sizes.get(name) == 0:
            yield Violation(f"dimension {name}", "0", "at least 1")
    if dataset.sizes.get("face") == 0 and not dataset.sizes.get("cell"):
        yield Violation("dimension face", "0", "at least 1, or solids and beams")


def _attributes(dataset: xr.Dataset) -> Iterator[Violation]:
    for attribute in ATTRIBUTES.values():
        if attribute.required and not dataset.attrs.get(attribute.name):
            yield Violation(f"attribute {attribute.name}", "nothing", attribute.meaning)
    if dataset.attrs.get("Conventions", CONVENTIONS) != CONVENTIONS:
        yield Violation("attribute Conventions", repr(dataset.attrs["Conventions"]), repr(CONVENTIONS))
    files = dataset.attrs.get("source_files")
    if files:
        try:
            entries = json.loads(files)
            good = all({"run", "file", "bytes", "sha256"} <= entry.keys() for entry in entries)
        except (TypeError, ValueError, AttributeError):
            good = False
        if not good:
            yield Violation("attribute source_files", "something else", ATTRIBUTES["source_files"].meaning)


def _roles(dataset: xr.Dataset) -> Iterator[Violation]:
    for name in parameters(dataset):
        if dataset[name].dims != ("sim",):
            yield Violation(name, f"a parameter on {_dims(dataset[name].dims)}", "dimensions (sim)")
        if not dataset[name].attrs.get("units"):
            yield Violation(name, "no units", "a unit, or 1 for a plain number")
    for name in fields(dataset):
        dims = dataset[name].dims
        if len(dims) < 3 or dims[:2] != ("sim", "time") or dims[2] not in ("node", "face", "cell"):
            yield Violation(name, f"a field on {_dims(dims)}", "(sim, time, node | face | cell [, ...])")
        if not dataset[name].attrs.get("units"):
            yield Violation(name, "no units", "a unit, or 1 for a plain number")


def _time(dataset: xr.Dataset) -> Iterator[Violation]:
    time = dataset["time"].values
    if not np.isfinite(time).all():
        yield Violation("time", "values that are not finite", "finite times")
    elif (np.diff(time) <= 0).any():
        k = int(np.argmax(np.diff(time) <= 0))
        yield Violation(f"time, state {k + 1}", f"{time[k + 1]:g} s after {time[k]:g} s", "strictly increasing times")


def _unique(dataset: xr.Dataset) -> Iterator[Violation]:
    for name in ("sim", "node_id", "part_id", *(["channel"] if "channel" in dataset.variables else [])):
        values, counts = np.unique(dataset[name].values, return_counts=True)
        if (counts > 1).any():
            yield Violation(name, f"{values[counts > 1][0]} {counts.max()} times", "each value once")


def _indices(dataset: xr.Dataset) -> Iterator[Violation]:
    bounds = {"face_nodes": "node", "face_part": "part", "cell_nodes": "node", "cell_part": "part"}
    for name, into in bounds.items():
        if name not in dataset.variables:
            continue
        values, lowest = dataset[name].values, -1 if name.endswith("_nodes") else 0
        if values.size and (values.min() < lowest or values.max() >= dataset.sizes[into]):
            yield Violation(
                name, f"numbers {values.min()} to {values.max()}", f"{lowest} to {dataset.sizes[into] - 1} ({into})"
            )
    corners = dataset["face_nodes"].values
    if (corners[:, :3] < 0).any():
        row = int(np.argmax((corners[:, :3] < 0).any(axis=1)))
        yield Violation(f"face_nodes, face {row}", str(corners[row].tolist()), "at least three nodes")


def _reference(dataset: xr.Dataset) -> Iterator[Violation]:
    if not np.isfinite(dataset["reference_position"].values).all():
        yield Violation("reference_position", "values that are not finite", "finite positions")


def _parameter_values(dataset: xr.Dataset) -> Iterator[Violation]:
    for name in parameters(dataset):
        bad = ~np.isfinite(dataset[name].values)
        if bad.any():
            yield Violation(f"{name}, run {dataset['sim'].values[bad][0]}", "a value that is not finite", "a number")


def _completeness(dataset: xr.Dataset) -> Iterator[Violation]:
    if "complete" in dataset:
        for run in dataset["sim"].values[~dataset["complete"].values]:
            yield Violation(f"run {run}", "an incomplete run", "every state up to the end time")


def _results(dataset: xr.Dataset) -> Iterator[Violation]:
    """Values of every run and, where they were recorded, the checksums of what was written."""
    recorded = dataset["run_checksum"].values if "run_checksum" in dataset else None
    for k, run in enumerate(dataset["sim"].values):
        digests = {}
        for name in results(dataset):
            found = []
            checks = _DisplacementChecks(dataset, k) if name == "displacement" else None
            for first, _, block in result_blocks(dataset[name].isel(sim=k)):
                found.append(block_digest(block))
                if checks:
                    checks.look_at(first, block)
            digest = array_digest(found)
            if digest is not None:
                digests[name] = digest
            if checks:
                yield from checks.violations(f"displacement, run {run}")
        if recorded is not None and str(recorded[k]) != run_checksum(digests):
            yield Violation(
                f"results, run {run}",
                f"content with SHA-256 {run_checksum(digests)[:12]}...",
                f"{str(recorded[k])[:12]}... as it was written: the file is damaged, or its values were changed",
            )
    whole = dataset.attrs.get("checksum")
    written = {entry["run"] for entry in json.loads(dataset.attrs["source_files"])}
    is_whole = written == set(map(str, dataset["sim"].values))  # and not some runs of a larger dataset
    if recorded is not None and whole and is_whole and dataset_checksum(dataset, map(str, recorded)) != whole:
        yield Violation(
            "attribute checksum", f"{str(whole)[:12]}...", "the SHA-256 of mesh, times, parameters and runs as they are"
        )


class _DisplacementChecks:
    """What must hold for the displacement of one run, gathered over blocks (time, nodes of the block, 3)."""

    def __init__(self, dataset: xr.Dataset, sim: int) -> None:
        self._gone = _gone(dataset, sim, (dataset.sizes["time"], dataset.sizes["node"]))
        self._first_bad: tuple[int, int] | None = None
        self._first_undead: tuple[int, int] | None = None
        self._start = 0.0
        self._moves = dataset.sizes["time"] == 1

    def look_at(self, first: int, block: NDArray[Any]) -> None:
        bad = ~np.isfinite(block).all(axis=-1)
        gone = self._gone[:, first : first + block.shape[1]]
        self._first_bad = _first(bad & ~gone, first, self._first_bad)
        self._first_undead = _first(~bad & gone, first, self._first_undead)
        self._start = max(self._start, float(np.abs(block[0][~bad[0]]).max(initial=0.0)))
        self._moves = self._moves or bool(((block != 0) & ~bad[..., None]).any())

    def violations(self, where: str) -> Iterator[Violation]:
        if self._first_bad:
            state, node = self._first_bad
            yield Violation(f"{where}, state {state}, node {node}", "a value that is not finite", "a number")
        if self._first_undead:
            state, node = self._first_undead
            yield Violation(f"{where}, state {state}, node {node}", "a number", "NaN: all its elements are gone")
        if self._start > FIRST_STATE_TOLERANCE:
            yield Violation(f"{where}, first state", f"up to {self._start:.3g} m", "zero: it is the reference")
        if not self._moves:
            yield Violation(where, "zero everywhere in every state", "a structure that moves")


def _first(wrong: NDArray[np.bool_], offset: int, known: tuple[int, int] | None) -> tuple[int, int] | None:
    """Place (state, node) of the first True, or the one known before."""
    if known is not None or not wrong.any():
        return known
    state, node = np.argwhere(wrong)[0]
    return int(state), int(node) + offset


def _gone(dataset: xr.Dataset, sim: int, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """(time, node) bool: nodes that had elements once and have no living one now."""
    gone = np.zeros(shape, bool)
    kinds = [
        (dataset[nodes].values, dataset[alive].isel(sim=sim).values if alive in dataset else None)
        for nodes, alive in (("face_nodes", "alive"), ("cell_nodes", "cell_alive"))
        if nodes in dataset
    ]
    if all(alive is None for _, alive in kinds):
        return gone
    used = np.zeros(shape[1], bool)
    for corners, _ in kinds:
        used[corners[corners >= 0]] = True
    for state in range(shape[0]):
        living = np.zeros(shape[1], bool)
        for corners, alive in kinds:
            there = corners if alive is None else corners[alive[state]]
            living[there[there >= 0]] = True
        gone[state] = used & ~living
    return gone


def _dims(dims: tuple[str, ...] | tuple[object, ...]) -> str:
    return "(" + ", ".join(map(str, dims)) + ")"


_Rule = Callable[["xr.Dataset"], Iterator[Violation]]
_STRUCTURE: tuple[_Rule, ...] = (_variables, _sizes, _attributes, _roles)
_VALUES: tuple[_Rule, ...] = (
    _time, _unique, _indices, _reference, _parameter_values, _completeness,
)  # fmt: skip
