"""From stored models and the report to the study's own tables and its learning curves."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from plan import (
    ALTERNATIVES,
    COARSEST,
    CURVES,
    MH,
    MH_ALL,
    NETWORKS,
    POD_GPR,
    RUNS,
    SIZES,
    TABLE,
    TRAIN,
    Job,
    Kind,
    alone,
    quick,
)
from rigid import cross_validated

import crashkit
from data_schema import parameters
from evaluation.figures import Sheet, styles
from evaluation.figures.kind import Columns, to_csv, write
from evaluation.measures.distance import mean_node_error, node_distance

# Mean node error on the full mesh, cm, seconds an epoch and ms a prediction, of the paper's own kart (its table 4):
# another mesh, other loads and an Apple M1 Max, so to be read by its ratios.
PAPER = {
    "PODNN": (1.57, None, 0.024), "AENN": (0.64, 7.75, 0.035), "GAENN": (1.65, 312.8, 0.907),
    "MH3": (0.62, 1.96, 0.053), "MH2": (0.49, 4.10, 0.106), "MH1": (0.49, 20.2, 0.381),
}  # fmt: skip
KINDS = ("approximation", "reconstruction")
MEAN, MEAN_OF_BOTH = "MH1, seeds averaged", "MH1 and POD-GPR, seeds averaged"
ALL, MEAN_OF_ALL = "MH1 on all runs with process", "MH1 on all runs with process, seeds averaged"
SHOWN = ("model", "seeds", "error_cm", "spread_cm", "relative", "worst_run_cm", "reduction_cm", "lifting_cm", "parameters",
         "prediction_ms", "prediction_lifted_ms")  # fmt: skip


@dataclass(frozen=True)
class LearningCurves:
    """Mean node error, m, over the test runs against the number of training runs: model -> one value for each size."""

    sizes: tuple[int, ...]
    errors: dict[str, list[float]]

    def numbers(self) -> Columns:
        rows = [(m, n, 100 * e) for m, errors in self.errors.items() for n, e in zip(self.sizes, errors, strict=True)]
        return _columns(("model", "training_runs", "mean_node_error_cm"), rows)

    def draw(self, sheet: Sheet) -> Any:
        figure, (axes,) = sheet.panels(1, height=7.5)
        for model, errors in self.errors.items():
            style = sheet.style(model)
            axes.plot(
                self.sizes, 100 * np.array(errors), style.marker, linestyle=style.line, color=style.colour, label=model
            )
        axes.set_xscale("log", base=2)
        axes.set_xticks(self.sizes, [str(n) for n in self.sizes])
        axes.minorticks_off()
        axes.set_ylim(bottom=0)
        axes.set_xlabel("training runs")
        axes.set_ylabel("mean node error (cm)")
        sheet.legend(figure, axes)
        return figure

    def caption(self) -> str:
        return "Mean node error on the full mesh, over the same test runs, against the number of training runs."


class TestRuns:
    """The test runs' true displacements, and the error of predictions on them."""

    def __init__(self, data: Path) -> None:
        dataset = crashkit.open_dataset(data).isel(sim=slice(TRAIN, RUNS))
        self.parameters = np.stack([dataset[n].values for n in parameters(dataset)], axis=1)
        self.truth = dataset["displacement"]

    def error(self, predict: Callable[[np.ndarray], np.ndarray]) -> float:
        """e2, m: mean over nodes, states and runs of the distance to `predict(parameters)` (state, node, 3)."""
        of_runs = [
            mean_node_error(node_distance(self.truth.isel(sim=k).values, predict(values))).mean()
            for k, values in enumerate(self.parameters)
        ]
        return float(np.mean(of_runs))


def learning_curves(home: Path, test: TestRuns, shape: Callable[[Kind], Kind]) -> LearningCurves:
    """Every kind of `CURVES`, and every level of a cascade, trained on the first 12, 24, .. runs with seed 0."""
    sizes, errors = (*SIZES, TRAIN), {}
    for kind in CURVES:
        for runs in sizes:
            model = crashkit.load_model(home / Job(shape(kind), 0, runs).folder).surrogate
            for name, level in model.level_names.items():
                found = test.error(lambda p, m=model, k=level: m.predict_full(p, level=k))
                errors.setdefault(name.split(" ")[0], []).append(found)
    return LearningCurves(sizes, errors)


def averaged(home: Path, test: TestRuns, seeds: int, kinds: Sequence[Kind]) -> float:
    """e2, m, of the mean prediction of `kinds`, all their seeds, each on its finest level."""
    models = [crashkit.load_model(home / Job(kind, seed).folder).surrogate for kind in kinds for seed in range(seeds)]
    return test.error(lambda p: np.mean([m.predict_full(p) for m in models], axis=0))


def alternatives(home: Path) -> Columns:
    """Validation errors, cm, of what else was tried on the coarsest level: of the whole model and of its reduction."""
    rows = []
    for kind in ALTERNATIVES:
        record = crashkit.load_model(home / Job(kind).folder).record
        own, reduction = (100 * record.errors.get(name, np.nan) for name in ("MH3", "MH3, reduction alone"))
        different = [setting for setting in kind.settings if setting not in COARSEST]
        rows.append((kind.name, own, reduction, " ".join(different) or "-"))
    return _columns(("alternative", "validation_error_cm", "reduction_cm", "what_differs"), rows)


def goals(errors: dict[str, float]) -> Columns:
    """Ratios of mean node errors that the study set out for, beside what was found; models that are not there left out."""
    wanted = (
        ("MH1", "PODNN", 0.31), ("MH1", "AENN", 0.76), ("MH2", "MH3", 1.0), ("MH1", "MH2", 1.0), ("MH1", "POD-GPR", 0.8),
        (MEAN, "POD-GPR", 0.8), (MEAN_OF_BOTH, "POD-GPR", 0.8), (ALL, "POD-GPR", 0.8), (MEAN_OF_ALL, "POD-GPR", 0.8),
    )  # fmt: skip
    found = [(f"{a} / {b}", errors[a] / errors[b], goal) for a, b, goal in wanted if a in errors and b in errors]
    return _columns(("ratio", "found", "goal_at_most"), found)


def timed_alone(home: Path, rows: Sequence[Mapping[str, Any]], shape: Callable[[Kind], Kind]) -> Columns:
    """Seconds an epoch of each level while nothing else ran, and of a whole training with the levels it starts from.

    What is not trained by epochs keeps the seconds of the report.
    """
    each, whole = {}, {row["model"].split(" ")[0]: row["training_s"] for row in rows}
    for kind in (k for k in TABLE if k.model in NETWORKS):
        timed = crashkit.load_model(home / Job(alone(kind)).folder).surrogate
        trained, total = crashkit.load_model(home / Job(shape(kind)).folder).surrogate, 0.0
        for name, level in timed.level_names.items():  # coarsest first
            each[name] = timed.record.fits[level].seconds / timed.record.fits[level].epochs
            total += each[name] * trained.record.fits[level].epochs
            whole[name] = total
    names = [row["model"].split(" ")[0] for row in rows]
    return {"seconds_per_epoch": [each.get(n) for n in names], "training_s": [whole[n] for n in names]}


def on_coarse_meshes(levels: Path) -> Columns:
    """Errors, cm, on the nodes of each coarse level: of the cascade's own model there, and of what works on the full mesh."""
    with levels.open(encoding="utf-8", newline="") as file:
        rows = [
            (int(row["nodes"]), row["model"], *(float(row[f"{kind}_cm"] or "nan") for kind in KINDS))
            for row in csv.DictReader(file)
            if row["level"] != "0" and (row["prediction_is"] == "own" or not row["model"].startswith("MH"))
        ]
    return _columns(("nodes", "model", *(f"{kind}_cm" for kind in KINDS)), sorted(rows, key=lambda row: -row[0]))


def markdown(columns: Columns) -> str:
    """Columns as a table for a page."""
    head = [name.replace("_", " ") for name in columns]
    body = [[_cell(v) for v in row] for row in zip(*columns.values(), strict=True)]
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *body]) + "\n"


def _cell(value: Any) -> str:
    if value is None or value != value:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _columns(names: Sequence[str], rows: Iterable[Sequence[Any]]) -> Columns:
    return dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))


def write_results(data: Path, home: Path, seeds: int, short: bool) -> list[Path]:
    """Write tables (.csv, .md) and the learning curves into `home`/results; returns the paths."""
    shape = quick if short else (lambda kind: kind)
    folder = home / "results"
    folder.mkdir(exist_ok=True)
    test = TestRuns(data)
    rows = json.loads((home / "report" / "report.json").read_text())["performance"]
    errors = {row["model"].split(" ")[0]: row["error_cm"] for row in rows}
    mh, gpr = shape(MH), shape(POD_GPR)
    errors[MEAN] = 100 * averaged(home, test, seeds, [mh])
    errors[MEAN_OF_BOTH] = 100 * averaged(home, test, seeds, [mh, gpr])
    if not short:
        models = [crashkit.load_model(home / Job(MH_ALL, seed).folder).surrogate for seed in range(seeds)]
        errors[ALL] = 100 * float(np.mean([test.error(m.predict_full) for m in models]))
        errors[MEAN_OF_ALL] = 100 * averaged(home, test, seeds, [MH_ALL])
    tables = {
        "table": {name: [row[name] for row in rows] for name in SHOWN} | timed_alone(home, rows, shape),
        "paper": _columns(
            ("model", "error_cm", "seconds_per_epoch", "prediction_ms"), [(k, *v) for k, v in PAPER.items()]
        ),
        "averaged": _columns(
            ("model", "error_cm"), [(n, errors[n]) for n in (MEAN, MEAN_OF_BOTH, ALL, MEAN_OF_ALL) if n in errors]
        ),
        "goals": goals(errors),
    }
    if not short:
        tables |= {"alternatives": alternatives(home), "rigid": cross_validated(data)}
    tables["coarse"] = on_coarse_meshes(home / "report" / "figures" / "levels.csv")
    paths = []
    for name, columns in tables.items():
        paths += [folder / f"{name}.csv", folder / f"{name}.md"]
        paths[-2].write_text(to_csv(columns), encoding="utf-8")
        paths[-1].write_text(markdown(columns), encoding="utf-8")
    curves = learning_curves(home, test, shape)
    written, _ = write(curves, "learning_curves", folder, Sheet(styles=styles(list(curves.errors))))
    return [*paths, *written]
