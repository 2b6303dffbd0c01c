"""What scatter of the parameters does: distributions, probabilities, and where runs begin to differ."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from crashkit.display import watched
from data_schema.progress import Progress

if TYPE_CHECKING:
    from crashkit.api._predicted import FormulaMesh
    from crashkit.api.model import Model
    from evaluation.measures.formula import Formula, Limit
    from evaluation.scatter.draws import Plan, Scatter, Shape
    from evaluation.scatter.result import LimitKept, ScatterResult
    from surrogates.data.inputs import Ranges
    from surrogates.surrogate import Surrogate

Floats = NDArray[np.float64]

# Bytes of fields in memory at once; draws and nodes of a part that are kept for the principal components.
_AT_ONCE = 64 << 20
# With fewer draws, percentiles and influences are chance.
_FEW_DRAWS = 100
_KEPT_DRAWS, _KEPT_NODES = 256, 48
# Draws whose shape at the end is compared, and nodes of it.
_SHAPES, _SHAPE_NODES = 20_000, 200
# Draws, and models drawn from the model's own uncertainty, behind the doubt of a probability.
_DOUBTED, _MODELS = 256, 40
_LARGEST = "largest_displacement"


def scatter(
    model: Model | Surrogate | str | Path,
    vary: Mapping[str, Any],
    output: str | Path | None = None,
    *,
    at: Mapping[str, Any] | None = None,
    draws: int = 10_000,
    numbers: Mapping[str, str] | None = None,
    limits: Sequence[str] = (),
    shape: Shape = "normal",
    plan: Plan = "latin",
    level: int | None = None,
    confidence: float = 0.9,
    seed: int = 0,
    overwrite: bool = False,
    report: Progress | None = None,
    progress: bool | Literal["auto"] = "auto",
) -> ScatterResult:
    """Predict many draws of scattering parameters, and say how fields and numbers scatter.

    Fields are predicted a few draws at a time, so that memory does not grow with the number of draws.

    Parameters
    ----------
    model
        A model, or its folder; the training data is not needed.
    vary
        Parameter -> how far it scatters: "5%" of its nominal value, "2deg", or a number in SI units; the standard
        deviation of a normal scatter, half the range of a uniform one ("5%:uniform").
    output
        Folder to write; without it nothing is written.
    at
        Nominal values by name, as for `Model.predict`; the middle of the trained range for the others.
    draws
        How many.
    numbers
        Name -> formula, such as {"intrusion": "max(displacement(part=box, along=x))"}; besides those of the model's
        settings, and the largest displacement.
    limits
        Such as "intrusion < 80 mm"; of a field ("displacement(part=floor) < 0.1 m") it is kept where every node keeps it.
    shape
        Of the scatter that does not say its own: normal or uniform.
    plan
        How draws are spread: latin (hypercube) or sobol.
    level
        Predict from this mesh level of the model.
    confidence
        Of the intervals of probabilities.
    seed
        Of all random numbers.
    overwrite
        Replace an earlier result in `output`.
    report, progress
        As for `crashkit.train`.

    Raises
    ------
    DataError
        For parameters that are unknown, or a nominal value far outside the trained range.
    EvaluationError
        For formulas and limits that are none, or that do not fit the model.
    OutputError
        Where `output` cannot be written.
    """
    from crashkit.extras import need

    need("a scatter", "train", "report")
    from crashkit.api._predicted import FormulaMesh
    from crashkit.api.numbers import model_formulas
    from crashkit.api.predict import model_in_hand
    from crashkit.output import check_folder, complete_folder, refuse_earlier
    from evaluation.measures.formula import read_formulas, read_limit
    from evaluation.scatter.draws import draw

    if output is not None and not overwrite:
        refuse_earlier(Path(output), "scatter.json", "scatter")
    if output is not None:
        check_folder(Path(output), "scatter.json")
    tell = watched(report, progress)
    trained = model_in_hand(model)
    surrogate = trained.surrogate
    structure = FormulaMesh.of(surrogate)
    number = surrogate.number(level)
    nominal, scatters = _scatters(surrogate.record.ranges, vary, at or {}, shape)
    known = {name: formula.text for name, formula in model_formulas(surrogate).items()}
    formulas = read_formulas({_LARGEST: "max(displacement())", **known, **(numbers or {})})
    bounds = [read_limit(text, formulas) for text in limits]
    study = _Study(surrogate, structure, nominal, scatters, formulas, bounds, number, seed, tell)
    study.check()
    result = study.result(draw(scatters, draws, seed, plan), confidence)
    result = _described(result, trained, plan, seed, level)
    if output is not None:
        with complete_folder(Path(output), "scatter.json") as folder:
            _write(result, trained, study, folder, tell)
    return result


class _Study:
    """The passes over the draws."""

    def __init__(
        self,
        surrogate: Surrogate,
        structure: FormulaMesh,
        nominal: Floats,
        scatters: Sequence[Scatter],
        formulas: Mapping[str, Formula],
        bounds: Sequence[Limit],
        level: int,
        seed: int,
        tell: Progress,
    ) -> None:
        self.structure, self.nominal, self.scatters = structure, nominal, tuple(scatters)
        self.formulas, self.bounds, self.level, self.seed, self.tell = formulas, bounds, level, seed, tell
        self.surrogate = surrogate
        self.time = self.surrogate.record.time
        names = self.surrogate.record.ranges.names
        self.columns = [names.index(one.name) for one in self.scatters]
        run = len(self.time) * structure.size * 12
        self.rows = max(1, min(256, _AT_ONCE // run))

    def runs(self, parameters: Floats, states: NDArray[np.floating] | None = None) -> Any:
        from crashkit.api._predicted import PredictedRuns

        return PredictedRuns(self.surrogate, self.structure, parameters, self.time, self.level, states)

    def states(self, parameters: Floats) -> NDArray[np.float32]:
        """(run, state, node, 3), m; raises DataError for parameters at which the model has no numbers, such as a speed below 0."""
        from crashkit.errors import DataError

        with np.errstate(invalid="ignore", over="ignore"):  # refused in the next line
            states = self.surrogate.predict_full(parameters, self.time, self.level)
        bad = ~np.isfinite(states).all(axis=(1, 2, 3))
        if bad.any():
            ranges = self.surrogate.record.ranges
            values = parameters[int(bad.argmax())]
            some = ", ".join(f"{one.name} {values[k]:.4g} {one.unit}" for one, k in zip(self.scatters, self.columns))
            raise DataError(
                f"a draw with {some} gives numbers that are not finite: the model takes "
                + ", ".join(f"{ranges.names[k]} from {ranges.low[k]:.4g} to {ranges.high[k]:.4g}" for k in self.columns)
                + "; let them scatter less, or within limits, such as --vary NAME=WIDTH:uniform"
            )
        return states

    def full(self, draws: Floats) -> Floats:
        """(draw, parameter that scatters) -> (draw, parameter of the model)."""
        out = np.repeat(self.nominal[None], len(draws), axis=0)
        out[:, self.columns] = draws
        return out

    def check(self) -> None:
        """Raise EvaluationError for formulas and limits that do not fit, before anything long begins."""
        runs = self.runs(self.nominal[None])
        for formula in self.formulas.values():
            formula.number(runs, self.formulas)
        for bound in self.bounds:
            bound.kept(bound.formula.value(runs, self.formulas))

    def blocks(self, draws: Floats, what: str) -> Iterator[tuple[slice, Floats]]:
        self.tell(what, 0, len(draws), "")
        for begin in range(0, len(draws), self.rows):
            rows = slice(begin, min(begin + self.rows, len(draws)))
            yield rows, self.full(draws[rows])
            self.tell(what, rows.stop, len(draws), "")

    def values(self, runs: Any, count: int) -> Floats:
        """(number, run)"""
        found = [f.number(runs, self.formulas).array for f in self.formulas.values()]
        return np.stack([np.broadcast_to(np.asarray(v, np.float64), (count,)) for v in found])

    def result(self, draws: Floats, confidence: float) -> ScatterResult:
        from evaluation.scatter.differences import differences
        from evaluation.scatter.draws import sobol
        from evaluation.scatter.fields import Exceedance, FieldTally
        from evaluation.scatter.folding import folding_modes
        from evaluation.scatter.result import Number, ScatterResult

        structure, surrogate = self.structure, self.surrogate
        position = self.runs(self.nominal[None]).position(None)
        first = self.runs(self.nominal[None], surrogate.predict_full(self.nominal[None], self.time, self.level))
        tally = FieldTally(first.displacement(None)[1][0])
        groups, kept_nodes = _groups(structure, position)
        shape_nodes = np.unique(np.linspace(0, structure.size - 1, _SHAPE_NODES).astype(int))
        kept, ends = [], []
        found = np.empty((len(self.formulas), len(draws)))
        broken = np.empty((len(self.bounds), len(draws)), bool)
        fields = {
            k: Exceedance(len(self.time), structure.size, _nodes(bound.formula, structure))
            for k, bound in enumerate(self.bounds)
            if set(bound.formula.value(first, self.formulas).axes) == {"time", "node"}
        }
        for rows, parameters in self.blocks(draws, "draws"):
            states = self.states(parameters)
            runs = self.runs(parameters, states)
            tally.add(states)
            found[:, rows] = self.values(runs, len(parameters))
            for k, bound in enumerate(self.bounds):
                value = bound.formula.value(runs, self.formulas)
                bad = ~bound.kept(value)
                broken[k, rows] = bad.reshape(len(bad), -1).any(axis=1)
                if k in fields:
                    fields[k].add(bad)
            if rows.start < _KEPT_DRAWS:
                kept.append(states[: _KEPT_DRAWS - rows.start][:, :, kept_nodes])
            if rows.start < _SHAPES:
                ends.append(states[: _SHAPES - rows.start, -1][:, shape_nodes])
        doubt, again, as_is = self.doubted(draws)
        self.tell("groups of shapes", 0, 0, "")
        shapes = np.concatenate(ends)
        folding = folding_modes(position[shape_nodes], shapes, draws[: len(shapes)], self.seed)
        values = self.values(first, 1)[:, 0]
        names = list(self.formulas)
        units = [f.number(first, self.formulas).unit for f in self.formulas.values()]
        indices = sobol(self.scatters, self.numbers, min(len(draws), 8192), self.seed + 1, confidence)
        ranges = surrogate.record.ranges
        spans = {n: (float(a), float(b)) for n, a, b in zip(ranges.names, ranges.low, ranges.high, strict=True)}
        inside = np.array(
            [(draws[:, k] >= spans[s.name][0]) & (draws[:, k] <= spans[s.name][1]) for k, s in enumerate(self.scatters)]
        )
        within = np.asarray(inside.all(axis=0))
        limits = self.kept(broken, again, as_is, fields, ~within, confidence)
        return ScatterResult(
            scatter=self.scatters,
            nominal=dict(zip(ranges.names, map(float, self.nominal), strict=True)),
            ranges=spans,
            draws=draws,
            inside=within,
            numbers=tuple(
                Number(n, self.formulas[n].text, u, float(v), row)
                for n, u, v, row in zip(names, units, values, found, strict=True)
            ),
            limits=limits,
            indices=indices,
            differences=differences(list(groups), self.time, np.concatenate(kept), list(groups.values())),
            folding=folding,
            time=self.time,
            position=position,
            faces=_faces(surrogate),
            mean=tally.mean,
            deviation=tally.deviation,
            doubt=doubt,
            warnings=(*_too_few(len(draws)), *_outside(ranges, self.scatters, inside)),
            about={},
        )

    def numbers(self, draws: Floats) -> Floats:
        """(number, draw), for the indices."""
        out = np.empty((len(self.formulas), len(draws)))
        for rows, parameters in self.blocks(draws, "draws for the indices"):
            out[:, rows] = self.values(self.runs(parameters), len(parameters))
        return out

    def doubted(self, draws: Floats) -> tuple[str, NDArray[np.bool_] | None, NDArray[np.bool_] | None]:
        """What the model's doubt comes from; limits broken (limit, model, some draws) with it, and (limit, draw) without."""
        from surrogates.doubt import doubt_of

        if not self.bounds:
            return "", None, None
        some = self.full(draws[np.random.default_rng(self.seed).permutation(len(draws))[:_DOUBTED]])
        doubt = doubt_of(self.surrogate, some, self.time, _MODELS, self.seed + 2, self.level)
        if doubt is None:
            return "", None, None
        again = np.empty((len(self.bounds), _MODELS, len(some)), bool)
        as_is = np.empty((len(self.bounds), len(some)), bool)
        shares = np.random.default_rng(self.seed + 3).uniform(-0.99, 0.99, _MODELS)
        what = "draws with the model's doubt"
        for begin in range(0, len(some), self.rows):
            rows = slice(begin, min(begin + self.rows, len(some)))
            runs = self.runs(some[rows])
            as_is[:, rows] = self.broken(runs)
            for which in range(_MODELS):
                wrong = runs.wrong_by(lambda nodes, w=which, r=rows: doubt.draw(w, r, nodes), shares[which])
                again[:, which, rows] = self.broken(wrong)
            self.tell(what, rows.stop, len(some), "")
        return doubt.told, again, as_is

    def broken(self, runs: Any) -> NDArray[np.bool_]:
        """(limit, run)"""
        out = []
        for bound in self.bounds:
            bad = ~bound.kept(bound.formula.value(runs, self.formulas))
            out.append(bad.reshape(len(bad), -1).any(axis=1))
        return np.stack(out)

    def kept(
        self,
        broken: NDArray[np.bool_],
        again: NDArray[np.bool_] | None,
        as_is: NDArray[np.bool_] | None,
        fields: Mapping[int, Any],
        outside: NDArray[np.bool_],
        confidence: float,
    ) -> tuple[LimitKept, ...]:
        from evaluation.scatter.probability import probability
        from evaluation.scatter.result import LimitKept

        out = []
        for k, bound in enumerate(self.bounds):
            models, alone = (None, None) if again is None or as_is is None else (again[k], as_is[k])
            found = probability(broken[k], models, alone, confidence, self.seed)
            field = fields.get(k)
            out.append(
                LimitKept(
                    bound.text, bound.formula.name, bound.bound, found,
                    None if field is None else field.ever, None if field is None else field.probability,
                    float((broken[k] & outside).mean()),
                )
            )  # fmt: skip
        return tuple(out)


def _scatters(
    ranges: Ranges, vary: Mapping[str, Any], at: Mapping[str, Any], shape: Shape
) -> tuple[Floats, tuple[Scatter, ...]]:
    """Nominal values (parameter,) and what scatters."""
    from crashkit.api.parameters import parameter_values
    from crashkit.errors import DataError
    from evaluation.scatter.draws import Scatter
    from surrogates.data.inputs import far_outside

    known = ", ".join(ranges.names)
    for name in (*vary, *at):
        if name not in ranges.names:
            raise DataError(f"parameter {name!r} is not known; the model takes {known}")
    if not vary:
        raise DataError(f"nothing scatters; name at least one of {known}, such as {ranges.names[0]}=5%")
    middle = dict(zip(ranges.names, map(float, (ranges.low + ranges.high) / 2), strict=True))
    nominal = parameter_values({**middle, **at}, ranges)
    far = far_outside(ranges, nominal[None], np.array(ranges.time))
    if far:
        beyond = ranges.beyond(nominal, np.array(ranges.time))
        said = "; ".join(beyond[name] for name in far)
        raise DataError(f"{said}: that is far outside, and nothing is known there; check the value and its unit")
    out = []
    for name, given in vary.items():
        k = ranges.names.index(name)
        text, _, own = str(given).partition(":") if isinstance(given, str) else ("", "", "")
        if own.strip() not in ("", "normal", "uniform"):
            raise DataError(f"{name}={given}: {own.strip()!r} is no kind of scatter; expected normal or uniform")
        if text.strip().startswith("-"):
            raise DataError(
                f"{name}={given}: a scatter has no sign, it goes to both sides; write {name}={text.strip()[1:]}"
            )
        percent = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)\s*%\s*", text)
        if percent is not None and ranges.units[k] not in ("%", "percent"):
            width = float(percent[1]) / 100 * abs(nominal[k])
            if not width:
                raise DataError(
                    f"{name}={given}: the nominal value is zero, so per cent say nothing; give it with a unit"
                )
        else:
            zeros = {**middle, name: given if not isinstance(given, str) else text}
            width = float(parameter_values(zeros, ranges)[k])
        if width <= 0:
            raise DataError(f"{name}={given}: expected a width above zero, such as {name}=5%")
        out.append(Scatter(name, ranges.units[k], float(nominal[k]), width, own.strip() or shape))  # type: ignore[arg-type]
    return nominal, tuple(out)


def _too_few(draws: int) -> tuple[str, ...]:
    """A sentence where there are so few draws that shares and percentiles say little."""
    if draws >= _FEW_DRAWS:
        return ()
    return (
        f"{draws} draws are few: percentiles, probabilities and influences need at least {_FEW_DRAWS}; take more with -n",
    )


def _outside(ranges: Ranges, scatters: Sequence[Scatter], inside: NDArray[np.bool_]) -> tuple[str, ...]:
    """A sentence for each parameter that draws leave the trained range of."""
    out = []
    for one, within in zip(scatters, inside, strict=True):
        if within.all():
            continue
        k = ranges.names.index(one.name)
        unit, factor = ranges.written[k]
        span = f"{ranges.low[k] / factor:g} to {ranges.high[k] / factor:g}{'' if unit in ('', '1') else ' ' + unit}"
        out.append(
            f"{100 * (1 - within.mean()):.1f} % of the draws of {one.name} lie outside the trained range {span}, where the "
            "model extrapolates"
        )
    return tuple(out)


def _groups(structure: FormulaMesh, position: Floats) -> tuple[dict[str, NDArray[np.int64]], NDArray[np.int64]]:
    """Places of each part's nodes among some kept nodes, and these; boxes of the structure where there is one part."""
    from evaluation.measures.regions import by_grid

    parts = dict(structure.parts)
    if len(parts) < 2:
        longest = np.argsort(-np.ptp(position, axis=0))[:2]
        cuts = [1, 1, 1]
        cuts[longest[0]], cuts[longest[1]] = 6, 2
        boxes = by_grid(position, cuts)
        parts = dict(zip(boxes.names, boxes.nodes, strict=True))
    some = {n: nodes[np.unique(np.linspace(0, len(nodes) - 1, _KEPT_NODES).astype(int))] for n, nodes in parts.items()}
    kept = np.unique(np.concatenate(list(some.values())))
    return {name: np.searchsorted(kept, nodes) for name, nodes in some.items()}, kept


def _nodes(formula: Formula, structure: FormulaMesh) -> NDArray[np.int64] | None:
    """The nodes that a formula speaks of; None: all."""
    return formula.nodes(structure.parts, structure.nodes)


def _faces(surrogate: Surrogate) -> NDArray[np.int32]:
    from crashkit.errors import DataError

    if surrogate.faces is None:
        raise DataError("the model was stored without its mesh; train it again from a dataset")
    return surrogate.faces


def _described(result: ScatterResult, model: Model, plan: str, seed: int, level: int | None) -> ScatterResult:
    """With the facts that belong to it."""
    from dataclasses import replace

    from crashkit.version import __version__

    record, ranges = model.record, model.record.ranges
    written = zip(ranges.names, ranges.written, strict=True)
    nominal = ", ".join(f"{n} {result.nominal[n] / f:.4g} {'' if u == '1' else u}".strip() for n, (u, f) in written)
    units = dict(zip(ranges.names, ranges.written, strict=True))
    widths = ", ".join(
        f"{s.name} {s.shape}, {s.width / units[s.name][1]:.4g} {units[s.name][0]}" for s in result.scatter
    )
    return replace(
        result,
        about={
            "Model": model.name,
            "Dataset": f"{record.attributes.get('dataset') or 'not recorded'}, checksum {record.checksum[:12] or 'none'}",
            "Training runs": str(len(record.fitted_runs)),
            "Level": "finest" if level is None else str(level),
            "Nominal": nominal,
            "Scatter": f"{widths} (standard deviation of a normal scatter, half the range of a uniform one)",
            "Draws": f"{len(result.draws)}, {'Latin hypercube' if plan == 'latin' else 'Sobol sequence'}, seed {seed}",
            "Model's doubt": result.doubt or "none",
            "Version": f"crashkit {__version__}",
        },
    )


def _write(result: ScatterResult, model: Model, study: _Study, folder: Path, tell: Progress) -> None:
    """Page, figures, tables, and files for ParaView."""
    from evaluation.scatter.page import write_scatter

    tell("figures", 0, 0, "")
    write_scatter(result, folder, done=lambda name: tell("figures", 0, 0, name))
    tell("files for ParaView", 0, 0, "")
    _write_fields(result, model, folder / "fields.pvd")
    if result.folding.count > 1:
        from crashkit.writers.run import write_run

        for k, which in enumerate(result.folding.typical):
            parameters = study.full(result.draws[which : which + 1])[0]
            named = dict(zip(model.record.ranges.names, map(float, parameters), strict=True))
            import warnings

            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                run = model.predict(named, extrapolate=True)
            write_run(run, folder / f"mode_{k + 1}.pvd", {"model": model.name, "folding_mode": str(k + 1)})


def _write_fields(result: ScatterResult, model: Model, path: Path) -> None:
    """Mean, deviation and probabilities by node and state."""
    from crashkit.writers.paraview import write_paraview

    points: dict[str, Any] = {"displacement": result.mean, "deviation": result.deviation}
    units = {"displacement": "m", "deviation": "m"}
    for k, limit in enumerate(found for found in result.limits if found.by_state is not None):
        points[f"probability_{k + 1}"], points[f"probability_{k + 1}_ever"] = limit.by_state, limit.ever
    labels = model.surrogate.labels
    cells: dict[str, Any] = {}
    if labels is not None:
        points["node_id"] = labels.node_id
        cells["part_id"] = labels.part_id[labels.face_part]
    texts = {
        f"probability_{k + 1}_is_of": x.text for k, x in enumerate(f for f in result.limits if f.by_state is not None)
    }
    about = {"model": model.name, "draws": len(result.draws), **texts}
    write_paraview(path, result.position, result.faces, result.time, points, cells, units=units, field_data=about)
