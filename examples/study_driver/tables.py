"""From stored models and the report to tables (.csv, .md), learning curves and intervals."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import crashkit
from data_schema import parameters
from evaluation.drawing.style import Style
from evaluation.figures import Sheet, styles
from evaluation.figures.kind import Columns, to_csv, write
from evaluation.measures.distance import mean_node_error, node_distance
from study_driver.driver import Study
from study_driver.jobs import Job, Kind, alone, quick

UNITS = {"cm": 100.0, "mm": 1000.0}  # of a metre
KINDS = ("approximation", "reconstruction")
SHOWN = ("seeds", "error_cm", "spread_cm", "relative", "worst_run_cm", "reduction_cm", "lifting_cm", "parameters",
         "prediction_ms", "prediction_lifted_ms")  # fmt: skip


@dataclass(frozen=True)
class LearningCurves:
    """Mean node error, m, over the test runs against the number of training runs: model -> one value for each size."""

    sizes: tuple[int, ...]
    errors: dict[str, list[float]]
    unit: str = "cm"

    def numbers(self) -> Columns:
        rows = [
            (m, n, UNITS[self.unit] * e)
            for m, errors in self.errors.items()
            for n, e in zip(self.sizes, errors, strict=True)
        ]
        return columns(("model", "training_runs", f"mean_node_error_{self.unit}"), rows)

    def draw(self, sheet: Sheet) -> Any:
        figure, (axes,) = sheet.panels(1, height=7.5)
        self.draw_on(axes, sheet)
        sheet.legend(figure, axes)
        return figure

    def draw_on(self, axes: Any, sheet: Sheet) -> None:
        """The curves on axes that may have a figure of several beside them."""
        for model, errors in self.errors.items():
            style = sheet.style(model)
            known = np.isfinite(errors)
            axes.plot(
                np.array(self.sizes)[known], UNITS[self.unit] * np.array(errors)[known], style.marker,
                linestyle=style.line, color=style.colour, label=model,
            )  # fmt: skip
        axes.set_xscale("log", base=2)
        axes.set_xticks(self.sizes, [str(n) for n in self.sizes])
        axes.minorticks_off()
        axes.set_ylim(bottom=0)
        axes.set_xlabel("training runs")
        axes.set_ylabel(f"mean node error ({self.unit})")

    def caption(self) -> str:
        return "Mean node error on the full mesh, over the same test runs, against the number of training runs."


def curve_styles(labels: Sequence[str]) -> dict[str, Style]:
    """Colour and marker of the model; what a note sets apart ("POD-GPR without physics") has another line."""
    models = styles(list(dict.fromkeys(label.split(" ")[0] for label in labels)))
    lines: dict[str, list[str]] = {}
    out = {}
    for label in labels:
        model = label.split(" ")[0]
        lines.setdefault(model, []).append(label)
        line = ("-", "--", ":", "-.")[(len(lines[model]) - 1) % 4]
        out[label] = Style(models[model].colour, line, models[model].marker)
    return out


class TestRuns:
    """The test runs' true displacements, and the error of predictions on them."""

    __test__ = False  # pytest takes it for tests

    def __init__(self, study: Study) -> None:
        dataset = crashkit.open_dataset(study.data).isel(sim=slice(study.plan.train, study.plan.runs))
        self.parameters = np.stack([dataset[n].values for n in parameters(dataset)], axis=1)
        self.truth = dataset["displacement"]

    def error(self, predict: Callable[[np.ndarray], np.ndarray]) -> float:
        """e2, m: mean over nodes, states and runs of the distance to `predict(parameters)` (state, node, 3)."""
        of_runs = [
            mean_node_error(node_distance(self.truth.isel(sim=k).values, predict(values))).mean()
            for k, values in enumerate(self.parameters)
        ]
        return float(np.mean(of_runs))


def learning_curves(study: Study, test: TestRuns) -> LearningCurves:
    """Every kind of the plan's curves, and every level of a cascade, with seed 0; what is not trained is NaN."""
    few = study.plan.few(study.short)
    sizes: tuple[int | None, ...] = (*few, None)
    errors: dict[str, list[float]] = {}
    for kind in study.plan.curves:
        for k, runs in enumerate(sizes):
            job = Job(quick(kind) if study.short else kind, 0, runs)
            if not study.trained(job):
                continue
            model = crashkit.load_model(study.home / job.folder).surrogate
            for name, level in model.level_names.items():
                found = errors.setdefault(kind.label(name), [np.nan] * len(sizes))
                found[k] = test.error(lambda p, m=model, k=level: m.predict_full(p, level=k))
    return LearningCurves((*few, study.plan.train), errors, study.plan.unit)


def averaged(study: Study, test: TestRuns, kinds: Sequence[Kind]) -> float:
    """e2, m, of the mean prediction of `kinds`, all their seeds, each on its finest level."""
    jobs = [Job(kind, seed) for kind in kinds for seed in range(study.seeds)]
    models = [crashkit.load_model(study.home / job.folder).surrogate for job in jobs]
    return test.error(lambda p: np.mean([m.predict_full(p) for m in models], axis=0))


@dataclass(frozen=True)
class Row:
    """A row of the report: what the report and what the study call it, its kind, level by name, and its numbers."""

    label: str
    name: str
    kind: Kind
    level: str
    numbers: Mapping[str, Any]


def rows(study: Study) -> list[Row]:
    """The report's rows of performance."""
    numbers = {
        row["model"]: row
        for row in json.loads((study.home / "report" / "report.json").read_text(encoding="utf-8"))["performance"]
    }
    jobs: dict[Kind, list[Job]] = {}
    for job in study.compared():
        jobs.setdefault(job.kind, []).append(job)
    levels = [
        (kind, level)
        for kind, trained in jobs.items()
        for level in crashkit.load_model(study.home / trained[0].folder).surrogate.level_names
    ]
    times = [level for _, level in levels]
    out = []
    for kind, level in levels:
        folder = kind.name if len(jobs[kind]) > 1 else jobs[kind][0].folder.name
        label = level if times.count(level) == 1 else f"{level} ({folder})"
        out.append(Row(label, kind.label(level), kind, level, numbers[label]))
    order = list(numbers)
    return sorted(out, key=lambda row: order.index(row.label))


def performance(study: Study, found: Sequence[Row]) -> Columns:
    """The study's table, lengths in its unit, with the seconds of training alone."""
    factor = UNITS[study.plan.unit] / UNITS["cm"]
    out: dict[str, list[Any]] = {"model": [row.name for row in found]}
    for name in SHOWN:
        values = [row.numbers[name] for row in found]
        length = name.endswith("_cm")
        shown = name.removesuffix("_cm") + f"_{study.plan.unit}" if length else name
        out[shown] = [None if v is None else v * factor if length else v for v in values]
    return out | dict(timed_alone(study, found))


def errors(found: Sequence[Row]) -> dict[str, float]:
    """e2, m, by the name of the row."""
    return {row.name: row.numbers["error_cm"] / UNITS["cm"] for row in found}


def timed_alone(study: Study, found: Sequence[Row]) -> Columns:
    """Seconds an epoch of each level while nothing else ran, and of a whole training with the levels it starts from.

    What is not trained by epochs, and what was not timed, keeps the seconds of the report.
    """
    each: dict[str, float] = {}
    whole = {row.name: row.numbers["training_s"] for row in found}
    for kind in dict.fromkeys(row.kind for row in found):
        timing = Job(alone(_as_planned(study, kind)))
        if not study.trained(timing):
            continue
        timed = crashkit.load_model(study.home / timing.folder).surrogate
        trained, total = crashkit.load_model(study.home / Job(kind).folder).surrogate, 0.0
        for name, level in timed.level_names.items():  # coarsest first
            each[kind.label(name)] = timed.record.fits[level].seconds / timed.record.fits[level].epochs
            total += each[kind.label(name)] * trained.record.fits[level].epochs
            whole[kind.label(name)] = total
    return {
        "seconds_per_epoch": [each.get(row.name) for row in found],
        "training_s": [whole[row.name] for row in found],
    }


def _as_planned(study: Study, kind: Kind) -> Kind:
    """The kind of the table, of which `kind` may be the short version."""
    return next(k for k in study.plan.table if k.name == kind.name)


def on_coarse_meshes(study: Study, found: Sequence[Row]) -> Columns:
    """Errors on the nodes of each coarse level: of the cascade's own model there, and of what works on the full mesh."""
    names = {row.label: row.name for row in found}
    factor = UNITS[study.plan.unit] / UNITS["cm"]
    with (study.home / "report" / "figures" / "levels.csv").open(encoding="utf-8", newline="") as file:
        lines = [
            (
                int(line["nodes"]), names.get(line["model"], line["model"]),
                *(factor * float(line[f"{kind}_cm"] or "nan") for kind in KINDS),
            )
            for line in csv.DictReader(file)
            if line["level"] != "0" and (line["prediction_is"] == "own" or not line["model"].startswith("MH"))
        ]  # fmt: skip
    heads = ("nodes", "model", *(f"{kind}_{study.plan.unit}" for kind in KINDS))
    return columns(heads, sorted(lines, key=lambda line: -line[0]))


def intervals(study: Study, found: Sequence[Row], reference: str) -> Columns:
    """95 % intervals of each mean error, and of its difference to that of `reference`, over draws of the test runs.

    Bootstrap by percentiles with 10 000 draws. With a dozen runs such intervals are a little narrow.
    """
    from scipy.stats import bootstrap

    factor = UNITS[study.plan.unit] / UNITS["cm"]
    with (study.home / "report" / "tables" / "runs.csv").open(encoding="utf-8", newline="") as file:
        lines = list(csv.DictReader(file))
    of_runs = {row.name: np.array([factor * float(line[f"{row.label} (cm)"]) for line in lines]) for row in found}

    def interval(values: np.ndarray) -> tuple[float, float]:
        if np.ptp(values) == 0 or len(values) < 2:
            return float(values[0]), float(values[0])
        drawn = bootstrap((values,), np.mean, n_resamples=9999, method="percentile", rng=np.random.default_rng(0))
        return float(drawn.confidence_interval.low), float(drawn.confidence_interval.high)

    out = []
    for name, values in of_runs.items():
        line: tuple[Any, ...] = (name, float(values.mean()), *interval(values))
        if reference in of_runs and name != reference:
            more = values - of_runs[reference]
            line += (float(more.mean()), *interval(more), int((more < 0).sum()))
        else:
            line += (None,) * 4
        out.append(line)
    unit = study.plan.unit
    heads = (
        "model", f"error_{unit}", "from", "to", f"more_than_{reference}", "from_", "to_", "better_on_runs",
    )  # fmt: skip
    return columns(heads, out)


def worth(study: Study, kind: Kind) -> Columns:
    """What each idea of physics is worth to `kind` in cross-validation over the training runs, by their number."""
    told: dict[int, Mapping[str, float]] = {}
    for runs in (*study.plan.few(study.short), None):
        job = Job(quick(kind) if study.short else kind, 0, runs)
        if study.trained(job):
            told[runs or study.plan.train] = crashkit.load_model(study.home / job.folder).record.physics["errors"]
    names = dict.fromkeys(name for of in told.values() for name in of)
    factor = UNITS[study.plan.unit]
    return columns(
        (f"left_out_error_{study.plan.unit}", *(f"{runs}_runs" for runs in told)),
        [(name, *(factor * of.get(name, np.nan) for of in told.values())) for name in names],
    )


def regressions(study: Study) -> Columns:
    """What each level of a cascade predicts its latent numbers with, as folds chose, with the first seed.

    process: a Gaussian process over whole runs; 50 % process: its mean with networks.
    """
    lines = []
    cascades = [job for job in study.jobs() if job.kind.model == "mh" and job.seed == 0 and study.trained(job)]
    for job in cascades:
        surrogate = crashkit.load_model(study.home / job.folder).surrogate
        for level in surrogate.level_names:
            told = str(surrogate.record.choice.get(level, "network")).split(" (")[0]  # without the errors of the others
            lines.append((job.kind.label(level), job.runs or study.plan.train, told))
    return columns(("model", "training_runs", "from_parameters_to_latent_numbers"), lines)


def not_trained(study: Study) -> Columns:
    """What the plan names and nobody has trained: by model, training runs and seeds."""
    seeds: dict[tuple[str, int], list[int]] = {}
    for job in study.missing():
        seeds.setdefault((job.kind.name, job.runs or study.plan.train), []).append(job.seed)
    return columns(("model", "training_runs", "seeds"), [(*key, ", ".join(map(str, of))) for key, of in seeds.items()])


def markdown(shown: Columns) -> str:
    """Columns as a table for a page."""
    head = [name.replace("_", " ").strip() for name in shown]
    body = [[_cell(v) for v in row] for row in zip(*shown.values(), strict=True)]
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *body]) + "\n"


def _cell(value: Any) -> str:
    if value is None or value != value:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def columns(names: Sequence[str], lines: Iterable[Sequence[Any]]) -> Columns:
    """Lines as columns; columns that are empty where there are no lines."""
    lines = list(lines)
    return dict(zip(names, map(list, zip(*lines, strict=True)), strict=True)) if lines else {n: [] for n in names}


def write_tables(study: Study, tables: Mapping[str, Columns], curves: LearningCurves) -> list[Path]:
    """Write tables (.csv, .md) and the learning curves into the folder results of the study; returns the paths."""
    folder = study.home / "results"
    folder.mkdir(exist_ok=True)
    paths = []
    for name, found in tables.items():
        paths += [folder / f"{name}.csv", folder / f"{name}.md"]
        paths[-2].write_text(to_csv(found), encoding="utf-8")
        paths[-1].write_text(markdown(found), encoding="utf-8")
    written, _ = write(curves, "learning_curves", folder, Sheet(styles=curve_styles(list(curves.errors))))
    return [*paths, *written]
