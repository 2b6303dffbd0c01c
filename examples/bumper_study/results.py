"""The bumper study's tables: beside its goals, with intervals, and what each idea of physics is worth."""

from __future__ import annotations

from pathlib import Path

from plan import POD_GPR
from study_driver.driver import Study
from study_driver.tables import (
    Columns,
    LearningCurves,
    TestRuns,
    columns,
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

# Mean node error on the test runs, mm, that was set as a goal before: model, training runs, at most.
GOALS = (("POD-GPR", 96, 2.8), ("POD-GPR", 24, 4.1), ("POD-GPR", 12, 6.3), ("MH1", 96, 2.6))


def goals(curves: LearningCurves) -> Columns:
    """Goals beside what was found with seed 0; models that are not there left out."""
    found = {
        (model, size): 1000 * error
        for model, errors in curves.errors.items()
        for size, error in zip(curves.sizes, errors, strict=True)
    }
    return columns(
        ("model", "training_runs", "error_mm", "goal_at_most_mm"),
        [(m, n, found[m, n], goal) for m, n, goal in GOALS if found.get((m, n), float("nan")) > 0],
    )


def tables(study: Study) -> list[Path]:
    """Write the tables and the learning curves; what needs a model that is not trained is left out."""
    found, curves = rows(study), learning_curves(study, TestRuns(study))
    out = {
        "table": performance(study, found),
        "intervals": intervals(study, found, "POD-GPR"),
        "goals": goals(curves),
        "coarse": on_coarse_meshes(study, found),
        "worth": worth(study, POD_GPR),
        "regressions": regressions(study),
        "not_trained": not_trained(study),
    }
    return write_tables(study, out, curves)
