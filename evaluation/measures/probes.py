"""What a sensor would have measured: histories at nodes, CFC filters, intrusion, and the rating of curves.

Sources: SAE J211-1 (and ISO 6487) for the channel frequency classes, ISO/TS 18571 for the rating.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evaluation.errors import EvaluationError
from evaluation.measures.passes import furthest
from evaluation.measures.rigid import RigidMotion, fit_rigid

Floats = NDArray[np.float64]

CFC_CLASSES = (60, 180, 600, 1000)
SAMPLES_PER_CFC = 10  # J211-1 asks for at least ten samples a second for each hertz of the class
GRADES = ((0.94, "excellent"), (0.80, "good"), (0.58, "fair"))  # ISO/TS 18571; poor below
RATING_STEP = 1e-4  # s: ISO/TS 18571 rates curves sampled at 10 kHz
_FEWEST_SAMPLES = 20  # of a curve to be rated: the slope is averaged over nine, the shift searched over a fifth


# --- histories -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Histories:
    """Histories (t, probe, 3): displacement (m), velocity (m/s), acceleration (m/s2); NaN once the node is gone."""

    time: Floats
    displacement: Floats
    velocity: Floats
    acceleration: Floats


def probe_histories(time: ArrayLike, displacement: ArrayLike, nodes: ArrayLike) -> Histories:
    """Histories at `nodes` of `displacement` (t, n, 3), m, at `time` (t,), s.

    Velocity is the second-order difference of displacement, also at the ends and for uneven times, acceleration
    that of velocity. Between states everything is unknown: a motion of f Hz comes out weaker by the factor
    (sin(a) / a)^2 in the acceleration, a = 2 pi f dt. Output velocities of the solver are better where they exist.
    """
    times = _times(time, 3)
    u = np.asarray(displacement)
    chosen = np.atleast_1d(np.asarray(nodes))
    if u.ndim != 3 or u.shape[0] != len(times) or u.shape[2] != 3:
        raise EvaluationError(f"displacement has shape {u.shape}: expected ({len(times)} states, nodes, 3)")
    if chosen.size and (chosen.min() < 0 or chosen.max() >= u.shape[1]):
        raise EvaluationError(f"probes at nodes {chosen.min()} to {chosen.max()}: expected 0 to {u.shape[1] - 1}")
    u = u[:, chosen].astype(np.float64)
    velocity = differentiate(times, u)
    return Histories(times, u, velocity, differentiate(times, velocity))


def differentiate(time: ArrayLike, values: ArrayLike) -> Floats:
    """Time derivative of `values` (t, ...), second order also at the ends; a NaN makes its neighbours NaN too."""
    return np.gradient(np.asarray(values, np.float64), _times(time, 3), axis=0, edge_order=2)


# --- SAE J211 --------------------------------------------------------------------------------------------------


def cfc_coefficients(cfc: float, step: float) -> tuple[Floats, Floats]:
    """Numerator (a0, a1, a2) and denominator (1, -b1, -b2) of one pass of the CFC filter (SAE J211-1, digital filter).

    cfc in Hz, step in s. Two poles; the filter runs forwards and backwards, which makes four and no shift in phase.
    """
    corner = 2 * np.pi * cfc * 2.0775
    warped = np.tan(corner * step / 2)
    common = 1 + np.sqrt(2) * warped + warped**2
    a0 = warped**2 / common
    b1 = -2 * (warped**2 - 1) / common
    b2 = (-1 + np.sqrt(2) * warped - warped**2) / common
    return np.array([a0, 2 * a0, a0]), np.array([1, -b1, -b2])


def possible_classes(time: ArrayLike) -> tuple[int, ...]:
    """The channel frequency classes that states at `time` (t,), s, are dense enough for.

    States every 0.3 ms (3.3 kHz) allow CFC 60 and CFC 180; CFC 600 needs 6 kHz, CFC 1000 10 kHz.
    """
    rate = 1 / _even_step(_times(time, 2))
    return tuple(c for c in CFC_CLASSES if rate >= SAMPLES_PER_CFC * c * (1 - 1e-6))


def cfc_filter(time: ArrayLike, values: ArrayLike, cfc: int) -> Floats:
    """`values` (t, ...) through the phaseless filter of class `cfc`: 60, 180, 600 or 1000.

    The curve is continued at both ends by its own reflection in the end point, so that a filter that starts has no step
    to ring from. States are written without a filter against aliases, unlike a sensor's samples, so what vibrates
    faster than half their rate is in them all the same.

    Parameters
    ----------
    time
        (t,) s, even. A history that ends in NaN (a node that is gone) is filtered up to there.

    Raises
    ------
    EvaluationError
        For another class, uneven times, gaps, and times too coarse for the class: J211-1 asks for ten samples a
        second for each hertz of the class.
    """
    from scipy.signal import filtfilt

    times, signal = _times(time, 4), np.asarray(values, np.float64)
    if cfc not in CFC_CLASSES:
        raise EvaluationError(f"CFC {cfc} asked for: expected one of {', '.join(map(str, CFC_CLASSES))} (SAE J211)")
    if signal.shape[:1] != times.shape:
        raise EvaluationError(f"a curve of shape {signal.shape} at {len(times)} times: expected one value each")
    step = _even_step(times)
    possible = possible_classes(times)
    if cfc not in possible:
        allowed = f"these states allow CFC {', '.join(map(str, possible))}" if possible else "they allow no class"
        raise EvaluationError(
            f"CFC {cfc} needs {SAMPLES_PER_CFC * cfc / 1000:g} kHz, states every {1 / SAMPLES_PER_CFC / cfc * 1e3:.3g} "
            f"ms; found every {step * 1e3:.3g} ms; {allowed}; let the solver write more states"
        )
    numerator, denominator = cfc_coefficients(cfc, step)
    columns = signal.reshape(len(times), -1)
    out = np.full_like(columns, np.nan)
    for k, column in enumerate(columns.T):
        there = np.isfinite(column)
        count = int(there.sum())
        if not there[:count].all():
            raise EvaluationError(
                f"curve {k} has a gap at {times[int(np.argmin(there))]:g} s: expected NaN only at the end"
            )
        if count < 4:
            continue
        reflected = min(count - 1, max(9, round(1 / (cfc * step))))
        out[:count, k] = filtfilt(numerator, denominator, column[:count], padlen=reflected)
    return out.reshape(signal.shape)


# --- intrusion -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Intrusion:
    """Displacement along a direction, m: `history` (t,) of the node furthest in, `largest` in `state` at `node`."""

    history: Floats
    largest: float
    state: int
    node: int


def intrusion(
    position: ArrayLike,
    displacement: ArrayLike,
    nodes: ArrayLike,
    direction: ArrayLike,
    reference: ArrayLike | None = None,
    motion: RigidMotion | None = None,
) -> Intrusion:
    """How far `nodes` of a part come in along `direction`, as seen from the `reference` nodes.

    Parameters
    ----------
    position
        (n, 3) undeformed, m.
    displacement
        (t, n, 3), m; NaN once a node is gone.
    nodes
        Numbers of the nodes that intrude.
    direction
        (3,) of any length but zero, in the undeformed structure: (-1, 0, 0) is rearwards where x is forwards.
    reference
        Numbers of at least three nodes off one line, such as the seat's cross member: the observer moves and turns
        with them (best fit, evaluation.measures.rigid). Without: measured from the ground.
    motion
        The rigid motion of the `reference` nodes, where it is known.

    Raises
    ------
    EvaluationError
        For nodes that do not exist, a direction of zero, or where all nodes are gone throughout.
    """
    x, u = np.asarray(position, np.float64), np.asarray(displacement)
    inside = np.atleast_1d(np.asarray(nodes, np.int64))
    towards = np.array(direction, np.float64)
    if towards.shape != (3,) or not np.isfinite(towards).all() or not towards.any():
        raise EvaluationError(f"direction {towards.tolist()}: expected three numbers that are not all zero")
    for name, numbers in (("nodes", inside), ("reference", np.asarray([] if reference is None else reference))):
        if (name == "nodes" and not numbers.size) or (
            numbers.size and not 0 <= numbers.min() <= numbers.max() < len(x)
        ):
            raise EvaluationError(f"{name} of an intrusion: expected numbers from 0 to {len(x) - 1}, at least one")
    towards /= np.linalg.norm(towards)
    if reference is None:
        count = len(u)
        motion = RigidMotion(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.zeros(3))
    elif motion is None:
        watching = np.asarray(reference, np.int64)
        if len(watching) < 3 or np.linalg.matrix_rank(x[watching] - x[watching].mean(axis=0), tol=1e-9) < 2:
            raise EvaluationError(
                f"{len(watching)} reference nodes on one line: expected at least three that are not, to see rotation"
            )
        motion = fit_rigid(x, u, watching)
    history, where = np.empty(len(u)), np.empty(len(u), np.int64)
    furthest(x - motion.centre, u, inside, motion.rotation, motion.translation, towards, history, where)
    if np.isinf(history).all():
        raise EvaluationError("all nodes of the intrusion are gone in every state: expected some that are there")
    state = int(np.argmax(history))
    largest, node = float(history[state]), int(inside[where[state]])
    history[np.isinf(history)] = np.nan
    return Intrusion(history, largest, state, node)


# --- ISO/TS 18571 ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rating:
    """ISO/TS 18571 scores from 0 to 1: the overall rating, and what it is made of (weights 0.4, 0.2, 0.2, 0.2)."""

    overall: float
    corridor: float
    phase: float
    magnitude: float
    slope: float

    @property
    def grade(self) -> str:
        """excellent, good, fair or poor."""
        return next((name for bound, name in GRADES if self.overall > bound), "poor")


def rate(time: ArrayLike, truth: ArrayLike, prediction: ArrayLike) -> Rating:
    """ISO/TS 18571 rating of a predicted against a true curve (t,), any unit, at `time` (t,), s.

    Both are brought to the 10 kHz that the standard asks for by cubic splines; filter noisy curves before
    (`cfc_filter`). Curves end together where either ends in NaN.

    Raises
    ------
    EvaluationError
        For a true curve that never changes, which the standard cannot rate, and for less than 2 ms.
    """
    from scipy.interpolate import make_interp_spline

    times, a, b = _times(time, 4), np.asarray(truth, np.float64), np.asarray(prediction, np.float64)
    if not a.shape == b.shape == times.shape:
        raise EvaluationError(
            f"curves of shapes {a.shape} and {b.shape} at {len(times)} times: expected one value each"
        )
    there = np.isfinite(a) & np.isfinite(b)
    count = int(there.sum())
    if not there[:count].all():
        raise EvaluationError(f"a curve has a gap at {times[int(np.argmin(there))]:g} s: expected NaN only at the end")
    samples = int(np.floor((times[count - 1] - times[0]) / RATING_STEP * (1 + 1e-9))) + 1 if count > 3 else 0
    if samples < _FEWEST_SAMPLES:
        raise EvaluationError(
            f"curves of {samples} samples at 10 kHz: expected at least {_FEWEST_SAMPLES} to rate, "
            f"{_FEWEST_SAMPLES * RATING_STEP * 1e3:g} ms"
        )
    if np.ptp(a[:count]) <= 1e-12 * np.abs(a[:count]).max(initial=0.0):
        raise EvaluationError("the true curve never changes: ISO/TS 18571 has no rating for it; take another probe")
    even = times[0] + RATING_STEP * np.arange(samples)
    curves = [make_interp_spline(times[:count], c[:count], k=3)(even) for c in (a, b)]
    return _iso_18571(even, *curves)


def _iso_18571(time: Floats, truth: Floats, prediction: Floats) -> Rating:
    from objective_rating_metrics.rating import ISO18571

    with np.errstate(invalid="ignore", divide="ignore"):  # a flat prediction correlates with nothing: no shift is found
        scores = ISO18571(np.column_stack([time, truth]), np.column_stack([time, prediction]), dt=RATING_STEP)
        unrounded = -1
        corridor = float(scores.corridor_rating(unrounded))
        phase = float(scores.phase_rating(unrounded))
        magnitude = float(scores.magnitude_rating(unrounded))
        slope = float(scores.slope_rating(unrounded))
    # As overall_rating of the package has it, which would compute the four a second time.
    return Rating(0.4 * corridor + 0.2 * (phase + magnitude + slope), corridor, phase, magnitude, slope)


def _times(time: ArrayLike, fewest: int) -> Floats:
    times = np.asarray(time, np.float64)
    if times.ndim != 1 or len(times) < fewest or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise EvaluationError(f"times of shape {times.shape}: expected at least {fewest} increasing times in s")
    return times


def _even_step(times: Floats) -> float:
    steps = np.diff(times)
    # Solvers write the first state after the output time, so a step may be off by one time step.
    if np.ptp(steps) > 0.02 * steps.mean():
        raise EvaluationError(
            f"states {steps.min() * 1e3:.4g} to {steps.max() * 1e3:.4g} ms apart: expected even times for a filter; "
            "bring the runs to a common even time at ingest"
        )
    return float(steps.mean())
