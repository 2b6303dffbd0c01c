"""Coarse runs beside a training: what they go with, and what the record says of them."""

from __future__ import annotations

import numpy as np

from surrogates.data.campaign import Campaign, CoarseRuns
from surrogates.errors import SurrogateError
from surrogates.models.coarse_fit import ALONE, EVERYWHERE, OF_QUERY, CoarseFit
from surrogates.record import Record
from surrogates.settings import Settings

# Slopes that are told, of the largest modes.
_TOLD = 6


def check_coarse(campaign: Campaign, settings: Settings) -> None:
    """Raise SurrogateError where coarse runs are given to a model that does not take them."""
    if campaign.coarse is None:
        return
    if settings.model != "pod-gpr":
        raise SurrogateError(
            f"coarse runs go beneath pod-gpr, and the model is {settings.model}; train --model pod-gpr"
        )
    if settings.pod.inputs == "point":
        raise SurrogateError("coarse runs need one sample per run; leave out pod.inputs=point")


def note_coarse(record: Record, coarse: CoarseRuns, found: CoarseFit) -> None:
    """Keep in the record what coarse runs there were and what folds said of them."""
    campaign = coarse.campaign
    about = campaign.attributes or {}
    slopes = [] if found.base is None else [float(slope) for slope in found.base.slopes]
    record.coarse = {
        "dataset": about.get("dataset", ""),
        "checksum": campaign.checksum,
        "units": about.get("units_read", ""),
        "runs": found.runs,
        "twins": found.twins,
        "nodes": campaign.n_nodes,
        "way": found.way,
        "slopes": slopes,
        "errors": found.errors,
    }
    record.physics["coarse runs"] = told_coarse(record)


def told_coarse(record: Record) -> str:
    """What coarse runs brought, in one line."""
    about = record.coarse
    errors = about["errors"]
    of = f"{about['runs']} runs of {about['dataset']} ({about['nodes']} nodes, checksum {about['checksum'][:12] or 'not recorded'})"
    if not errors:
        return f"{of}, not used: there are too few fine runs to tell what they bring"
    alone, best = errors[ALONE], errors[about["way"]]
    if about["way"] == ALONE:
        others = min(error for way, error in errors.items() if way != ALONE)
        return f"{of}, not used: {100 * alone:.2f} cm without and {100 * others:.2f} cm with them in cross-validation"
    slopes = np.array(about["slopes"])
    largest = ", ".join(f"{slope:.2f}" for slope in slopes[:_TOLD])
    more = f"; {100 * errors[EVERYWHERE]:.2f} where the coarse runs hold the query"
    if OF_QUERY in errors:
        more += f", {100 * errors[OF_QUERY]:.2f} from a coarse run of it (--coarse-run)"
    return (
        f"{of} by {about['way']}: {100 * alone:.2f} cm -> {100 * best:.2f} cm in cross-validation "
        f"({100 * (1 - best / alone):.0f} % less){more}; slopes of the first modes {largest}, mean {slopes.mean():.2f}"
    )
