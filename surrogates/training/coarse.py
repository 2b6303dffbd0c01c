"""Coarse runs beside a training: what they go with, and what the record says of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from surrogates.data.campaign import Campaign, CoarseRuns
from surrogates.data.samples import FEWEST_TO_SPLIT, Notes
from surrogates.errors import SurrogateError
from surrogates.models.coarse_fit import CoarseFit
from surrogates.record import Record
from surrogates.regression.beneath import ALONE, EVERYWHERE, OF_QUERY, WAYS, Beneath
from surrogates.settings import Settings

# Slopes that are told, of the largest modes.
_TOLD = 6
# Models that take coarse runs.
_TAKING = ("mh", "pod-gpr")


def check_coarse_settings(settings: Settings) -> None:
    """Raise SurrogateError where coarse runs do not go with the settings; says which one to change."""
    if settings.model not in _TAKING:
        raise SurrogateError(
            f"coarse runs go beneath mh and pod-gpr, and the model is {settings.model}; train --model mh or pod-gpr"
        )
    if settings.model == "pod-gpr":
        if settings.pod.inputs == "point":
            raise SurrogateError("coarse runs need one sample per run; leave out pod.inputs=point")
        return
    levels = [settings.for_level(k) for k in (*settings.at, *settings.levels, *(() if settings.levels else (-1,)))]
    if all(level.regression == "network" for level in levels):
        raise SurrogateError(
            "coarse runs go beneath the processes of the levels, and level.regression=network has none; leave it out, or "
            "the preset paper"
        )
    against = {
        "validation.measure=paper": settings.validation.measure == "paper",
        "validation.runs": bool(settings.validation.runs),
        "unified": settings.unified,
        "inputs.initial_state": settings.inputs.initial_state,
        "level.regression=network": any(v.regression == "network" and v.reduction != "pod" for v in levels),
    }
    found = next((name for name, there in against.items() if there), None)
    if found is not None:
        raise SurrogateError(
            f"what coarse runs are worth on a level is chosen by folds, which {found} rules out; leave it out"
        )


def check_coarse(campaign: Campaign, settings: Settings, notes: Notes) -> None:
    """Raise SurrogateError where coarse runs are given to a training that does not take them; note what is odd about them."""
    if campaign.coarse is None:
        return
    for line in campaign.coarse.notes:
        notes.add(line)
    check_coarse_settings(settings)
    runs = len(campaign.parameters)
    if settings.model == "mh" and runs < FEWEST_TO_SPLIT:
        raise SurrogateError(
            f"what coarse runs are worth on a level is chosen by folds over at least {FEWEST_TO_SPLIT} fine runs; found {runs}"
        )


def note_coarse(record: Record, coarse: CoarseRuns, found: CoarseFit) -> None:
    """Keep in the record what coarse runs there were and what folds said of them."""
    slopes = [] if found.base is None else [float(slope) for slope in found.base.slopes]
    record.coarse = {
        **_about(coarse, found.runs, found.twins),
        "way": found.way,
        "slopes": slopes,
        "errors": found.errors,
    }
    record.physics["coarse runs"] = told_coarse(record)


def note_coarse_levels(record: Record, coarse: CoarseRuns, levels: Mapping[str, Beneath]) -> None:
    """The same for the levels of a cascade, the finest one last, by name; with several seeds each has a name of its own.

    What stands for the whole is the finest level that uses them.
    """
    if not levels:
        return
    using = [found for found in levels.values() if found.way != ALONE]
    finest = (using or list(levels.values()))[-1]
    record.coarse = {
        **_about(coarse, finest.runs, finest.twins), **_of_level(finest),
        "levels": {name: _of_level(found) for name, found in levels.items()},
    }  # fmt: skip
    told = told_levels(record)
    record.physics["coarse runs"] = _named(record.coarse)
    record.physics |= {f"coarse runs on {name}": line for name, line in told.items()}


def _about(coarse: CoarseRuns, runs: int, twins: int) -> dict[str, Any]:
    campaign = coarse.campaign
    about = campaign.attributes or {}
    return {
        "dataset": about.get("dataset", ""),
        "checksum": campaign.checksum,
        "units": about.get("units_read", ""),
        "runs": runs,
        "twins": twins,
        "nodes": campaign.n_nodes,
    }


def _of_level(found: Beneath) -> dict[str, Any]:
    return {"way": found.way, "slopes": [float(slope) for slope in found.slopes], "errors": found.errors}


def _named(about: Mapping[str, Any]) -> str:
    """Which coarse runs there are."""
    mark = about["checksum"][:12] or "not recorded"
    return f"{about['runs']} runs of {about['dataset']} ({about['nodes']} nodes, checksum {mark})"


def told_levels(record: Record) -> dict[str, str]:
    """What coarse runs are worth on each level, in one line each."""
    out = {}
    for name, level in record.coarse.get("levels", {}).items():
        errors, way = level["errors"], level["way"]
        if not errors:
            out[name] = "not used: there are too few fine runs to tell what they bring"
            continue
        alone, best = errors[ALONE], min(error for tried, error in errors.items() if tried in WAYS)
        if way == ALONE:
            why = "the network alone is as good" if EVERYWHERE in errors else f"{100 * best:.2f} cm with them"
            out[name] = f"not used: process {100 * alone:.2f} cm, {why} in cross-validation"
            continue
        more = f", {100 * errors[OF_QUERY]:.2f} from a coarse run of the query" if OF_QUERY in errors else ""
        out[name] = (
            f"process {100 * alone:.2f} cm -> {100 * errors[way]:.2f} cm in cross-validation "
            f"({100 * (1 - errors[way] / alone):.0f} % less){more}; by {way}, {_slopes(level['slopes'])}"
        )
    return out


def told_coarse(record: Record) -> str:
    """What coarse runs brought, in one line."""
    about = record.coarse
    errors, of = about["errors"], _named(about)
    if not errors:
        return f"{of}, not used: there are too few fine runs to tell what they bring"
    alone, best = errors[ALONE], errors[about["way"]]
    if about["way"] == ALONE:
        others = min(error for way, error in errors.items() if way != ALONE)
        return f"{of}, not used: {100 * alone:.2f} cm without and {100 * others:.2f} cm with them in cross-validation"
    more = f"; {100 * errors[EVERYWHERE]:.2f} where the coarse runs hold the query"
    if OF_QUERY in errors:
        more += f", {100 * errors[OF_QUERY]:.2f} from a coarse run of it (--coarse-run)"
    return (
        f"{of} by {about['way']}: {100 * alone:.2f} cm -> {100 * best:.2f} cm in cross-validation "
        f"({100 * (1 - best / alone):.0f} % less){more}; {_slopes(about['slopes'])}"
    )


def _slopes(slopes: list[float]) -> str:
    largest = ", ".join(f"{slope:.2f}" for slope in slopes[:_TOLD])
    return f"slopes of the first modes {largest}, mean {np.mean(slopes):.2f}"
