"""The report: an `Evaluation` as a folder with `report.html`, figures, tables as CSV, and all numbers as JSON."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from evaluation.comparison.predictor import ComparedModel
from evaluation.comparison.result import Evaluation
from evaluation.drawing.style import CM, called
from evaluation.errors import EvaluationError
from evaluation.figures import drawings, sheet_of
from evaluation.figures.kind import Columns, to_csv
from evaluation.measures.curves import rating_table
from evaluation.report import tables
from evaluation.report.page import (
    Page,
    ShownFigure,
    ShownTable,
    ShownView,
    plain_json,
    render_page,
    show_figure,
    show_table,
)
from evaluation.report.verdict import RULES, statements

_log = logging.getLogger(__name__)

_HEADINGS = {
    "model": "model", "nodes": "nodes", "error_cm": "mean node error (cm)", "spread_cm": "± over seeds (cm)",
    "relative_percent": "relative (%)", "worst_run_cm": "worst run (cm)", "peak_cm": "largest anywhere (cm)",
    "reduction_cm": "compression error (cm)", "pod_floor_cm": "best linear compression, same size (cm)", "latent": "latent size",
    "parameters": "parameters", "training_s": "training (s)", "prediction_lifted_ms": "ms per state",
}  # fmt: skip
_FURTHER_HEADINGS = {
    "model": "model", "level": "level", "seeds": "seeds", "worst_run": "worst run", "lifting_cm": "interpolation error (cm)",
    "seconds_per_epoch": "s per epoch", "prediction_ms": "ms per state, own level",
    "prediction_lifted_ms": "ms per state, full mesh", "single_prediction_ms": "ms for a single state, full mesh",
    "covered_percent": "within the 90 % band (%)",
}  # fmt: skip
_LOWEST = (
    "error_cm", "relative_percent", "worst_run_cm", "peak_cm", "training_s", "parameters", "prediction_lifted_ms",
    "prediction_ms", "seconds_per_epoch", "single_prediction_ms",
)  # fmt: skip

_TEXT = (
    "The mean node error e2 is the Euclidean distance between the node of the solver's run and the predicted node, "
    "averaged over nodes, then over time, then over the test runs, each run and each state counting the same. It is "
    "an error of displacements, in centimetres, on the full mesh: predictions on a coarse mesh are lifted to it with "
    "the map of their model, which is barycentric, or learnt from its training runs where that is better (its card says "
    "which). Nodes without a living element are left out.",
    "The relative error is the L2 norm of the displacement error over all nodes and states of a run, divided by "
    "that of "
    "the displacement, and averaged over the runs; it does not depend on where the origin lies. "
    "The compression error is the error of encoding and decoding the true states. The best linear compression (POD "
    "floor) is the error of projecting the test runs on the leading modes of all other runs, not centred. The "
    "interpolation error is the error of interpolating the true states back from the nodes of a coarse mesh.",
    "A band is an interval around the prediction that should contain 90 % of nodes and states; its width comes from "
    "the errors on runs the model had not seen. The table lists the share of the test runs' nodes and states within it.",
    "Milliseconds are the fastest of up to nine repetitions on the machine named below, for all states of a run asked "
    "in one call "
    "and divided by their number, unless a column says otherwise.",
)


def write_report(
    evaluation: Evaluation,
    folder: Path,
    *,
    title: str = "How far can these surrogates be trusted?",
    view: bool = True,
    names: Sequence[str] | None = None,
    done: Callable[[str], None] | None = None,
) -> Path:
    """Write report.html, report.json, figures/ (PNG, SVG, CSV) and tables/ (CSV) into `folder`; returns the page.

    Parameters
    ----------
    names
        The figures, in their order; default: all (figures.kinds).
    view
        Whether to make an interactive view of the worst run, where the viewer extra is there.
    done
        Called with the name of each figure when it is written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    sheet = sheet_of(evaluation)
    shown: list[ShownFigure] = []
    figure_numbers: dict[str, Columns] = {}
    for kind, drawing in drawings(evaluation, names):
        shown.append(show_figure(kind, drawing, folder / "figures", sheet, folder))
        figure_numbers[kind.name] = drawing.numbers()
        if done:
            done(kind.name)
    _log.info("the page and its view in three dimensions" if view else "the page")
    views, left_out = _views(evaluation) if view else ([], "")
    rows = tables.performance(evaluation)
    performance = tables.columns(rows)
    performance["relative_percent"] = [100 * v for v in performance["relative"]]
    performance["covered_percent"] = [100 * v for v in performance["covered"]]
    all_tables: dict[str, Columns] = {
        "performance": tables.columns(rows),
        "runs": tables.of_runs(evaluation),
        "worst": tables.worst_places(evaluation),
        **_ratings(evaluation),
        **({} if evaluation.beside is None else {"numbers": evaluation.beside.table()}),
        "split": tables.split(evaluation),
        **_worth(evaluation),
    }
    (folder / "tables").mkdir(exist_ok=True)
    for name, columns in all_tables.items():
        (folder / "tables" / f"{name}.csv").write_text(to_csv(columns), encoding="utf-8")
    said = statements(evaluation)
    page = Page(
        title=title,
        subtitle=_subtitle(evaluation),
        statements=said,
        rules=RULES,
        key_table=_key_table(performance),
        figures=shown,
        views=views,
        text=_TEXT,
        methods=[*evaluation.context.items(), *_known(evaluation), *([("Left out", left_out)] if left_out else [])],
        details=_details(evaluation),
        tables=[*_tables(performance, all_tables), *_file_table(evaluation, folder)],
    )
    numbers = {
        "performance": [asdict(row) for row in rows],
        "statements": [asdict(s) for s in said],
        "tables": {name: columns for name, columns in all_tables.items() if name != "performance"},
        "figures": figure_numbers,
        "context": dict(evaluation.context),
        "test_runs": list(evaluation.test_names),
        "mean_displacement_cm": evaluation.size * CM,
    }
    (folder / "report.json").write_text(json.dumps(plain_json(numbers), indent=1), encoding="utf-8")
    path = folder / "report.html"
    path.write_text(render_page(page), encoding="utf-8")
    return path


def _ratings(evaluation: Evaluation) -> dict[str, Columns]:
    """The table of ratings under its name; empty where nothing was rated."""
    if evaluation.ratings is None or evaluation.sensors is None:
        return {}
    nodes = [int(n) for n in evaluation.reference.node_id[evaluation.sensors.probes]]
    return {"ratings": rating_table(evaluation.ratings, nodes)}


def _known(evaluation: Evaluation) -> list[tuple[str, str]]:
    """What each model was given before the first run, once where several were given the same."""
    alike: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for model in evaluation.models:
        if model.known:
            alike.setdefault(tuple(model.known.items()), []).append(model.name)
    return [
        (f"Known beforehand by {', '.join(models)}: {name}", text)
        for told, models in alike.items()
        for name, text in told
    ]


def _worth(evaluation: Evaluation) -> dict[str, Columns]:
    """The table of what each idea is worth in cross-validation under its name; empty where no model had any."""
    rows = [(m.name, name, error * CM) for m in evaluation.models for name, error in m.worth.items()]
    if not rows:
        return {}
    models, names, errors = (list(column) for column in zip(*rows, strict=True))
    return {"worth": {"model": models, "with": names, "error_cm": errors}}


def _views(evaluation: Evaluation) -> tuple[list[ShownView], str]:
    """The worst run of the best model in three dimensions, or why there is no such view."""
    from evaluation.drawing.interactive import interactive_view, shown_states

    reference = evaluation.reference
    best = evaluation.ranked[0]
    errors = evaluation.scores[best.label].of_runs
    run = evaluation.split.test[int(np.nanargmax(errors))]
    shown = shown_states(len(reference.time))  # others are not predicted: a run of a large mesh is large
    try:
        html = interactive_view(
            reference.position_of(run), reference.faces, reference.time[shown], reference.displacement(run)[shown],
            evaluation.lifted(best, run, shown.tolist()), names=("truth", best.label),
            title=f"{reference.runs[run]}: {best.label}",
            alive=None if reference.alive is None else reference.alive(run)[shown], levels=reference.levels,
        )  # fmt: skip
    except EvaluationError as error:
        return [], f"the interactive view ({error})"
    caption = (
        f"{called(reference.runs[run])}, the worst of {best.label}, the most accurate model: truth beside "
        f"prediction. Turn both "
        f"with the mouse or a finger, and move the slider through time."
    )
    return [ShownView(f"{called(reference.runs[run])} in three dimensions", caption, html)], ""


def _subtitle(evaluation: Evaluation) -> str:
    reference = evaluation.reference
    name = reference.attributes.get("title") or evaluation.context.get("Dataset", "")
    return (
        f"{name + ': ' if name else ''}{len(evaluation.leaders)} models on {len(evaluation.runs)} test runs that "
        f"none of "
        f"them has seen; {len(reference.time)} states of {reference.n_nodes} nodes, which move by "
        f"{evaluation.size * CM:.1f} cm on average"
    )


def _key_table(performance: Columns) -> ShownTable:
    several = any(v == v for v in performance["spread_cm"])
    headings = {k: v for k, v in _HEADINGS.items() if several or k != "spread_cm"}
    note = "Lengths on the full mesh. The best of a column is set in bold; explanations are under Methods."
    return show_table("Performance", performance, note, headings, _LOWEST)


def _tables(performance: Columns, all_tables: Mapping[str, Columns]) -> list[ShownTable]:
    return [
        show_table("Performance, further columns", performance, "", _FURTHER_HEADINGS, _LOWEST),
        show_table("Worst run, worst node, worst time", all_tables["worst"], "Nodes carry the solver's own numbers."),
        *(
            [
                show_table(
                    "Ratings of the curves",
                    all_tables["ratings"],
                    "ISO/TS 18571 of resultant curves at the probes, mean and lowest over the test runs.",
                )
            ]
            if "ratings" in all_tables
            else []
        ),
        *(
            [
                show_table(
                    "Numbers and histories",
                    all_tables["numbers"],
                    "Numbers by formula and time histories, in SI units: mean over the test runs; ratings after ISO/TS 18571.",
                )
            ]
            if "numbers" in all_tables
            else []
        ),
        *(
            [
                show_table(
                    "Known before the first run: what each idea is worth",
                    all_tables["worth"],
                    "Mean node error, cm, of a process over whole runs in cross-validation over the training runs.",
                )
            ]
            if "worth" in all_tables
            else []
        ),
        show_table("Every test run", all_tables["runs"], "Mean node error over nodes and time, cm."),
        show_table("What each run was used for", all_tables["split"]),
    ]


def _file_table(evaluation: Evaluation, folder: Path) -> list[ShownTable]:
    """Where the ParaView files lie, seen from the page."""
    inside = [p.relative_to(folder).as_posix() for p in evaluation.files if p.is_relative_to(folder)]
    return [show_table("Files for ParaView", {"file": inside})] if inside else []


def _details(evaluation: Evaluation) -> list[tuple[str, str]]:
    """Each configuration once, as `crashkit train --config` reads it, under the models that have it."""
    import yaml

    alike: dict[str, list[ComparedModel]] = {}
    for model in evaluation.models:
        text = yaml.safe_dump(plain_json(dict(model.configuration)), default_flow_style=None, width=100)
        alike.setdefault(text, []).append(model)
    return [(f"Configuration of {', '.join(map(_with_seed, models))}", text) for text, models in alike.items()]


def _with_seed(model: ComparedModel) -> str:
    if model.seed is None:
        return model.name
    several = f"mean of {model.averaged} trainings, seeds from " if model.averaged > 1 else "seed "
    return f"{model.name} ({several}{model.seed})"
