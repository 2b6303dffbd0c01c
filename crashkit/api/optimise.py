"""The best parameters within limits, as far as a model can promise them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from crashkit.display import watched
from data_schema.progress import Progress

if TYPE_CHECKING:
    import pandas as pd

    from crashkit.api.model import Model
    from evaluation.measures.formula import Formula, Limit, Value
    from surrogates.data.inputs import Ranges
    from surrogates.queries.optimum import LocalAnswer, Problem, Sampled
    from surrogates.surrogate import Surrogate

Floats = NDArray[np.float64]

# Draws of the model's own error, rounds in which limits are tightened, and the change of a margin, in spreads of the number
# over the box, that ends them.
_DRAWS, _ROUNDS, _STILL = 200, 6, 0.01
# A limit within this share of its spread over the box is active.
_ACTIVE = 0.02
# A parameter hardly matters where, over its whole range, no number changes by this share of its range over the box.
_MATTERS, _ALONG = 0.01, 7


@dataclass(frozen=True)
class Optimum:
    """What `optimise` found.

    Attributes
    ----------
    feasible
        Whether the parameters keep all limits with the confidence asked for. Otherwise they are those that break them least.
    parameters
        By name, in the model's units (SI).
    objective, value, unit
        What was made small (or large), its value there, and its unit.
    limits
        One row a limit, in SI: predicted value, margin (how far the model's error may take it towards the bound), bound,
        slack (what is left with the margin; negative where it is broken), active, probability that it is kept, and price:
        by how much the value would improve for each unit that the bound is loosened. `attrs["written"]` has the unit in
        which each limit was written, and its value in SI.
    sensitivities
        One row a parameter: change of the value and of each limit's number for one unit of the parameter's table.
    table
        One row a parameter, in the units of its table: value, trained range, and `at`: "given", at an edge of the range, or
        "hardly matters" where nothing changes over its whole range, so that its value means nothing.
    confirm
        Parameters of the runs to compute next, in the units of the table.
    others
        Further local answers, the best first.
    notes
        How it was found.
    """

    feasible: bool
    parameters: dict[str, float]
    objective: str
    value: float
    unit: str
    confidence: float
    limits: pd.DataFrame
    sensitivities: pd.DataFrame
    table: pd.DataFrame
    confirm: pd.DataFrame
    others: tuple[LocalAnswer, ...]
    notes: tuple[str, ...]

    def save(self, folder: str | Path) -> Path:
        """Write parameters.csv, limits.csv, sensitivities.csv and confirm.csv into a folder.

        Raises
        ------
        OutputError
            Where the folder holds something else or cannot be written.
        """
        from crashkit.output import complete_folder

        folder = Path(folder)
        with complete_folder(folder, "confirm.csv") as new:
            for name in ("table", "limits", "sensitivities", "confirm"):
                table: pd.DataFrame = getattr(self, name)
                target = new / f"{'parameters' if name == 'table' else name}.csv"
                table.to_csv(target, index=False, float_format="%.7g")
        return folder


def optimise(
    model: Model | Surrogate | str | Path,
    minimise: str | None = None,
    *,
    maximise: str | None = None,
    subject_to: str | Sequence[str] = (),
    numbers: Mapping[str, str] | None = None,
    known: Mapping[str, Any] | None = None,
    confidence: float = 0.9,
    level: int | None = None,
    starts: int = 6,
    samples: int = 128,
    runs: int = 4,
    seed: int = 0,
    report: Progress | None = None,
    progress: bool | Literal["auto"] = "auto",
) -> Optimum:
    """The parameters within the trained range that make a number as small (or large) as can be while limits are kept.

    Parameters
    ----------
    model
        A model, or the folder it is stored in; the training data is not needed.
    minimise, maximise
        One of them: a formula over parameters and predicted motion, or the name of one of `numbers`:
        "max(displacement(part=box, along=x))", "thickness".
    subject_to
        Limits such as "intrusion < 80 mm"; of a field ("displacement(part=floor) < 0.1 m") at all nodes and times.
    numbers
        Name -> formula, such as {"mass": "7850 * 0.6 * thickness"}; they may name each other.
    known
        Parameters that are given, by name; the others are sought.
    confidence
        With which each limit is to be kept, as far as the model knows its own error; 0.5: as predicted.
    level
        Predict from this mesh level of the model.
    starts, samples
        Searches, and points at which the box is looked over first.
    runs
        Runs in `confirm` at most.
    seed
        Of all random numbers.
    report, progress
        As for `crashkit.train`.

    Raises
    ------
    DataError
        For parameters that are unknown.
    EvaluationError
        For formulas and limits that are none, or do not fit the model.

    Notes
    -----
    Limits are tightened by the quantile of the model's error at the answer, and the search is repeated from there until
    that changes no more (Du and Chen 2004, doi 10.1115/1.1649968, "sequential optimization and reliability assessment").
    """
    from crashkit.api._predicted import FormulaMesh, PredictedRuns
    from crashkit.api.invert import known_values
    from crashkit.api.numbers import model_formulas
    from crashkit.api.predict import model_in_hand
    from crashkit.errors import DataError
    from evaluation.measures.formula import read_formula, read_formulas, read_limit
    from surrogates.queries.optimum import Problem, sampled, search

    if (minimise is None) == (maximise is None):
        raise DataError("give one of minimise and maximise: a formula such as max(displacement(part=box, along=x))")
    if not 0.5 <= confidence < 1:
        raise DataError(f"confidence {confidence}: expected a share from 0.5 to below 1, such as 0.9")
    tell = watched(report, progress)
    surrogate = model_in_hand(model).surrogate
    ranges, structure, number = surrogate.record.ranges, FormulaMesh.of(surrogate), surrogate.number(level)
    formulas = read_formulas({**{n: f.text for n, f in model_formulas(surrogate).items()}, **(numbers or {})})
    text = str(minimise if maximise is None else maximise).strip()
    goal = formulas.get(text) or read_formula(text)
    bounds = [read_limit(t, formulas) for t in ([subject_to] if isinstance(subject_to, str) else subject_to)]
    curves = [*surrogate.curves, *(name[:-2] for name in surrogate.curves if name[-2:] in ("_x", "_y", "_z"))]
    _all_known([goal, *(b.formula for b in bounds)], formulas, [*ranges.names, *curves])
    low, high = ranges.low.copy(), ranges.high.copy()
    for name, given in known_values(known or {}, surrogate).items():
        low[ranges.names.index(name)] = high[ranges.names.index(name)] = given
    if not (high > low).any():
        raise DataError("all parameters are given; leave at least one to be chosen")
    for name in formulas:
        if name in ranges.names:
            raise DataError(f"{name} is a parameter of the model; give the number {formulas[name].text} another name")
    sign = 1.0 if maximise is None else -1.0
    time = surrogate.record.time

    def asked(points: Floats) -> PredictedRuns:
        return PredictedRuns(surrogate, structure, points, time, number)

    def numbers_of(predicted: PredictedRuns, count: int) -> Floats:
        values = [sign * goal.number(predicted, formulas).array]
        values += [_excess(bound, bound.formula.value(predicted, formulas)) for bound in bounds]
        return np.stack([np.broadcast_to(np.asarray(v, np.float64), (count,)) for v in values], axis=1)

    middle = asked(((low + high) / 2)[None])
    unit = goal.number(middle, formulas).unit
    if not goal.needs_field and not goal.text.isidentifier():
        unit = "1"  # of numbers in a formula nobody says what they are in
    for bound in bounds:
        bound.kept(bound.formula.value(middle, formulas))
    problem = Problem(lambda points: numbers_of(asked(points), len(points)), low, high)
    box = sampled(problem, samples, seed, lambda done: tell("points of the range", done, samples, ""))
    margins, earlier = np.zeros(len(bounds)), [np.inf]
    found: list[LocalAnswer] = []
    plain: LocalAnswer | None = None
    errors = np.zeros((1, len(bounds)))
    told = ""
    for turn in range(_ROUNDS):
        tell("searches", turn, _ROUNDS, "")
        found = search(problem, box, margins, starts if not turn else 2, [f.parameters for f in found[:3]])
        plain = plain or found[0]
        if not bounds:
            break
        told, errors = _errors(surrogate, asked, numbers_of, found[0], time, number, seed)
        wider = np.quantile(errors, confidence, axis=0) if confidence > 0.5 else np.zeros(len(bounds))
        change = float((np.abs(wider - margins) / box.scale[1:]).max())
        # Where the margin itself jumps between two answers, the larger one is kept.
        margins = np.maximum(wider, margins) if turn > 2 else wider
        if change < _STILL or not found[0].kept or (turn > 2 and change >= earlier[-1]):
            break
        earlier.append(change)
    best = found[0]
    kept = (errors + best.excess <= _ACTIVE * 0.1 * box.scale[1:]).mean(axis=0)
    notes = [
        _searched(ranges, low, high),
        f"{len(found)} local answers from {starts} starts; derivatives by finite differences of the model",
    ]
    if bounds:
        notes.append(
            f"limits tightened by {told}"
            if told
            else "limits are not tightened: the model knows nothing of its own error"
        )
    idle = _idle(problem, box, best)
    if idle.any():
        told_idle = [name for name, is_idle in zip(ranges.names, idle, strict=True) if is_idle]
        notes.append(
            f"{', '.join(told_idle)} hardly {'matters' if len(told_idle) == 1 else 'matter'} there: over the whole range the "
            f"value{' and the limits' if bounds else ''} change by less than {100 * _MATTERS:g} % of what they change over the "
            "box; any value does"
        )
    limits = _limits(bounds, best, margins, kept, box.scale, problem)
    slopes = Problem(problem.values, ranges.low, ranges.high).slopes(best.parameters)  # by given parameters, too
    factors = np.array([f for _, f in ranges.written])
    units = ["" if u == "1" else u for u, _ in ranges.written]
    return Optimum(
        feasible=best.kept,
        parameters=dict(zip(ranges.names, map(float, best.parameters), strict=True)),
        objective=goal.text if goal.name == goal.text else f"{goal.name} = {goal.text}",
        value=sign * best.value,
        unit=unit,
        confidence=confidence,
        limits=limits,
        sensitivities=_sensitivities(ranges.names, units, factors, bounds, slopes, sign),
        table=_table(ranges, units, factors, best, problem.free, idle),
        confirm=_confirm(ranges.names, units, factors, found, plain or best, low, high, runs),
        others=tuple(found[1:]),
        notes=tuple(notes),
    )


def _searched(ranges: Ranges, low: Floats, high: Floats) -> str:
    """Which parameters are free and which are given, in the units of their tables."""
    spans = zip(ranges.names, low, high, ranges.written, strict=True)
    free, given = [], []
    for name, least, most, (unit, factor) in spans:
        behind = "" if unit in ("", "1") else f" {unit}"
        if most > least:
            free.append(f"{name} ({least / factor:.4g} to {most / factor:.4g}{behind})")
        else:
            given.append(f"{name} = {least / factor:.4g}{behind}")
    first = free[0].split(" (")[0]
    held = f"; given: {', '.join(given)}" if given else ""
    return (
        f"free, loads too: {', '.join(free)}{held}; a load that is not yours to choose is held with --known {first}=.."
    )


def _idle(problem: Problem, box: Sampled, best: LocalAnswer) -> NDArray[np.bool_]:
    """(parameter,): free ones along which, from the answer, hardly anything changes over the whole range."""
    over_box = np.ptp(box.values, axis=0)
    out = np.zeros(len(best.parameters), bool)
    for k in np.flatnonzero(problem.free):
        points = np.repeat(best.parameters[None], _ALONG, axis=0)
        points[:, k] = np.linspace(problem.low[k], problem.high[k], _ALONG)
        out[k] = bool((np.ptp(problem.values(points), axis=0) <= _MATTERS * over_box).all())
    return out


def _all_known(asked: Sequence[Formula], formulas: Mapping[str, Formula], parameters: Sequence[str]) -> None:
    """Raise DataError for a name that is neither a parameter nor a number, and say how to define it."""
    from crashkit.errors import DataError
    from evaluation.measures.formula import FUNCTIONS

    for formula in [*asked, *formulas.values()]:
        for name in sorted(formula.asked):
            if name in FUNCTIONS and name not in parameters and name not in formulas:
                raise DataError(f"{formula.text}: {name} is a function; write {name}(), such as max(displacement())")
            if name not in parameters and name not in formulas:
                raise DataError(
                    f"{formula.text}: {name!r} is neither a parameter ({', '.join(parameters)}) nor a number; define it: "
                    f"--number '{name}=2 * {parameters[0]}'"
                )


def _excess(bound: Limit, value: Value) -> Floats:
    """(run,): how far a number is beyond its bound, at most 0 where it is kept; of a field the worst node and time."""
    array = np.asarray(value.array, np.float64).reshape(len(value.array), -1)
    away = array - bound.bound if bound.sign.startswith("<") else bound.bound - array
    return np.asarray(np.nanmax(away, axis=1))


def _errors(
    surrogate: Surrogate, asked: Any, numbers_of: Any, best: LocalAnswer, time: Floats, level: int, seed: int
) -> tuple[str, Floats]:
    """Where the model's error is taken from, and by how much draws of it move each limit's number (draw, limit)."""
    from surrogates.doubt import doubt_of

    doubt = doubt_of(surrogate, best.parameters[None], time, _DRAWS, seed, level)
    if doubt is None:
        return "", np.zeros((1, len(best.excess)))
    runs = asked(best.parameters[None])
    shares = np.random.default_rng(seed + 1).uniform(-0.99, 0.99, _DRAWS)  # quantiles of the errors of histories
    draws = [
        numbers_of(runs.wrong_by(lambda nodes, w=which: doubt.draw(w, slice(0, 1), nodes), shares[which]), 1)[0, 1:]
        for which in range(_DRAWS)
    ]
    return doubt.told, np.array(draws) - best.excess


def _limits(
    bounds: Sequence[Limit], best: LocalAnswer, margins: Floats, kept: Floats, scale: Floats, problem: Problem
) -> pd.DataFrame:
    import pandas as pd

    slack = -(best.excess + margins)
    active = np.abs(slack) <= _ACTIVE * scale[1:]
    prices = _prices(problem, best, active, scale)
    rows = []
    for k, bound in enumerate(bounds):
        side = 1.0 if bound.sign.startswith("<") else -1.0
        rows.append(
            {
                "limit": bound.text, "predicted": bound.bound + side * best.excess[k], "margin": margins[k],
                "bound": bound.bound, "slack": slack[k], "active": bool(active[k]), "probability": kept[k],
                "price": prices[k], "unit": bound.unit,
            }
        )  # fmt: skip
    out = pd.DataFrame(
        rows, columns=["limit", "predicted", "margin", "bound", "slack", "active", "probability", "price", "unit"]
    )
    out.attrs["written"] = [bound.written for bound in bounds]
    return out


def _prices(problem: Problem, best: LocalAnswer, active: NDArray[np.bool_], scale: Floats) -> Floats:
    """(limit,): multipliers of the active limits, in the number's unit per unit of the limit's; 0 for the others.

    At an optimum the slope of the number is a sum of those of the active limits, but for parameters at the edge.
    """
    from scipy.optimize import nnls

    out = np.zeros(len(active))
    span = problem.high - problem.low
    inside = (
        problem.free & (best.parameters > problem.low + 1e-3 * span) & (best.parameters < problem.high - 1e-3 * span)
    )
    if active.any() and inside.any() and best.kept:
        slopes = problem.slopes(best.parameters)[:, inside] * span[inside] / scale[:, None]
        found = nnls(-slopes[1:][active].T, slopes[0])[0]
        out[active] = found * scale[0] / scale[1:][active]
    return out


def _table(
    ranges: Ranges,
    units: Sequence[str],
    factors: Floats,
    best: LocalAnswer,
    free: NDArray[np.bool_],
    idle: NDArray[np.bool_],
) -> pd.DataFrame:
    import pandas as pd

    low, high, at = ranges.low, ranges.high, best.parameters
    close = 1e-3 * (high - low)
    given = np.where((at < low - close) | (at > high + close), "given, outside the range", "given")
    edge = np.where(at <= low + close, "lower edge", np.where(at >= high - close, "upper edge", ""))
    return pd.DataFrame(
        {
            "parameter": list(ranges.names), "value": at / factors, "unit": list(units), "range_low": low / factors,
            "range_high": high / factors, "at": np.where(~free, given, np.where(idle, "hardly matters", edge)),
        }
    )  # fmt: skip


def _sensitivities(
    names: Sequence[str], units: Sequence[str], factors: Floats, bounds: Sequence[Limit], slopes: Floats, sign: float
) -> pd.DataFrame:
    import pandas as pd

    out = pd.DataFrame({"parameter": list(names), "per": [f"1 {u}".rstrip() for u in units]})
    out["value"] = sign * slopes[0] * factors
    for bound, row in zip(bounds, slopes[1:], strict=True):
        out[bound.text] = row * factors * (1.0 if bound.sign.startswith("<") else -1.0)
    return out


def _confirm(
    names: Sequence[str],
    units: Sequence[str],
    factors: Floats,
    found: Sequence[LocalAnswer],
    plain: LocalAnswer,
    low: Floats,
    high: Floats,
    count: int,
) -> pd.DataFrame:
    """Runs that would confirm the answer, or show that it was wrong, in the form of `crashkit propose`.

    The answer itself; the answer without margins, where a limit is about to break; and the next best local answers.
    """
    import pandas as pd

    span = np.where(high > low, high - low, 1.0)
    chosen: list[tuple[str, Floats]] = [("optimum", found[0].parameters)]
    for name, one in [("without_margin", plain), *((f"other_{k}", f) for k, f in enumerate(found[1:], 1))]:
        if len(chosen) < count and all(np.abs((one.parameters - p) / span).max() > 0.01 for _, p in chosen):
            chosen.append((name, one.parameters))
    heads = [f"{n} ({u})" if u else n for n, u in zip(names, units, strict=True)]
    out = pd.DataFrame(np.array([p for _, p in chosen]) / factors, columns=heads)
    out.insert(0, "run", [name for name, _ in chosen])
    return out
