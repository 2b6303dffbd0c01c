"""The kart study's own tables: its goals, near-frontal runs, predictions averaged, and the published settings beside the paper."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from plan import MH, POD_GPR
from rigid import cross_validated
from study_driver.driver import Study
from study_driver.jobs import Job, quick
from study_driver.tables import (
    Columns,
    LearningCurves,
    Row,
    TestRuns,
    averaged,
    columns,
    errors,
    intervals,
    learning_curves,
    not_trained,
    on_coarse_meshes,
    performance,
    regressions,
    rows,
    worth,
    write_tables,
)

import crashkit

# Mean node error on the full mesh, cm, seconds an epoch and ms a prediction, of the paper's own kart (its table 4):
# another mesh, other loads and an Apple M1 Max, so to be read by its ratios.
PAPER = {
    "PODNN": (1.57, None, 0.024), "AENN": (0.64, 7.75, 0.035), "GAENN": (1.65, 312.8, 0.907),
    "MH3": (0.62, 1.96, 0.053), "MH2": (0.49, 4.10, 0.106), "MH1": (0.49, 20.2, 0.381),
}  # fmt: skip
# Mean node error on the test runs, cm, that was set as a goal before: model, training runs, at most.
GOALS = (
    ("POD-GPR", 96, 0.67), ("MH1", 96, 0.61), ("MH3", 96, 0.69), ("MH1", 48, 0.80), ("MH1", 32, 1.0),
)  # fmt: skip
FRONTAL = 10.0  # degrees: within them the frame folds to one side or the other
MEAN, MEAN_OF_BOTH = "MH1, seeds averaged", "MH1 and POD-GPR, seeds averaged"


def goals(found: Mapping[tuple[str, int], float]) -> Columns:
    """Goals beside errors, m, by model and training runs; what is not there is left out."""
    return columns(
        ("model", "training_runs", "error_cm", "goal_at_most_cm"),
        [(m, n, 100 * found[m, n], goal) for m, n, goal in GOALS if found.get((m, n), np.nan) > 0],
    )


def reached(known: Mapping[str, float], curves: LearningCurves, train: int) -> dict[tuple[str, int], float]:
    """Errors, m, by model and training runs: with all of them the mean over seeds, with fewer those of the curves."""
    few = {
        (model, size): error
        for model, of in curves.errors.items()
        for size, error in zip(curves.sizes, of, strict=True)
        if size != train
    }
    return few | {(model, train): error for model, error in known.items()}


def frontal(study: Study, found: Sequence[Row]) -> Columns:
    """Mean errors, cm, over the test runs within ten degrees of frontal, over the others, and the worst run."""
    angle = crashkit.open_dataset(study.data)["impact_angle"].values[study.plan.train : study.plan.runs]
    with (study.home / "report" / "tables" / "runs.csv").open(encoding="utf-8", newline="") as file:
        lines = list(csv.DictReader(file))
    near = np.abs(angle) <= FRONTAL
    of_runs = {row.name: np.array([float(line[f"{row.label} (cm)"]) for line in lines]) for row in found}
    return columns(
        ("model", "within_ten_degrees_cm", "others_cm", "worst_run_cm"),
        [(name, float(v[near].mean()), float(v[~near].mean()), float(v.max())) for name, v in of_runs.items()],
    )


def published(study: Study, test: TestRuns) -> Columns:
    """The published settings, trained with one seed, beside the paper's numbers for its own kart."""
    ours: dict[str, tuple[float, int, float]] = {}
    for kind in study.plan.once:
        if not study.trained(Job(kind)):
            continue
        model = crashkit.load_model(study.home / Job(kind).folder).surrogate
        for name, level in model.level_names.items():
            fit = model.record.fits[level]
            error = test.error(lambda p, m=model, k=level: m.predict_full(p, level=k))
            ours[name] = (100 * error, fit.epochs, fit.seconds / fit.epochs)
    empty = (None, None, None)
    return columns(
        ("model", "error_cm", "epochs", "seconds_per_epoch", "paper_error_cm", "paper_seconds_per_epoch"),
        [(name, *ours.get(name, empty), *of[:2]) for name, of in PAPER.items()],
    )


def tables(study: Study) -> list[Path]:
    """Write the tables and the learning curves; what needs a model that is not trained is left out."""
    test, found = TestRuns(study), rows(study)
    known, curves = errors(found), learning_curves(study, test)
    mh, gpr = (quick(kind) if study.short else kind for kind in (MH, POD_GPR))
    mean: dict[str, float] = {}
    if all(study.trained(Job(kind, seed)) for kind in (mh, gpr) for seed in range(study.seeds)):
        mean = {MEAN: averaged(study, test, [mh]), MEAN_OF_BOTH: averaged(study, test, [mh, gpr])}
    out = {
        "table": performance(study, found),
        "intervals": intervals(study, found, "POD-GPR"),
        "frontal": frontal(study, found),
        "averaged": columns(("model", "error_cm"), [(name, 100 * error) for name, error in mean.items()]),
        "goals": goals(reached(known, curves, study.plan.train)),
        "coarse": on_coarse_meshes(study, found),
        "worth": worth(study, gpr),
        "regressions": regressions(study),
        "not_trained": not_trained(study),
    }
    if not study.short:
        out |= {"paper": published(study, test), "rigid": cross_validated(study.data)}
    return write_tables(study, out, curves)
