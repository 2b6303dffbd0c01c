"""Runs for ParaView: truth, prediction and error on the full mesh, level contributions, and the coarse meshes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crashkit.output import file_name
from crashkit.writers.paraview import write_paraview
from evaluation.comparison.predictor import Model, Predictor
from evaluation.comparison.reference import Reference
from evaluation.comparison.result import Evaluation
from evaluation.comparison.scoring import contributions, full_field, mesh_of

# Bytes of one predicted field held at once; several of them are.
_BUDGET = 64 << 20
_METRES = ("displacement", "predicted", "error", "error_magnitude")


def default_runs(evaluation: Evaluation) -> tuple[int, ...]:
    """The worst and the median test run of the best model: what to fear, and what to expect."""
    errors = evaluation.scores[evaluation.ranked[0].label].of_runs
    order = np.argsort(errors, kind="stable")
    chosen = (order[-1], order[(len(order) - 1) // 2])
    return tuple(dict.fromkeys(evaluation.split.test[int(k)] for k in chosen))


def write_run(evaluation: Evaluation, run: int, folder: Path, formats: Sequence[str] = (".pvd",)) -> list[Path]:
    """Write run number `run` for every model of `evaluation` into `folder`, as `.pvd` with VTU or as `.vtkhdf`.

    `RUN_MODEL` stands on the full mesh, with the arrays displacement (true), predicted, error (vector), its
    magnitude, for a cascade the contribution of each level, and coarsest_level: the coarsest level that keeps a
    node, 0 for none. `RUN_NAME_levelN` is the coarse mesh of level N with its own prediction.
    Returns the files, those to open first. A few states are in memory at a time.
    """
    reference = evaluation.reference
    truth = reference.displacement(run)
    written = []
    for model in _first_seeds(evaluation):
        name = file_name(f"{reference.runs[run]}_{model.name}")
        written += _write_full(reference, model, run, truth, folder / name, formats)
        for predictor in model.predictors:
            if predictor.level > 0:
                name = file_name(f"{reference.runs[run]}_{model.name}_level{predictor.level}")
                written += _write_coarse(reference, predictor, run, truth, folder / name, formats)
    return written


def coarsest_level(reference: Reference) -> NDArray[np.int8]:
    """(node,) the coarsest level that keeps each node; 0 where none does."""
    out = np.zeros(reference.n_nodes, np.int8)
    for level in reference.levels:
        out[level.kept] = level.index
    return out


def _first_seeds(evaluation: Evaluation) -> list[Model]:
    """One model a row: further seeds are not drawn."""
    numbers = sorted({entry.keys[0][0] for entry in evaluation.entries})
    return [evaluation.models[m] for m in numbers]


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

    def fields(self) -> dict[str, _Field]:
        return {name: _Field(self, name, (self.states, *v.shape)) for name, v in self.at(0).items()}


@dataclass(frozen=True)
class _Field:
    """One array of `blocks`, indexed by state."""

    blocks: _Blocks
    name: str
    shape: tuple[int, ...]

    def __getitem__(self, state: int) -> NDArray[Any]:
        return self.blocks.at(state)[self.name]


def _step(reference: Reference) -> int:
    return max(1, min(len(reference.time), _BUDGET // (reference.n_nodes * 12)))


def _write_full(
    reference: Reference, model: Model, run: int, truth: NDArray[np.float32], path: Path, formats: Sequence[str]
) -> list[Path]:
    parameters = reference.parameters[run]
    coarsest_first = sorted(model.predictors, key=lambda p: -p.level)

    def compute(states: slice) -> dict[str, NDArray[Any]]:
        lifted = {
            p.name: full_field(reference, p, p.predict(parameters, reference.time[states]), states.stop - states.start)
            for p in coarsest_first
        }
        out = _errors(truth[states], lifted[coarsest_first[-1].name])
        if len(lifted) > 1:
            out |= {f"contribution_{name}": field for name, field in contributions(lifted).items()}
        return out

    blocks = _Blocks(compute, len(reference.time), _step(reference))
    data: dict[str, Any] = dict(blocks.fields())
    if reference.levels:
        data["coarsest_level"] = coarsest_level(reference)
    alive = None if reference.alive is None else reference.alive(run)
    written = []
    for suffix in formats:
        written += write_paraview(
            path.parent / (path.name + suffix), reference.position_of(run), reference.faces, reference.time, data,
            units=_units(data), alive=alive,
        )[:1]  # fmt: skip
    return written


def _write_coarse(
    reference: Reference, predictor: Predictor, run: int, truth: NDArray[np.float32], path: Path, formats: Sequence[str]
) -> list[Path]:
    level = mesh_of(reference, predictor)
    if level is None:
        return []
    own = truth[:, level.kept]
    data: dict[str, Any] = dict(_errors(own, predictor.predict(reference.parameters[run], reference.time)))
    data["node_id"] = reference.node_id[level.kept]
    written = []
    for suffix in formats:
        written += write_paraview(
            path.parent / (path.name + suffix), reference.position_of(run)[level.kept], level.faces, reference.time,
            data, lines=lone_edges(level.faces, level.edges), units=_units(data),
        )[:1]  # fmt: skip
    return written


def _errors(truth: NDArray[np.float32], predicted: NDArray[np.floating]) -> dict[str, NDArray[Any]]:
    error = (predicted - truth).astype(np.float32)
    return {
        "displacement": truth,
        "predicted": predicted.astype(np.float32),
        "error": error,
        "error_magnitude": np.linalg.norm(error, axis=-1),
    }


def _units(data: Mapping[str, Any]) -> dict[str, str]:
    return {name: "m" for name in data if name in _METRES or name.startswith("contribution_")}


def lone_edges(faces: NDArray[np.integer], edges: NDArray[np.integer]) -> NDArray[np.int64]:
    """(e, 2) those of `edges` that are no side of any of the triangles `faces` (m, 3)."""
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    ends = np.sort(edges, axis=1)
    width = int(max(sides.max(initial=0), ends.max(initial=0))) + 1
    known = np.isin(
        ends[:, 0].astype(np.int64) * width + ends[:, 1], sides[:, 0].astype(np.int64) * width + sides[:, 1]
    )
    return np.asarray(edges, np.int64)[~known].reshape(-1, 2)
