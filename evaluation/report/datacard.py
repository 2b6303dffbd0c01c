"""The data card: what a crash dataset covers, how it moves, how far it can be reduced, and which runs stand out.

Everything is gathered in one pass over the runs, one at a time.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations_with_replacement
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from crashkit.output import complete_folder
from data_schema.pod import Pod, StreamedPod
from evaluation.comparison.reference import Reference, reference_of
from evaluation.drawing.style import CM, MS, Sheet, readable
from evaluation.errors import EvaluationError
from evaluation.figures.coverage import Coverage
from evaluation.figures.envelopes import Envelopes
from evaluation.figures.kind import Drawing, Kind, to_csv
from evaluation.figures.outliers import Outliers, robust_score
from evaluation.figures.singular_values import SingularValues
from evaluation.measures.distance import gone, largest_node_error, mean_node_error, node_distance
from evaluation.measures.projection import last_seen, moving
from evaluation.report.page import Page, plain_json, render_page, show_figure, show_table
from evaluation.report.verdict import Statement

if TYPE_CHECKING:
    import xarray as xr

N_MODES = 50
SAMPLE_NODES = 64
OUTLIER_LIMIT = 5.0  # robust standard deviations


@dataclass(frozen=True)
class Summary:
    """One pass over the runs of a dataset.

    Attributes
    ----------
    mean, largest
        (run, state) m, displacement over the living nodes.
    speed
        (run,) m/s, the fastest any node moves between two states.
    lost
        (run,) share of nodes gone in the last state.
    samples
        (run, state, sample node, 3) m, NaN where gone.
    pod
        Of all runs.
    """

    mean: NDArray[np.float64]
    largest: NDArray[np.float64]
    speed: NDArray[np.float64]
    lost: NDArray[np.float64]
    samples: NDArray[np.float32]
    pod: Pod


def summarise(reference: Reference, count: int = N_MODES, done: Callable[[int], None] | None = None) -> Summary:
    """Gather the numbers of a data card from every run of `reference`; one run is in memory at a time."""
    stream = StreamedPod(count)
    nodes = np.unique(np.linspace(0, reference.n_nodes - 1, min(SAMPLE_NODES, reference.n_nodes)).astype(int))
    means, largest, speeds, lost, samples = [], [], [], [], []
    for run in range(len(reference.runs)):
        u = reference.displacement(run)
        size = node_distance(u, np.zeros_like(u))
        means.append(mean_node_error(size))
        largest.append(largest_node_error(size))
        speeds.append(_fastest(u, reference.time))
        lost.append(float(gone(u[-1:]).mean()))
        samples.append(u[:, nodes])
        stream.add(last_seen(u))
        if done:
            done(run)
    return Summary(
        np.array(means), np.array(largest), np.array(speeds), np.array(lost), np.array(samples), moving(stream.result())
    )


def _fastest(u: NDArray[np.floating], time: NDArray[np.float64]) -> float:
    """m/s: largest node displacement between two neighbouring states over their time."""
    fastest = 0.0
    for k in range(1, len(time)):
        step = np.linalg.norm(u[k].astype(np.float64) - u[k - 1], axis=-1)
        there = step[np.isfinite(step)]
        fastest = max(fastest, float(there.max(initial=0.0)) / float(time[k] - time[k - 1]))
    return fastest


def surprise(parameters: NDArray[np.float64], samples: NDArray[np.floating]) -> NDArray[np.float64]:
    """(run,) m: mean distance of a run's samples from a polynomial fit through all *other* runs.

    parameters (run, parameter); samples (run, state, node, 3), m. The fit is quadratic in the scaled parameters where
    there are at least three runs a term, else linear, and constant where there are fewer still. Leaving a run out
    costs nothing: its residual is divided by 1 - h, h its diagonal entry of the hat matrix.
    """
    runs = len(parameters)
    low, high = parameters.min(axis=0, initial=np.inf), parameters.max(axis=0, initial=-np.inf)
    x = 2 * (parameters - low) / np.where(high > low, high - low, 1) - 1
    basis = np.ones((runs, 1))
    for degree in (1, 2):
        terms = [np.ones(runs)] + [
            np.prod(x[:, list(chosen)], axis=1)
            for d in range(1, degree + 1)
            for chosen in combinations_with_replacement(range(x.shape[1]), d)
        ]
        if 3 * len(terms) <= runs:
            basis = np.stack(terms, axis=1)
    q, _ = np.linalg.qr(basis)
    there = np.isfinite(samples).all(axis=(0, -1))
    flat = np.nan_to_num(samples.astype(np.float64)).reshape(runs, -1)
    leverage = np.clip(1 - np.square(q).sum(axis=1), 1e-6, None)
    residual = ((flat - q @ (q.T @ flat)) / leverage[:, None]).reshape(samples.shape)
    distance = np.linalg.norm(residual, axis=-1)
    return np.array([float(d[there].mean()) if there.any() else 0.0 for d in distance])


def card_drawings(reference: Reference, summary: Summary) -> list[tuple[Kind, Drawing]]:
    """The figures of the card."""
    drawings: list[tuple[str, str, Drawing]] = []
    outliers = _outliers(reference, summary)
    odd = outliers.score > outliers.limit if outliers else np.zeros(len(reference.runs), bool)
    drawings.append(
        ("envelopes", "How far it moves", Envelopes(reference.time, reference.runs, summary.mean, summary.largest, odd))
    )
    if reference.parameter_names:
        drawings.append(
            (
                "coverage",
                "How the runs cover the design space",
                Coverage(
                    reference.parameter_names, reference.parameter_units, reference.runs, reference.parameters,
                    *np.zeros((2, len(reference.runs)), bool),
                ),
            )
        )  # fmt: skip
    drawings.append(
        (
            "singular_values",
            "How far it can be reduced",
            SingularValues({reference.n_nodes: summary.pod.singular_values}),
        )
    )
    if outliers:
        drawings.append(("outliers", "Runs that stand out", outliers))
    return [(Kind(name, title, lambda _, d=d: d), d) for name, title, d in drawings]  # type: ignore[misc]


def _outliers(reference: Reference, summary: Summary) -> Outliers | None:
    if len(reference.runs) < 5:
        return None
    distance = surprise(reference.parameters, summary.samples)
    return Outliers(reference.runs, distance, robust_score(distance), OUTLIER_LIMIT, summary.speed)


def card_statements(reference: Reference, summary: Summary) -> list[Statement]:
    """What the card says in words."""
    out = []
    values = summary.pod.normalised
    energy = np.cumsum(summary.pod.singular_values**2) / np.sum(summary.pod.singular_values**2)
    need = int(np.searchsorted(energy, 0.999)) + 1
    out.append(
        Statement(
            "finding",
            "Motion",
            f"The structure moves by {np.nanmean(summary.mean) * CM:.1f} cm on average over nodes, time and "
            f"runs, and by at "
            f"most {np.nanmax(summary.largest) * CM:.1f} cm; the fastest node moves at {summary.speed.max():.1f} m/s.",
        )
    )
    out.append(
        Statement(
            "finding",
            "Reduction",
            f"{need} of the {len(values)} modes computed hold 99.9 % of their energy; the second singular value is "
            f"{values[1]:.2f} of the first." if len(values) > 1 else "All runs share one single mode.",
        )
    )  # fmt: skip
    if len(reference.runs) < 10 * max(1, len(reference.parameter_names)):
        out.append(
            Statement(
                "warning",
                "Few runs",
                f"{len(reference.runs)} runs for {len(reference.parameter_names)} parameters: fewer than ten a "
                f"parameter.",
            )
        )
    outliers = _outliers(reference, summary)
    if outliers is not None and (outliers.score > outliers.limit).any():
        names = [outliers.runs[k] for k in np.argsort(-outliers.score) if outliers.score[k] > outliers.limit]
        out.append(
            Statement("warning", "Unusual runs", f"{', '.join(names[:6])}: far from what the other runs suggest.")
        )
    if summary.lost.max() > 0:
        out.append(
            Statement(
                "warning",
                "Eroded nodes",
                f"Up to {100 * summary.lost.max():.1f} % of the nodes are gone at the end of a run; they are "
                f"missing, not "
                f"zero, in every number here.",
            )
        )
    return out


def write_card(
    dataset: xr.Dataset | Reference,
    output: str | Path,
    *,
    title: str | None = None,
    about: Mapping[str, str] | None = None,
    done: Callable[[int], None] | None = None,
) -> Path:
    """Write the data card of `dataset` into the folder `output` and return the page, `card.html`.

    Figures (PNG, SVG, CSV) and card.json stand beside the page. The folder appears when it is complete.

    Parameters
    ----------
    about
        Further lines for the methods section, such as the path and size of the dataset.
    done
        Called with the run number as each run is read.

    Raises
    ------
    EvaluationError
        For a dataset without motion.
    OutputError
        Where `output` cannot be written.
    """
    reference = dataset if isinstance(dataset, Reference) else reference_of(dataset)
    if not reference.runs:
        raise EvaluationError("the dataset holds no run; expected at least one to describe")
    folder = Path(output)
    with complete_folder(folder, "card.json") as partial:
        summary = summarise(reference, done=done)
        drawings = card_drawings(reference, summary)
        shown = [show_figure(kind, drawing, partial / "figures", Sheet(), partial) for kind, drawing in drawings]
        runs = _run_table(reference, summary)
        (partial / "runs.csv").write_text(to_csv(runs), encoding="utf-8")
        statements = card_statements(reference, summary)
        name = title or reference.attributes.get("title") or "Crash dataset"
        page = Page(
            title=name,
            subtitle=(
                f"{len(reference.runs)} runs, {len(reference.time)} states from {reference.time[0] * MS:.4g} to "
                f"{reference.time[-1] * MS:.4g} ms, {reference.n_nodes} nodes in {len(reference.part_names)} "
                f"part{'' if len(reference.part_names) == 1 else 's'}"
            ),
            statements=statements,
            rules=(
                f"A run stands out if its distance from a polynomial fit through all other runs is more than "
                f"{OUTLIER_LIMIT:g} robust standard deviations above the median of all runs."
            ),
            figures=shown,
            methods=[*(about or {}).items(), *_facts(reference)],
            tables=[
                show_table("Runs", runs),
                show_table("Parameters", _parameter_table(reference)),
            ],
        )
        (partial / "card.html").write_text(render_page(page), encoding="utf-8")
        numbers = {
            "runs": runs,
            "parameters": _parameter_table(reference),
            "singular_values_normalised": summary.pod.normalised,
            "statements": [{"kind": s.kind, "about": s.about, "text": s.text} for s in statements],
            "figures": {kind.name: drawing.numbers() for kind, drawing in drawings},
        }
        (partial / "card.json").write_text(json.dumps(plain_json(numbers), indent=1), encoding="utf-8")
    return folder / "card.html"


def _run_table(reference: Reference, summary: Summary) -> dict[str, list[object]]:
    table: dict[str, list[object]] = {"run": list(reference.runs)}
    for k, (name, unit) in enumerate(zip(reference.parameter_names, reference.parameter_units, strict=True)):
        table[f"{name} ({unit})"] = [float(v) for v in reference.parameters[:, k]]
    table["mean_displacement_at_end_cm"] = [float(v) * CM for v in summary.mean[:, -1]]
    table["largest_displacement_cm"] = [float(v) * CM for v in np.nanmax(summary.largest, axis=1)]
    table["fastest_node_m_per_s"] = [float(v) for v in summary.speed]
    table["nodes_gone_at_end_percent"] = [100 * float(v) for v in summary.lost]
    return table


def _parameter_table(reference: Reference) -> dict[str, list[object]]:
    table: dict[str, list[object]] = {name: [] for name in ("parameter", "unit", "smallest", "median", "largest")}
    for name, unit, column in zip(
        reference.parameter_names, reference.parameter_units, reference.parameters.T, strict=True
    ):
        values, shown = readable(column, unit)
        row = (name, shown, float(values.min()), float(np.median(values)), float(values.max()))
        for column_name, value in zip(table, row, strict=True):
            table[column_name].append(value)
    return table


def _facts(reference: Reference) -> list[tuple[str, str]]:
    known = {
        "Checksum (SHA-256)": reference.checksum,
        "Solver": reference.attributes.get("solver", ""),
        "Units read": reference.attributes.get("units_read", ""),
        "Parts": ", ".join(reference.part_names),
        "Written by": f"crashkit {reference.attributes.get('crashkit_version', '')}".strip(),
    }
    return [(name, value) for name, value in known.items() if value]
