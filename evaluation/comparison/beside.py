"""Histories and numbers by formula of models against the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from evaluation.errors import EvaluationError
from evaluation.measures.curves import keep_compiled
from evaluation.measures.probes import rate

Floats = NDArray[np.float64]
SHARE = 0.9  # of the bands


@dataclass(frozen=True)
class NumberCompared:
    """A number of the test runs.

    Attributes
    ----------
    name, text, unit
        What it is called, its formula and its SI unit.
    truth
        (run,)
    predictions, half_width
        Model -> (run,), and how far it may be off, NaN where a model has no band.
    """

    name: str
    text: str
    unit: str
    truth: Floats
    predictions: Mapping[str, Floats]
    half_width: Mapping[str, float]

    def errors(self, model: str) -> Floats:
        """(run,)"""
        return np.asarray(np.abs(self.predictions[model] - self.truth))

    def covered(self, model: str) -> float:
        """Share of the runs within the band; NaN without one."""
        width = self.half_width[model]
        return float((self.errors(model) <= width).mean()) if np.isfinite(width) else float("nan")


@dataclass(frozen=True)
class CurveCompared:
    """A history of the test runs.

    Attributes
    ----------
    name, unit, time
        Of the channel; (sample,) s.
    truth
        (run, sample), NaN where a run lacks it.
    predictions, half_width
        Model -> (run, sample) both, NaN where a model has no band.
    """

    name: str
    unit: str
    time: Floats
    truth: Floats
    predictions: Mapping[str, Floats]
    half_width: Mapping[str, Floats]

    def errors(self, model: str) -> Floats:
        """(run,): mean distance over the samples."""
        return np.asarray(np.nanmean(np.abs(self.predictions[model] - self.truth), axis=1))

    def covered(self, model: str) -> float:
        """Share of the samples within the band; NaN without one."""
        off = np.abs(self.predictions[model] - self.truth)
        there = np.isfinite(off) & np.isfinite(self.half_width[model])
        return float((off <= self.half_width[model])[there].mean()) if there.any() else float("nan")

    def ratings(self, model: str) -> Floats:
        """(run,) ISO/TS 18571 from 0 to 1, NaN where a curve cannot be rated."""
        keep_compiled()
        out = np.full(len(self.truth), np.nan)
        for run, (true, said) in enumerate(zip(self.truth, self.predictions[model], strict=True)):
            try:
                out[run] = rate(self.time, true, np.where(np.isfinite(true), said, np.nan)).overall
            except EvaluationError:  # a curve that never changes, or one too short
                continue
        return out


@dataclass(frozen=True)
class Beside:
    """What models say beside the displacements: names of the test `runs`, and numbers and curves in their order."""

    runs: tuple[str, ...]
    numbers: tuple[NumberCompared, ...] = ()
    curves: tuple[CurveCompared, ...] = ()
    rated: dict[tuple[str, str], Floats] = field(default_factory=dict)

    def ratings(self, curve: CurveCompared, model: str) -> Floats:
        """Ratings of a curve, worked out once."""
        key = (curve.name, model)
        if key not in self.rated:
            self.rated[key] = curve.ratings(model)
        return self.rated[key]

    def table(self) -> dict[str, list[object]]:
        """A row for each number and history of each model."""
        rows: list[tuple[object, ...]] = []
        for number in self.numbers:
            size = float(np.nanmean(np.abs(number.truth)))
            for model in number.predictions:
                error = float(np.nanmean(number.errors(model)))
                rows.append(
                    (number.name, number.unit, model, size, error, 100 * error / size if size else np.nan,
                     100 * number.covered(model), np.nan)
                )  # fmt: skip
        for curve in self.curves:
            size = float(np.nanmean(np.abs(curve.truth)))
            for model in curve.predictions:
                error, ratings = float(np.nanmean(curve.errors(model))), self.ratings(curve, model)
                mean = float(np.nanmean(ratings)) if np.isfinite(ratings).any() else np.nan
                rows.append(
                    (f"history {curve.name}", curve.unit, model, size, error, 100 * error / size if size else np.nan,
                     100 * curve.covered(model), mean)
                )  # fmt: skip
        heads = (
            "what",
            "unit",
            "model",
            "mean size",
            "mean error",
            "relative_percent",
            "within band_percent",
            "rating",
        )
        return {head: [row[k] for row in rows] for k, head in enumerate(heads)}
