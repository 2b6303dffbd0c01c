"""A scatter as a folder: one page, figures, tables."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.drawing.style import MS, Sheet, readable
from evaluation.figures.kind import Columns, to_csv
from evaluation.report.page import Page, plain_json, render_page, show_figure, show_table
from evaluation.report.verdict import Statement
from evaluation.scatter.figures import drawings
from evaluation.scatter.result import ScatterResult

_RULES = (
    "The probability of a limit is the share of the draws that break it. Sampling: Clopper-Pearson interval. Model: the "
    "same draws once more with other models drawn from the model's own uncertainty; both: a draw of the model, then of the "
    "number of draws. Folding modes count where groups are clearly tighter than those of a linear answer to the same draws."
)


def write_scatter(result: ScatterResult, folder: Path, done: Callable[[str], None] | None = None) -> Path:
    """Write scatter.html, scatter.json, draws.csv, numbers.csv and figures/ into `folder`; returns the page."""
    folder.mkdir(parents=True, exist_ok=True)
    shown = []
    for kind, drawing in drawings(result):
        shown.append(show_figure(kind, drawing, folder / "figures", Sheet(), folder))
        if done:
            done(kind.name)
    numbers, limits = number_table(result), limit_table(result)
    (folder / "draws.csv").write_text(to_csv(draw_table(result)), encoding="utf-8")
    (folder / "numbers.csv").write_text(to_csv(numbers), encoding="utf-8")
    said = statements(result)
    tables = [show_table("Parts", part_table(result))]
    if result.limits:
        tables.insert(0, show_table("Limits", limits, "Probabilities in per cent, intervals with both doubts."))
    page = Page(
        title=f"Scatter of {result.about.get('Model', 'a model')}",
        subtitle=f"{len(result.draws)} draws of {', '.join(s.name.replace('_', ' ') for s in result.scatter)}",
        statements=said,
        rules=_RULES,
        key_table=show_table("Numbers", numbers, "Over all draws; 5 % of them lie below the column 5 %."),
        figures=shown,
        methods=list(result.about.items()),
        tables=tables,
    )
    told: dict[str, Any] = {
        "numbers": numbers, "limits": [_limit(limit) for limit in result.limits], "parts": part_table(result),
        "scatter": [asdict(s) for s in result.scatter], "nominal": dict(result.nominal),
        "influence": {
            "number": [n.name for n in result.numbers], "parameter": [s.name for s in result.scatter],
            "first": result.indices.first, "total": result.indices.total, "predictions": result.indices.runs,
        },
        "folding": {
            "groups": result.folding.count, "share": np.bincount(result.folding.group) / len(result.folding.group),
            "typical_draw": result.folding.typical,
        },
        "share_inside_trained_range": float(result.inside.mean()), "doubt": result.doubt,
        "warnings": list(result.warnings), "about": dict(result.about),
        "statements": [asdict(s) for s in said],
    }  # fmt: skip
    (folder / "scatter.json").write_text(json.dumps(plain_json(told), indent=1), encoding="utf-8")
    path = folder / "scatter.html"
    path.write_text(render_page(page), encoding="utf-8")
    return path


def statements(result: ScatterResult) -> list[Statement]:
    """What the numbers say, in words."""
    out = []
    for limit in result.limits:
        p = limit.probability
        low, high = (100 * v for v in p.both)
        text = f"{limit.text} is broken with a probability of {100 * p.value:.2f} % ({low:.2f} to {high:.2f} %)."
        if limit.outside > 0:
            text += f" {100 * limit.outside:.2f} % of it comes from draws outside the trained range."
        out.append(Statement("finding", "Limit", text))
    for number, total in zip(result.numbers, result.indices.total, strict=True):
        low, high = number.quantiles([0.05, 0.95])
        (a, b), unit = readable(np.array([low, high]), number.unit)
        name, k = number.name.replace("_", " "), int(np.argmax(total))
        by = (
            f", {100 * total[k]:.0f} % of its variance by {result.scatter[k].name.replace('_', ' ')}"
            if total[k] > 0
            else ""
        )
        out.append(Statement("finding", name, f"{a:.4g} to {b:.4g} {unit} in 90 % of the draws{by}."))
    d = result.differences
    part, state = d.source
    if d.new[part, state] > 0:
        text = f"Most new scatter appears in {d.names[part]} at {d.time[state] * MS:.1f} ms."
        out.append(Statement("finding", "Where runs begin to differ", text))
    if result.folding.count > 1:
        shares = ", ".join(f"{100 * v:.0f} %" for v in np.bincount(result.folding.group) / len(result.folding.group))
        out.append(Statement("finding", "Folding modes", f"{result.folding.count} groups of shapes: {shares}."))
    out += [Statement("warning", "Outside the trained range", sentence) for sentence in result.warnings]
    if not result.doubt and result.limits:
        text = "The model has no band: its own error is in no interval here."
        out.append(Statement("warning", "Model", text))
    return out


def number_table(result: ScatterResult) -> dict[str, list[object]]:
    """A row a number, in the units that people read."""
    rows = []
    for number in result.numbers:
        values = [
            number.nominal, float(np.nanmean(number.values)), float(np.nanstd(number.values)),
            *number.quantiles([0.05, 0.5, 0.95]),
        ]  # fmt: skip
        shown, unit = readable(np.array(values, np.float64), number.unit)
        rows.append((number.name, unit or "-", *(float(v) for v in shown), number.text))
    heads = ("number", "unit", "nominal", "mean", "deviation", "5 %", "median", "95 %", "formula")
    return _columns(heads, rows)


def limit_table(result: ScatterResult) -> dict[str, list[object]]:
    """A row a limit, in per cent."""
    rows = []
    for limit in result.limits:
        p = limit.probability
        model = p.model or (np.nan, np.nan)
        values = (p.value, *p.both, *p.sampling, *model, limit.outside)
        rows.append((limit.text, *(100 * float(v) for v in values)))
    heads = (
        "limit", "broken", "from", "to", "sampling from", "sampling to", "model from", "model to", "outside",
    )  # fmt: skip
    return _columns(heads, rows)


def part_table(result: ScatterResult) -> dict[str, list[object]]:
    """A row a part: when it begins to differ, how much it scatters, when most of it was new."""
    d = result.differences
    rows = []
    for k, name in enumerate(d.names):
        peak = int(np.argmax(d.new[k]))
        rows.append(
            (name, float(d.begin[k] * MS), float(d.scatter[k, -1] * 100), float(d.time[peak] * MS),
             float(d.new[k, peak] * 100), float(100 * d.share[k]))
        )  # fmt: skip
    heads = (
        "part",
        "begins to differ_ms",
        "scatter at the end_cm",
        "most new at_ms",
        "new there_cm",
        "first component_percent",
    )
    return _columns(heads, rows)


def draw_table(result: ScatterResult) -> Columns:
    """A row a draw: parameters, numbers, mode of folding, within the trained range."""
    columns: dict[str, Any] = {"draw": list(range(len(result.draws)))}
    for k, one in enumerate(result.scatter):
        columns[f"{one.name} ({one.unit})"] = list(result.draws[:, k])
    for number in result.numbers:
        columns[f"{number.name} ({number.unit})"] = list(number.values)
    columns["folding_mode"] = [int(g) + 1 for g in result.folding.group]
    columns["inside_trained_range"] = [bool(v) for v in result.inside]
    return columns


def _limit(limit: Any) -> dict[str, Any]:
    return {"limit": limit.text, "bound": limit.bound, "outside": limit.outside, **asdict(limit.probability)}


def _columns(heads: tuple[str, ...], rows: list[tuple[Any, ...]]) -> dict[str, list[object]]:
    return {head: [row[k] for row in rows] for k, head in enumerate(heads)}
