"""How long a prediction takes, with and without lifting it to the full mesh."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from data_schema.levels import lift
from evaluation.comparison.predictor import Predictor
from evaluation.comparison.reference import Reference
from evaluation.comparison.scoring import mesh_of

# Seconds after which a call is timed no further, once it was this often.
_ENOUGH, _FEWEST = 1.0, 2


@dataclass(frozen=True)
class Timing:
    """Milliseconds a state, the fastest of several repetitions on this machine.

    Attributes
    ----------
    own, lifted
        On the predictor's own level and on the full mesh, all states of a run in one call.
    single, single_lifted
        The same for one state alone, as an interactive viewer asks.
    """

    own: float
    lifted: float
    single: float
    single_lifted: float


def time_predictions(reference: Reference, predictor: Predictor, run: int, repeats: int = 9) -> Timing:
    """Ask `predictor` for run number `run` up to `repeats` times, fewer where it takes long; the first call is not counted."""
    parameters, times = reference.parameters[run], reference.time
    mesh = mesh_of(reference, predictor)
    to_full = None if mesh is None else mesh.to_full.astype("float32")

    def ask(states: int, lifted: bool) -> Callable[[], None]:
        def call() -> None:
            field = predictor.predict(parameters, times[-states:])
            if lifted and to_full is not None:
                lift(to_full, field)

        return call

    states = len(times)
    own, whole, single, one = (
        _fastest_seconds(ask(n, lifted), repeats)
        for n, lifted in ((states, False), (states, True), (1, False), (1, True))
    )
    if to_full is None:  # nothing to lift: one number, not two samples of the same noise
        whole, one = own, single
    return Timing(own / states * 1e3, whole / states * 1e3, single * 1e3, one * 1e3)


def _fastest_seconds(call: Callable[[], None], repeats: int) -> float:
    call()
    seconds: list[float] = []
    while len(seconds) < repeats and (len(seconds) < _FEWEST or sum(seconds) < _ENOUGH):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return min(seconds)  # what disturbs a measurement only ever makes it slower
