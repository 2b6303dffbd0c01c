"""Numbers by formula of a model: checked before it is trained, judged on left-out runs, predicted with their bands."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from crashkit.api._predicted import FormulaMesh, GivenRuns, PredictedRuns, dry_runs, true_runs
from crashkit.errors import DataError
from evaluation.measures.formula import Formula, Value, read_formulas

if TYPE_CHECKING:
    from surrogates.data.campaign import Campaign
    from surrogates.settings import Settings
    from surrogates.surrogate import Surrogate

Floats = NDArray[np.float64]


class NumberJudge:
    """Compares numbers of left-out runs with their truth while a model is trained."""

    def __init__(self, formulas: Mapping[str, Formula], campaign: Campaign) -> None:
        self.formulas, self.campaign = dict(formulas), campaign
        self.structure = FormulaMesh.of_campaign(campaign)
        self.found: dict[str, dict[str, list[float]]] = {name: {} for name in formulas}
        self.units: dict[str, str] = {}
        self.sizes: dict[str, list[float]] = {name: [] for name in formulas}

    @classmethod
    def of(cls, settings: Settings, campaign: Campaign) -> NumberJudge | None:
        """For the numbers of `settings`, None without any.

        Raises
        ------
        EvaluationError
            For a text that is no formula, and for fields, parts or histories that the data do not have.
        DataError
            For a number that is called as a parameter.
        """
        from surrogates.training.train import curve_targets

        if not settings.kpi:
            return None
        formulas = read_formulas(settings.kpi)
        for name in formulas:
            if name in campaign.parameter_names:
                raise DataError(f"kpi.{name} has the name of a parameter of the dataset; give the number another one")
        channels = [c.name for c in curve_targets(campaign, settings)]
        runs = dry_runs(campaign, channels)
        for formula in formulas.values():
            formula.number(runs, formulas)
        return cls(formulas, campaign)

    def __call__(self, surrogate: Surrogate, run: int, predicted: NDArray[np.float32]) -> None:
        """A left-out run: its place, and its displacements (state, node, 3), m, as told without it."""
        campaign = self.campaign
        parameters = campaign.parameters[run : run + 1]
        curves = {}
        for name, curve in surrogate.curves.items():
            values = curve.held[run][None] if run in curve.held else curve.predict(surrogate.registration, parameters)
            curves[name] = Value(values, ("time",), curve.time, curve.unit or "1")
        said = GivenRuns(self.structure, parameters, campaign.time, predicted[None], curves)
        true = true_runs(self.structure, campaign, run)
        for name, formula in self.formulas.items():
            value = formula.number(said, self.formulas)
            self.units[name] = value.unit
            truth = _one(formula.number(true, self.formulas))
            error = _one(value) - truth
            self.sizes[name].append(abs(truth))
            if math.isfinite(error):
                self.found[name].setdefault(campaign.runs[run] if campaign.runs else str(run), []).append(error)

    def note(self, surrogate: Surrogate) -> None:
        """Keep formulas and errors with the model."""
        runs = PredictedRuns(
            surrogate, self.structure, self.campaign.parameters[:1], self.campaign.time, surrogate.number(None)
        )
        for name, formula in self.formulas.items():
            errors = {run: float(np.mean(found)) for run, found in self.found[name].items()}
            surrogate.record.numbers[name] = {
                "formula": formula.text,
                "unit": self.units.get(name) or formula.number(runs, self.formulas).unit,
                "errors": errors,
                "size": float(np.nanmean(self.sizes[name])) if self.sizes[name] else None,
            }


@dataclass(frozen=True)
class Predicted:
    """A number of runs: values (run,) in `unit`, and how far they may be off, None with too few left-out runs."""

    name: str
    unit: str
    values: Floats
    half_width: float | None


def predicted_numbers(
    surrogate: Surrogate, parameters: Floats, band: float | None = None, level: int | None = None
) -> list[Predicted]:
    """The numbers that a model was trained with, at parameters (run, parameter)."""
    formulas = model_formulas(surrogate)
    if not formulas:
        return []
    structure, time = FormulaMesh.of(surrogate), surrogate.record.time
    runs = PredictedRuns(surrogate, structure, parameters, time, surrogate.number(level))
    out = []
    for name, formula in formulas.items():
        value = formula.number(runs, formulas)
        values = np.broadcast_to(np.asarray(value.array, np.float64), (len(parameters),))
        errors = list(surrogate.record.numbers[name]["errors"].values())
        out.append(Predicted(name, value.unit, values, None if band is None else half_width(errors, band)))
    return out


def model_formulas(surrogate: Surrogate) -> dict[str, Formula]:
    """The formulas of the numbers that a model was trained with."""
    return read_formulas({name: str(told["formula"]) for name, told in surrogate.record.numbers.items()})


def half_width(errors: Sequence[float], coverage: float) -> float | None:
    """What the share `coverage` of new runs is as near as, by errors of runs that were left out; None with too few.

    The conformal quantile: number ceil((n + 1) coverage) of the n absolute errors in their order, the largest where
    there are not so many (Vovk, Gammerman, Shafer 2005).
    """
    from surrogates.uncertainty import FEWEST_BY_FOLDS

    if len(errors) < FEWEST_BY_FOLDS:
        return None
    order = np.sort(np.abs(np.asarray(errors, np.float64)))
    return float(order[min(len(order), math.ceil((len(order) + 1) * coverage)) - 1])


def _one(value: Value) -> float:
    return float(np.asarray(value.array).ravel()[0])


def told_beside(surrogate: Surrogate) -> list[dict[str, Any]]:
    """A row for each history and number: name, unit, runs that were left out, mean absolute error on them, typical value."""
    out = []
    for name, curve in surrogate.curves.items():
        runs = 0 if curve.band is None else curve.band.runs
        size = float(np.abs(curve.values @ curve.modes).mean())
        band = None if curve.band is None else float(np.mean(curve.band.node[0] * curve.band.state))
        out.append({"name": f"history:{name}", "unit": curve.unit, "runs": runs, "error": band, "size": size})
    for name, told in surrogate.record.numbers.items():
        errors = list(told["errors"].values())
        error = float(np.mean(np.abs(errors))) if errors else None
        out.append({"name": name, "unit": told["unit"], "runs": len(errors), "error": error, "size": told["size"]})
    return out
