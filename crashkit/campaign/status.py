"""The state of a campaign as one HTML page, written anew after each event; no script, no network."""

from __future__ import annotations

import datetime
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crashkit.campaign.box import CampaignError
from crashkit.campaign.campaign import Campaign
from crashkit.campaign.table import STATES
from data_schema.replace import beside

COLOURS = {"waiting": "#9aa5b1", "running": "#2f7ed8", "done": "#2e9e5b", "failed": "#d64545", "refused": "#e0902f"}
_SIZE, _PAD = 150.0, 8.0


def status(campaign: Campaign) -> dict[str, Any]:
    """Counts of runs by state, the rounds, seconds of solver time, and the error to reach."""
    runs = campaign.table.runs()
    counts = {state: sum(r.state == state for r in runs) for state in STATES}
    seconds = sum(r.seconds or 0.0 for r in runs)
    return {
        "folder": str(campaign.folder), "runs": len(runs), **counts, "solver_seconds": seconds,
        "rounds": campaign.table.rounds(), "target_m": campaign.plan.target(),
        "trouble": {r.name: f"{r.state}: {r.reason}" for r in runs if r.state in ("failed", "refused")},
    }  # fmt: skip


def write_page(campaign: Campaign) -> Path:
    """Write FOLDER/status.html."""
    from jinja2 import Environment, PackageLoader

    runs = campaign.table.runs()
    plan = campaign.plan
    points = campaign.points()
    pairs = [
        {
            "x": plan.names[a],
            "y": plan.names[b],
            "dots": _dots(points[:, [a, b]], plan.low[[a, b]], plan.high[[a, b]], runs),
        }
        for a, b in combinations(range(len(plan.names)), 2)
    ]
    environment = Environment(loader=PackageLoader("crashkit.campaign", "templates"), autoescape=True)
    found = status(campaign)
    text = environment.get_template("status.html").render(
        title=campaign.file.stem, status=found, runs=runs, names=plan.names, units=plan.units, pairs=pairs,
        colours=COLOURS, curve=_curve(found["rounds"], plan.target()), size=_SIZE,
        now=datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M:%S UTC"),
    )  # fmt: skip
    page = campaign.folder / "status.html"
    try:
        with beside(page) as new:
            new.write_text(text, encoding="utf-8")
    except OSError as error:
        raise CampaignError(
            f"{page}: cannot be written ({error.strerror or error}); free space, then start the campaign again"
        ) from error
    return page


def _dots(
    points: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64], runs: list[Any]
) -> list[dict[str, Any]]:
    unit = (points - low) / (high - low)
    return [
        {
            "x": round(_PAD + float(p[0]) * (_SIZE - 2 * _PAD), 1),
            "y": round(_SIZE - _PAD - float(p[1]) * (_SIZE - 2 * _PAD), 1),
            "colour": COLOURS[run.state],
            "name": f"{run.name}: {run.state}",
        }
        for p, run in zip(unit, runs, strict=True)
    ]


# Room for a digit, and for " mm" with what lies around a label, in the drawing's font of 11 pixels.
_DIGIT, _UNIT = 7.5, 36.0


def _curve(rounds: list[dict[str, Any]], target: float | None) -> dict[str, Any] | None:
    """Error over runs with its interval, as points of a drawing 480 x 220; lengths in mm, logarithmic."""
    known = [r for r in rounds if r.get("error_m")]
    if not known:
        return None
    values = [v for r in known for v in (r["low_m"], r["high_m"], r["error_m"])] + ([target] if target else [])
    first, last = min(values) * 0.9e3, max(values) * 1.1e3
    most = max(r["runs"] for r in known)
    ticks = [(float(v), f"{v:.3g}") for v in np.geomspace(first, last, 4)]
    width, height, bottom = 480.0, 220.0, 26.0
    left = _UNIT + _DIGIT * max(len(text) for _, text in ticks)

    def place(runs: float, value: float) -> tuple[float, float]:
        up = np.log(value * 1e3 / first) / np.log(last / first)
        return (
            round(left + (width - left - 10) * runs / most, 1),
            round(height - bottom - (height - bottom - 8) * float(up), 1),
        )

    return {
        "width": width, "height": height, "left": left, "bottom": height - bottom,
        "points": [
            {"at": place(r["runs"], r["error_m"]), "low": place(r["runs"], r["low_m"]), "high": place(r["runs"], r["high_m"]),
             "text": f"{r['runs']} runs: {1e3 * r['error_m']:.3g} mm ({1e3 * r['low_m']:.3g} to {1e3 * r['high_m']:.3g})"}
            for r in known
        ],
        "target": None if target is None else place(0, target)[1],
        "ticks": [(text, place(0, v / 1e3)[1]) for v, text in ticks],
        "last": most,
    }  # fmt: skip
