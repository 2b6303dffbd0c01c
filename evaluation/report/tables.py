"""The performance table and its companions, as columns for CSV, JSON and the report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from evaluation.comparison.result import Evaluation
from evaluation.drawing.style import CM, MS
from evaluation.measures.distance import masked_mean


@dataclass(frozen=True)
class Performance:
    """One row of the performance table; lengths in cm, names carry the units. NaN where a number makes no sense.

    error               e2: mean over nodes, time, test runs and seeds
    spread              standard deviation of that over seeds; NaN for one seed
    peak                largest error of any node at any time
    reduction           error of encoding and decoding the truth
    pod_floor           projection on as many modes as the model has latent numbers
    lifting             cost of the model's own map from its level to the full mesh alone
    covered             share of nodes and states of the test runs within the model's own 90 % band; NaN without one

    Attributes
    ----------
    relative
        Relative L2 error of displacements, mean over runs.
    worst_run
        Its error and its name.
    """

    model: str
    level: int
    nodes: int
    seeds: int
    error_cm: float
    spread_cm: float
    relative: float
    worst_run_cm: float
    worst_run: str
    peak_cm: float
    reduction_cm: float
    pod_floor_cm: float
    lifting_cm: float
    covered: float
    latent: int
    parameters: int
    seconds_per_epoch: float
    training_s: float
    prediction_ms: float
    prediction_lifted_ms: float
    single_prediction_ms: float


def performance(evaluation: Evaluation) -> list[Performance]:
    """The performance table, one row an entry, in the order of the models."""
    rows = []
    for entry in evaluation.entries:
        scores, predictor = evaluation.scores[entry.label], evaluation.predictor(entry)
        seeds = [evaluation.predictor(entry, k) for k in range(len(entry.keys))]
        of_runs = scores.of_runs
        worst = int(np.nanargmax(of_runs))
        timing = evaluation.timings.get(entry.label)
        nan = float("nan")
        rows.append(
            Performance(
                model=entry.label,
                level=entry.level,
                nodes=evaluation.nodes(entry),
                seeds=len(entry.keys),
                error_cm=scores.mean * CM,
                spread_cm=scores.spread * CM,
                relative=float(masked_mean(scores.relative)),
                worst_run_cm=float(of_runs[worst]) * CM,
                worst_run=evaluation.test_names[worst],
                peak_cm=float(scores.peak_value.max()) * CM,
                reduction_cm=scores.reduction * CM,
                pod_floor_cm=evaluation.floor_at(predictor.n_latent) * CM,
                lifting_cm=evaluation.lifting_of(entry) * CM,
                covered=_mean(scores.covered.ravel().tolist()),
                latent=predictor.n_latent,
                parameters=predictor.n_parameters,
                seconds_per_epoch=_mean([p.seconds_per_epoch for p in seeds]),
                training_s=_mean([p.training_seconds for p in seeds]),
                prediction_ms=timing.own if timing else nan,
                prediction_lifted_ms=timing.lifted if timing else nan,
                single_prediction_ms=timing.single_lifted if timing else nan,
            )
        )
    return rows


def _mean(values: Sequence[float]) -> float:
    known = [v for v in values if v == v]
    return sum(known) / len(known) if known else float("nan")


def columns(rows: Sequence[Any]) -> dict[str, list[Any]]:
    """Rows of one dataclass as columns."""
    if not rows:
        return {}
    return {name: [asdict(row)[name] for row in rows] for name in asdict(rows[0])}


def of_runs(evaluation: Evaluation) -> dict[str, list[Any]]:
    """Error of each model on each test run, cm, with the run's parameters and mean displacement."""
    reference = evaluation.reference
    table: dict[str, list[Any]] = {"run": list(evaluation.test_names)}
    for k, (name, unit) in enumerate(zip(reference.parameter_names, reference.parameter_units, strict=True)):
        table[f"{name} ({unit})"] = [float(v) for v in reference.parameters[list(evaluation.split.test), k]]
    table["mean_displacement_cm"] = [float(masked_mean(r.size)) * CM for r in evaluation.runs]
    for entry in evaluation.entries:
        table[f"{entry.label} (cm)"] = [float(v) * CM for v in evaluation.scores[entry.label].of_runs]
    return table


def worst_places(evaluation: Evaluation) -> dict[str, list[Any]]:
    """For each model: the worst run, the largest error anywhere with its node and time, the worst node, the worst time.

    Nodes are named by the solver's own numbers.
    """
    reference = evaluation.reference
    node_parts = _part_of_nodes(evaluation)
    table: dict[str, list[Any]] = {}
    for entry in evaluation.entries:
        scores = evaluation.scores[entry.label]
        of_runs = scores.of_runs
        run = int(np.nanargmax(of_runs))
        seed, peak = np.unravel_index(int(np.argmax(scores.peak_value)), scores.peak_value.shape)
        node, state = int(scores.peak_node[seed, peak]), int(scores.peak_state[seed, peak])
        mean_node = int(np.nanargmax(scores.node_mean))
        over_time = masked_mean(scores.e2, axis=(0, 1))
        row = {
            "model": entry.label,
            "worst_run": evaluation.test_names[run],
            "its_error_cm": float(of_runs[run]) * CM,
            "peak_cm": float(scores.peak_value[seed, peak]) * CM,
            "peak_run": evaluation.test_names[peak],
            "peak_node": int(reference.node_id[node]),
            "peak_part": node_parts[node],
            "peak_time_ms": float(reference.time[state]) * MS,
            "worst_node": int(reference.node_id[mean_node]),
            "worst_node_part": node_parts[mean_node],
            "worst_node_cm": float(scores.node_mean[mean_node]) * CM,
            "worst_time_ms": float(reference.time[int(np.nanargmax(over_time))]) * MS,
            "error_then_cm": float(np.nanmax(over_time)) * CM,
        }
        for name, value in row.items():
            table.setdefault(name, []).append(value)
    return table


def _part_of_nodes(evaluation: Evaluation) -> list[str]:
    names = ["" for _ in range(evaluation.reference.n_nodes)]
    for part, nodes in enumerate(evaluation.reference.part_nodes()):
        for node in nodes:
            names[node] = evaluation.reference.part_names[part]
    return names


def split(evaluation: Evaluation) -> dict[str, list[str]]:
    """Which run did what: test, or training of which models, or tuning of which."""
    reference = evaluation.reference
    test = set(evaluation.split.test)
    table: dict[str, list[str]] = {"run": list(reference.runs), "role": []}
    for k, run in enumerate(reference.runs):
        fitted = any(run in m.fitted_runs for m in evaluation.models)
        tuned = any(run in m.tuned_runs for m in evaluation.models)
        roles = [name for name, holds in (("training", fitted), ("validation", tuned)) if holds]
        table["role"].append("test" if k in test else " and ".join(roles) or "not used")
    return table
