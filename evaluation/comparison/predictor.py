"""What evaluation needs to know of a surrogate: its name, where it lives, how to ask it, and what it has seen."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from data_schema.levels import Level


class Predictor(Protocol):
    """One row of every table. The command line wraps each level of a stored model into one of these.

    Attributes
    ----------
    name
        "MH1", "PODNN", "POD-GPR r=12", ...
    level
        The mesh level it predicts on; 0 is the full mesh.
    mesh
        Its coarse mesh where that, or its map to the full mesh, is not the dataset's, as after adaptive refinement or with a
        learnt map; else None.
    n_parameters
        Trained numbers, the budget shown beside the errors.
    n_latent
        Numbers a state is reduced to (4 in the paper); the POD floor beside it has as many modes.
    seconds_per_epoch, training_seconds
        As recorded during training (NaN where it makes no sense).
    history
        Epoch curves by name: "total", "approximation", "reconstruction"; empty where not iterative.
    """

    name: str
    level: int
    mesh: Level | None
    n_parameters: int
    n_latent: int
    seconds_per_epoch: float
    training_seconds: float
    history: Mapping[str, NDArray[np.float64]]

    def predict(self, parameters: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float32]:
        """Displacement (state, node of its level, 3), m, of one run with `parameters` (parameter,) at `time`."""

    def reconstruct(self, displacement: NDArray[np.float32]) -> NDArray[np.float32]:
        """Encode and decode (state, node of its level, 3): what reduction alone costs."""


# Share of nodes and states that the bands in tables promise.
NOMINAL = 0.9


@runtime_checkable
class Banded(Protocol):
    """A predictor that also says how far it may be wrong."""

    def half_width(
        self, share: float, time: NDArray[np.float64], parameters: NDArray[np.float64]
    ) -> NDArray[np.float32] | None:
        """(state, node of the full mesh), m: that share of nodes and states of the run lies within; None where it cannot say."""


@dataclass(frozen=True)
class ComparedModel:
    """A trained model: one predictor for each level it can answer on, finest first, and what it has seen.

    Attributes
    ----------
    name
        What the model is called where folders are told apart: the folder's name.
    predictors
        Finest level first; a cascade has several, a baseline one.
    fitted_runs
        Runs whose states trained it.
    tuned_runs
        Runs that chose anything: best epoch, number of modes, settings.
    held_out_runs
        Runs it was told to leave alone; what a comparison is made on.
    checksum
        SHA-256 of the dataset it was trained on.
    seed
        Of its training; None where nothing is random.
    averaged
        Trainings, with this seed and the next ones, that it is the mean of.
    configuration
        Its settings, for the methods section; without the seed, models of one kind agree in it.
    beneath
        What else it was trained on than the dataset, such as the checksum of coarse runs; empty for nothing.
    known
        What was put in before the first run, a sentence by its name: inputs, clock, symmetry.
    worth
        Error in cross-validation, m, with and without each of these.
    hard
        Training runs at places where runs differ by more than their distance explains, the worst first: the error when
        left out, m, and how many times the typical one it is.
    """

    name: str
    predictors: tuple[Predictor, ...]
    fitted_runs: tuple[str, ...] = ()
    tuned_runs: tuple[str, ...] = ()
    held_out_runs: tuple[str, ...] = ()
    checksum: str = ""
    seed: int | None = None
    averaged: int = 1
    configuration: Mapping[str, object] = field(default_factory=dict)
    beneath: str = ""
    known: Mapping[str, str] = field(default_factory=dict)
    worth: Mapping[str, float] = field(default_factory=dict)
    hard: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def seeds(self) -> tuple[int, ...]:
        """Of all its trainings; empty where nothing is random."""
        return () if self.seed is None else tuple(range(self.seed, self.seed + self.averaged))

    @property
    def kind(self) -> str:
        """What models that differ in nothing but the seed have in common."""
        return json.dumps([self.configuration, self.beneath], sort_keys=True, default=str)


def array_names(models: Sequence[ComparedModel]) -> dict[tuple[str, str], str]:
    """(model, predictor) -> what its arrays are called: the predictor, and the model where two models have it."""
    every = [p.name for m in models for p in m.predictors]
    return {
        (m.name, p.name): re.sub(r"[./]", "_", p.name if every.count(p.name) == 1 else f"{p.name}_{m.name}")
        for m in models
        for p in m.predictors
    }
