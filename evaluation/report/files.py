"""Runs for ParaView: truth, prediction and error on the full mesh, level contributions, and the coarse meshes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crashkit.output import file_name
from crashkit.writers.paraview import rounded, write_paraview
from data_schema.edges import without_sides
from evaluation.comparison.predictor import ComparedModel, Predictor, array_names
from evaluation.comparison.reference import Reference
from evaluation.comparison.result import Evaluation
from evaluation.comparison.scoring import contributions, full_field, mesh_of

# Bytes of one predicted field held at once; several of them are.
_BUDGET = 64 << 20
_METRES = ("displacement", "predicted", "error", "contribution_")


def default_runs(evaluation: Evaluation) -> tuple[int, ...]:
    """The worst and the median test run of the best model: what to fear, and what to expect."""
    errors = evaluation.scores[evaluation.ranked[0].label].of_runs
    order = np.argsort(errors, kind="stable")
    chosen = (order[-1], order[(len(order) - 1) // 2])
    return tuple(dict.fromkeys(evaluation.split.test[int(k)] for k in chosen))


def write_run(evaluation: Evaluation, run: int, folder: Path, formats: Sequence[str] = (".pvd",)) -> list[Path]:
    """Write run number `run` with the predictions of all models into `folder`, as `.pvd` with VTU or as `.vtkhdf`.

    `RUN` stands on the full mesh. Its arrays are displacement (true); predicted_MODEL and the distance from the truth,
    error_MODEL, of every model; contribution_LEVEL of a cascade, but for the coarsest level's, which is what the others
    leave of the prediction; coarsest_level, the coarsest level that keeps a node
    (0 for none); the fields that were ingested; numbers of nodes, elements and parts. Parameters and names of parts and
    models are field data. `RUN_MODEL_levelN` is the coarse mesh of level N with its own prediction. Predictions are
    rounded far below their error (`crashkit.writers.paraview.rounded`).

    Returns the files to open. A few states are in memory at a time.
    """
    reference = evaluation.reference
    truth = reference.displacement(run)
    models = evaluation.first_seeds
    written = _write_full(reference, models, run, truth, folder / file_name(reference.runs[run]), formats)
    for model in models:
        for predictor in model.predictors:
            if predictor.level > 0:
                name = file_name(f"{reference.runs[run]}_{model.name}_level{predictor.level}")
                written += _write_coarse(reference, model, predictor, run, truth, folder / name, formats)
    return written


def coarsest_level(reference: Reference) -> NDArray[np.int8]:
    """(node,) the coarsest level that keeps each node; 0 where none does."""
    out = np.zeros(reference.n_nodes, np.int8)
    for level in reference.levels:
        out[level.kept] = level.index
    return out


@dataclass
class _Blocks:
    """Fields of a run that are computed for a few states at a time, in the order a writer asks for them."""

    compute: Callable[[slice], dict[str, NDArray[Any]]]
    states: int
    step: int
    first: int = -1
    held: Mapping[str, NDArray[Any]] | None = None

    def at(self, state: int) -> Mapping[str, NDArray[Any]]:
        first = state // self.step * self.step
        if first != self.first or self.held is None:
            self.held = self.compute(slice(first, min(first + self.step, self.states)))
            self.first = first
        return {name: values[state - first] for name, values in self.held.items()}

    def fields(self) -> dict[str, _BlockArray]:
        return {name: _BlockArray(self, name, (self.states, *v.shape)) for name, v in self.at(0).items()}


@dataclass(frozen=True)
class _BlockArray:
    """One array of `blocks`, indexed by state."""

    blocks: _Blocks
    name: str
    shape: tuple[int, ...]

    def __getitem__(self, state: int) -> NDArray[Any]:
        return self.blocks.at(state)[self.name]


def _step(reference: Reference) -> int:
    return max(1, min(len(reference.time), _BUDGET // (reference.n_nodes * 12)))


def _write_full(
    reference: Reference,
    models: Sequence[ComparedModel],
    run: int,
    truth: NDArray[np.float32],
    path: Path,
    formats: Sequence[str],
) -> list[Path]:
    parameters, names, size = reference.parameters[run], array_names(models), _size(reference.position)

    def compute(states: slice) -> dict[str, NDArray[Any]]:
        out = {"displacement": truth[states]}
        for model in models:
            lifted = {
                names[model.name, p.name]: full_field(
                    reference, p, p.predict(parameters, reference.time[states]), states.stop - states.start
                )
                for p in sorted(model.predictors, key=lambda p: -p.level)
            }
            finest = list(lifted)[-1]
            out[f"predicted_{finest}"] = rounded(lifted[finest], size)
            out[f"error_{finest}"] = rounded(_distance(lifted[finest], truth[states]), size)
            if len(lifted) > 1:
                added = dict(list(contributions(lifted).items())[1:])  # the coarsest level's is what remains
                out |= {f"contribution_{name}": rounded(field, size) for name, field in added.items()}
        return out

    blocks = _Blocks(compute, len(reference.time), _step(reference))
    data: dict[str, Any] = {**blocks.fields(), "node_id": _small(reference.node_id)}
    cells: dict[str, Any] = {"part_id": _small(reference.part_id[reference.face_part])}
    if reference.levels:
        data["coarsest_level"] = coarsest_level(reference)
    if reference.face_id is not None:
        cells["element_id"] = _small(reference.face_id)
    units = _units(data)
    for name, field in (reference.fields(run) if reference.fields is not None else {}).items():
        if field.on in ("node", "face"):
            (data if field.on == "node" else cells)[name] = field.values
            units |= {name: field.unit} if field.unit else {}
    about = {"models": ", ".join(dict.fromkeys(m.name for m in models)), **_about(reference, run)}
    return [
        write_paraview(
            path.parent / (path.name + suffix), reference.position_of(run), reference.faces, reference.time, data,
            cells, units=units, alive=None if reference.alive is None else reference.alive(run), field_data=about,
        )[0]
        for suffix in formats
    ]  # fmt: skip


def _write_coarse(
    reference: Reference,
    model: ComparedModel,
    predictor: Predictor,
    run: int,
    truth: NDArray[np.float32],
    path: Path,
    formats: Sequence[str],
) -> list[Path]:
    level = mesh_of(reference, predictor)
    if level is None:
        return []
    own, size = truth[:, level.kept], _size(reference.position)
    predicted = predictor.predict(reference.parameters[run], reference.time)
    data: dict[str, Any] = {
        "displacement": own,
        "predicted": rounded(predicted, size),
        "error": rounded(_distance(predicted, own), size),
        "node_id": _small(reference.node_id[level.kept]),
    }
    about = {"model": f"{predictor.name} of {model.name}", **_about(reference, run)}
    return [
        write_paraview(
            path.parent / (path.name + suffix), reference.position_of(run)[level.kept], level.faces, reference.time,
            data, lines=without_sides(level.edges, level.faces), units=_units(data), field_data=about,
        )[0]
        for suffix in formats
    ]  # fmt: skip


def _about(reference: Reference, run: int) -> dict[str, Any]:
    """Field data: the run, its parameters, and the parts."""
    out: dict[str, Any] = {"run": reference.runs[run]}
    for name, value, (unit, factor) in zip(
        reference.parameter_names, reference.parameters[run], reference.written, strict=True
    ):
        out |= {name: value / factor, f"{name}_unit": unit}
    return {**out, "part_name": list(reference.part_names), "part_number": np.asarray(reference.part_id)}


def _distance(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float32]:
    apart = a - b
    return np.asarray(np.sqrt(np.einsum("...x,...x->...", apart, apart)), np.float32)


def _size(points: NDArray[np.float64]) -> float:
    """The longest side of the box around `points`, m."""
    return float(np.ptp(points, axis=0).max())


def _small(numbers: NDArray[np.integer]) -> NDArray[np.integer]:
    """Numbers in four bytes where they fit: they stand in every VTU of a series."""
    return numbers.astype(np.int32) if abs(numbers).max(initial=0) < 2**31 else numbers


def _units(data: Mapping[str, Any]) -> dict[str, str]:
    return {name: "m" for name in data if name.startswith(_METRES)}
