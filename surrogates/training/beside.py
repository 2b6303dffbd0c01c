"""What is learnt beside the displacements, whatever the model: removal of elements, and results on elements."""

from __future__ import annotations

import difflib

import numpy as np
from numpy.typing import NDArray

from surrogates.data.campaign import Campaign
from surrogates.data.samples import Notes
from surrogates.errors import SurrogateError
from surrogates.models.element_field import fit_element_field
from surrogates.models.removal import fit_removal
from surrogates.physics.trials import Folds, Trials, courses_of
from surrogates.settings import Settings
from surrogates.surrogate import Surrogate

# What solvers call results on elements, for what was misspelt.
_USUAL_FIELDS = ("plastic_strain", "von_mises", "thickness", "energy")


def check_targets(campaign: Campaign, settings: Settings) -> None:
    """Raise SurrogateError for a target that the campaign does not hold."""
    known = [t.name for t in campaign.targets]
    for name in settings.targets:
        if name != "displacement" and not name.startswith("history:") and name not in known:
            there = ["displacement", *known]
            near = next(iter(difflib.get_close_matches(name, [*there, *_USUAL_FIELDS], n=1)), name)
            keep = f"results on elements are kept by crashkit ingest --fields {near}"
            cure = keep if near == name else f"did you mean {near!r}?" + ("" if near in there else f" {keep}")
            raise SurrogateError(f"targets names {name!r}, and the dataset has {', '.join(there)}; {cure}")


def fit_beside(
    surrogate: Surrogate, campaign: Campaign, settings: Settings, chosen: NDArray[np.int64], notes: Notes,
    trials: Trials | None = None,
) -> None:  # fmt: skip
    """Fit what `settings` ask for beside the displacements, behind the registration of `surrogate`.

    Parameters
    ----------
    chosen
        Places of the training runs.
    trials
        What the registration was chosen with, where it was; else it is made.
    """
    wanted = [t for t in campaign.targets if t.name in settings.targets]
    removal = settings.removal == "auto" and campaign.alive is not None
    if not wanted and not removal:
        return
    if trials is None:
        courses = courses_of(campaign, settings, chosen, notes, only_judged=True)
        folds = Folds.of(len(chosen), settings.validation.folds, settings.seed)
        trials = Trials(courses, campaign.parameters[chosen], folds, "pod-gpr", settings.seed)
    registration = surrogate.registration
    mirror = registration.symmetry.mirror
    plane = next((k for k, known in enumerate(campaign.mirrors) if known is mirror), 0)
    if removal:
        surrogate.removal = fit_removal(campaign, trials, registration, plane, chosen, settings.seed)
    for target in wanted:
        surrogate.fields[target.name] = fit_element_field(target, campaign, trials, registration, plane, chosen)
