"""The kart study's own tables: beside the paper, its goals, seeds averaged, alternatives."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from plan import COARSEST, MH, MH_ALL, POD_GPR
from rigid import cross_validated
from study_driver.driver import Study
from study_driver.jobs import Job, quick
from study_driver.tables import (
    Columns,
    TestRuns,
    averaged,
    columns,
    errors,
    learning_curves,
    not_trained,
    on_coarse_meshes,
    performance,
    regressions,
    rows,
    write_tables,
)

import crashkit

# Mean node error on the full mesh, cm, seconds an epoch and ms a prediction, of the paper's own kart (its table 4):
# another mesh, other loads and an Apple M1 Max, so to be read by its ratios.
PAPER = {
    "PODNN": (1.57, None, 0.024), "AENN": (0.64, 7.75, 0.035), "GAENN": (1.65, 312.8, 0.907),
    "MH3": (0.62, 1.96, 0.053), "MH2": (0.49, 4.10, 0.106), "MH1": (0.49, 20.2, 0.381),
}  # fmt: skip
MEAN, MEAN_OF_BOTH = "MH1, seeds averaged", "MH1 and POD-GPR, seeds averaged"
ALL, MEAN_OF_ALL = "MH1 on all runs with process", "MH1 on all runs with process, seeds averaged"


def alternatives(study: Study) -> Columns:
    """Validation errors, cm, of what else was tried on the coarsest level: of the whole model and of its reduction."""
    found = []
    for kind in study.plan.alternatives:
        record = crashkit.load_model(study.home / Job(kind).folder).record
        own, reduction = (100 * record.errors.get(name, np.nan) for name in ("MH3", "MH3, reduction alone"))
        different = [setting for setting in kind.settings if setting not in COARSEST]
        found.append((kind.name, own, reduction, " ".join(different) or "-"))
    return columns(("alternative", "validation_error_cm", "reduction_cm", "what_differs"), found)


def goals(found: Mapping[str, float]) -> Columns:
    """Ratios of mean node errors that the study set out for, beside what was found; models that are not there left out."""
    wanted = (
        ("MH1", "PODNN", 0.31), ("MH1", "AENN", 0.76), ("MH2", "MH3", 1.0), ("MH1", "MH2", 1.0), ("MH1", "POD-GPR", 0.8),
        (MEAN, "POD-GPR", 0.8), (MEAN_OF_BOTH, "POD-GPR", 0.8), (ALL, "POD-GPR", 0.8), (MEAN_OF_ALL, "POD-GPR", 0.8),
    )  # fmt: skip
    return columns(
        ("ratio", "found", "goal_at_most"),
        [(f"{a} / {b}", found[a] / found[b], goal) for a, b, goal in wanted if a in found and b in found],
    )


def tables(study: Study) -> list[Path]:
    """Write the tables and the learning curves; what needs a model that is not trained is left out."""
    test, found = TestRuns(study), rows(study)
    known, whole = errors(found), not study.missing()
    mh, gpr = (quick(kind) if study.short else kind for kind in (MH, POD_GPR))
    if whole:
        known[MEAN] = averaged(study, test, [mh])
        known[MEAN_OF_BOTH] = averaged(study, test, [mh, gpr])
    if whole and not study.short:
        models = [crashkit.load_model(study.home / Job(MH_ALL, seed).folder).surrogate for seed in range(study.seeds)]
        known[ALL] = float(np.mean([test.error(m.predict_full) for m in models]))
        known[MEAN_OF_ALL] = averaged(study, test, [MH_ALL])
    out = {
        "table": performance(study, found),
        "paper": columns(
            ("model", "error_cm", "seconds_per_epoch", "prediction_ms"), [(k, *v) for k, v in PAPER.items()]
        ),
        "averaged": columns(
            ("model", "error_cm"),
            [(n, 100 * known[n]) for n in (MEAN, MEAN_OF_BOTH, ALL, MEAN_OF_ALL) if n in known],
        ),
        "goals": goals(known),
        "coarse": on_coarse_meshes(study, found),
        "regressions": regressions(study),
        "not_trained": not_trained(study),
    }
    if whole and not study.short:
        out |= {"alternatives": alternatives(study), "rigid": cross_validated(study.data)}
    return write_tables(study, out, learning_curves(study, test))
