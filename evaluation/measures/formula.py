"""Numbers by formula: `max(displacement(part=box, along=x))`, `cfc60(wall_force).max()`.

A formula is read with Python's own parser and walked by hand: only the operations and functions below are known, and
nothing is ever evaluated as Python. Values carry their axes (time, node), the times and the unit, so that a formula
that adds newtons to metres is refused before it gives a number. Several runs are computed at once: every array has the
runs in front.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from data_schema.units import to_si
from evaluation.errors import EvaluationError
from evaluation.measures.probes import CFC_CLASSES, cfc_filter
from evaluation.measures.rigid import fit_rigid

Floats = NDArray[np.float64]
Powers = Mapping[str, int]

AXES = {"x": 0, "y": 1, "z": 2}
FIELDS = ("displacement", "velocity", "acceleration")
_SELECTORS = ("part", "node", "along", "against")
_FILTERS = {f"cfc{c}": c for c in CFC_CLASSES}
_SHRINKING = ("max", "min", "mean", "first", "last", "time_of_max", "at", "integral", "derivative", "abs", "sqrt")
FUNCTIONS = (*FIELDS, *_FILTERS, *_SHRINKING)
# Longer texts are no formula but an accident; Python's parser is never given them.
_LONGEST = 1000
_SIGNS = {"<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal}
_NAMED: Mapping[str, Powers] = {
    "N": {"kg": 1, "m": 1, "s": -2}, "J": {"kg": 1, "m": 2, "s": -2}, "W": {"kg": 1, "m": 2, "s": -3},
    "Pa": {"kg": 1, "m": -1, "s": -2}, "Hz": {"s": -1},
}  # fmt: skip


class FormulaRuns(Protocol):
    """What a formula asks of runs, all of which have the same mesh and times."""

    @property
    def parts(self) -> Mapping[str, NDArray[np.int64]]:
        """Nodes of each part by its name."""
        ...

    def nodes(self, number: int) -> NDArray[np.int64]:
        """The place of the solver's node `number`, as an array of one; empty where there is none."""
        ...

    def position(self, nodes: NDArray[np.int64] | None) -> Floats:
        """(node, 3) undeformed, m; None: all nodes."""
        ...

    def displacement(self, nodes: NDArray[np.int64] | None) -> tuple[Floats, NDArray[np.floating]]:
        """Times (state,), s, and displacements (run, state, node, 3), m."""
        ...

    def named(self, name: str) -> Value | None:
        """A history or a parameter of that name; None where there is none."""
        ...

    @property
    def names(self) -> Sequence[str]:
        """Names of histories and parameters."""
        ...


@dataclass(frozen=True)
class Value:
    """An intermediate result: `array` (run, *axes), axes a subset of ("time", "node"), the `time` of its states, its unit.

    A number written in the formula is an array of one run.
    """

    array: NDArray[np.floating]
    axes: tuple[str, ...] = ()
    time: Floats | None = None
    unit: str = "1"


@dataclass(frozen=True)
class Formula:
    """A formula that was read and checked.

    Attributes
    ----------
    name, text
        What it is called and how it was written.
    tree
        Its expression.
    """

    name: str
    text: str
    tree: ast.expr

    @property
    def asked(self) -> frozenset[str]:
        """Names that are neither functions nor selectors: histories, parameters, other numbers."""
        return frozenset(node.id for node in _values(self.tree) if isinstance(node, ast.Name))

    @property
    def needs_field(self) -> bool:
        """Whether it asks for displacements."""
        return any(isinstance(n, ast.Call) and _called(n)[0] in FIELDS for n in ast.walk(self.tree))

    def nodes(
        self, parts: Mapping[str, NDArray[np.int64]], place: Callable[[int], NDArray[np.int64]]
    ) -> NDArray[np.int64] | None:
        """The nodes that its first field speaks of; None: all. `place` gives that of the solver's node number."""
        for node in _values(self.tree):
            if isinstance(node, ast.Call) and _called(node)[0] in FIELDS:
                words = {str(k.arg): _word(k.value, self.text) for k in node.keywords}
                if "node" in words:
                    return place(int(words["node"]))
                return part_nodes(parts, words["part"]) if "part" in words else None
        return None

    def value(self, runs: FormulaRuns, others: Mapping[str, Formula] | None = None) -> Value:
        """What it gives for `runs`.

        Parameters
        ----------
        others
            Further numbers, which it may name.

        Raises
        ------
        EvaluationError
            Where it asks for what the runs do not have, or mixes units.
        """
        return _Walk(self, runs, dict(others or {})).of(self.tree)

    def number(self, runs: FormulaRuns, others: Mapping[str, Formula] | None = None) -> Value:
        """The same, and it must be one number a run.

        Raises
        ------
        EvaluationError
            Also where time or nodes are left.
        """
        found = self.value(runs, others)
        if found.axes:
            raise EvaluationError(
                f"{self.name}: {self.text} gives a value for each {' and '.join(found.axes)}; expected one number a "
                f"run, such as max({self.text})"
            )
        return found


# In which engineers write limits.
_USUAL = {"m": "mm", "Pa": "MPa", "N": "kN", "J": "kJ", "s": "ms"}


@dataclass(frozen=True)
class Limit:
    """A bound that a number must keep: `intrusion < 80 mm`.

    Attributes
    ----------
    formula
        The left side.
    sign, bound, unit
        The right side, in SI units; the unit is empty where none was written.
    text
        As it was written.
    written
        The unit as it was written, and its value in SI.
    """

    formula: Formula
    sign: str
    bound: float
    unit: str
    text: str
    written: tuple[str, float] = ("", 1.0)

    def kept(self, value: Value) -> NDArray[np.bool_]:
        """(run, *axes): whether it is kept; False where the value is not a number.

        Raises
        ------
        EvaluationError
            Where the units do not belong together.
        """
        if not self.unit and self.bound and powers(value.unit):
            raise EvaluationError(
                f"{self.text}: {self.formula.text} is in {value.unit}; write the unit of the limit, such as "
                f"'{self.formula.text} {self.sign} {self.bound:g} {_USUAL.get(value.unit, value.unit)}'"
            )
        if self.unit and powers(self.unit) != powers(value.unit):
            raise EvaluationError(
                f"{self.text}: the limit is in {self.unit}, and {self.formula.text} in {value.unit or 'no unit'}"
            )
        return np.asarray(_SIGNS[self.sign](value.array, self.bound) & np.isfinite(value.array))


def read_formula(text: str, name: str = "") -> Formula:
    """Read and check a formula.

    Raises
    ------
    EvaluationError
        Naming what is not understood, and its place.
    """
    label = f"{name}: " if name else ""
    if not text.strip() or len(text) > _LONGEST:
        raise EvaluationError(
            f"{label}expected a formula such as max(displacement(part=box, along=x)); found {text!r:.80}"
        )
    try:
        tree = ast.parse(text.strip(), mode="eval").body
        for node in _values(tree):
            _check(node, text.strip(), label)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        if lacks := _bracket_missing(text):
            raise EvaluationError(f"{label}{text.strip()} lacks {lacks}") from error
        at = f" at character {error.offset}" if isinstance(error, SyntaxError) and error.offset else ""
        raise EvaluationError(
            f"{label}{text.strip()} is no formula{at}; expected for example max(displacement(part=box, along=x)) or "
            "cfc60(wall_force).max()"
        ) from error
    return Formula(name or text.strip(), text.strip(), tree)


def _bracket_missing(text: str) -> str:
    """Which bracket is missing, in words; empty where they come in pairs."""
    depth = 0
    for character in re.sub(r"'[^']*'|\"[^\"]*\"", "", text):
        depth += {"(": 1, ")": -1}.get(character, 0)
        if depth < 0:
            return "an opening bracket '('"
    return f"{depth} closing brackets ')'" if depth > 1 else "a closing bracket ')'" if depth else ""


def read_formulas(texts: Mapping[str, str]) -> dict[str, Formula]:
    """Formulas by name; they may name each other, in no circle.

    Raises
    ------
    EvaluationError
        For formulas and names that cannot be.
    """
    out = {}
    for name, text in texts.items():
        if not re.fullmatch(r"[A-Za-z_]\w*", str(name)) or name in FUNCTIONS:
            raise EvaluationError(
                f"{name!r} cannot be the name of a number; expected letters, digits and _, no function"
            )
        out[str(name)] = read_formula(text, str(name))
    for name in out:
        _no_circle(name, out, ())
    return out


def read_limit(text: str, formulas: Mapping[str, Formula] | None = None) -> Limit:
    """Read a limit such as "intrusion < 80 mm"; the left side is a formula, or the name of one.

    Raises
    ------
    EvaluationError
        Where it is none.
    """
    found = re.fullmatch(r"(.+?)\s*(<=|>=|<|>)\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\S.*)?", text.strip())
    if found is None or any(sign in found[1] for sign in "<>"):
        raise EvaluationError(f"{text!r} is no limit; expected a number, a sign and a bound, such as intrusion < 80 mm")
    bound, unit, factor = float(found[3]), "", 1.0
    if found[4]:
        try:
            factor, unit = to_si(found[4].strip())
        except ValueError as error:
            raise EvaluationError(f"{text!r}: the unit {found[4]!r} is not known ({error})") from error
        bound *= factor
    known = (formulas or {}).get(found[1].strip())
    return Limit(
        known or read_formula(found[1]), found[2], bound, unit, text.strip(), ((found[4] or "").strip(), factor)
    )


def part_nodes(parts: Mapping[str, NDArray[np.int64]], wanted: str) -> NDArray[np.int64]:
    """Nodes of the parts that `wanted` means: a name, a pattern (`rail*`), or a word that names have in them (`box`).

    Raises
    ------
    EvaluationError
        Where no part is meant; names those there are.
    """
    exact = [n for n in parts if n == wanted]
    found = exact or [n for n in parts if fnmatchcase(n.lower(), wanted.lower())]
    found = found or [n for n in parts if wanted.lower() in n.lower()]
    if not found:
        some = ", ".join(list(parts)[:12]) or "none"
        raise EvaluationError(f"no part {wanted!r}; there are {some}")
    return np.unique(np.concatenate([parts[n] for n in found]))


def powers(unit: str) -> dict[str, int]:
    """Exponents of the base units in a unit: "N m" -> {"kg": 1, "m": 2, "s": -2}; unknown units are bases, too."""
    out: dict[str, int] = {}
    for word, power in re.findall(r"([^\W\d]+|°)(-?\d+)?", unit):
        for base, times in _NAMED.get(word, {word: 1}).items():
            out[base] = out.get(base, 0) + times * int(power or 1)
    return {base: times for base, times in out.items() if times}


def unit_of(exponents: Mapping[str, int]) -> str:
    """The way back, with N, J, W and Pa where they are meant; "1" without a unit."""
    left = {base: times for base, times in exponents.items() if times}
    for name, own in _NAMED.items():
        if left == dict(own) and name != "Hz":
            return name
    return " ".join(base if times == 1 else f"{base}{times}" for base, times in left.items()) or "1"


# --- reading ---------------------------------------------------------------------------------------------------


def _called(node: ast.Call) -> tuple[str, list[ast.expr]]:
    """Name of a function and its arguments; of a method the object is the first."""
    if isinstance(node.func, ast.Name):
        return node.func.id, node.args
    if isinstance(node.func, ast.Attribute):
        return node.func.attr, [node.func.value, *node.args]
    return "", node.args


def _values(node: ast.expr) -> Iterator[ast.expr]:
    """Every expression that stands for a value: no names of functions, no selectors."""
    yield node
    below: list[ast.expr] = []
    if isinstance(node, ast.Call):
        name, below = _called(node)
        below = [] if name in FIELDS else below
    elif isinstance(node, ast.BinOp):
        below = [node.left, node.right]
    elif isinstance(node, ast.UnaryOp):
        below = [node.operand]
    for one in below:
        yield from _values(one)


def _check(node: ast.expr, text: str, label: str) -> None:
    """Raise EvaluationError for an expression that is not on the list; looks at this one, not below it."""

    def refuse(what: str, expected: str) -> EvaluationError:
        return EvaluationError(f"{label}{what} at character {node.col_offset + 1} of {text}; {expected}")

    if isinstance(node, ast.BinOp):
        if not isinstance(node.op, (ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow)):
            raise refuse("an operation that is not known", "there are + - * / **")
        if isinstance(node.op, ast.Pow) and not (isinstance(node.right, ast.Constant) and node.right.value in range(9)):
            raise refuse("an exponent", "expected a whole number from 0 to 8")
    elif isinstance(node, ast.UnaryOp):
        if not isinstance(node.op, (ast.UAdd, ast.USub)):
            raise refuse("an operation that is not known", "there are + - * / **")
    elif isinstance(node, ast.Constant):
        if isinstance(node.value, bool) or not isinstance(node.value, (int, float, str)):
            raise refuse(f"{node.value!r}", "expected a number")
        if isinstance(node.value, (int, float)) and not abs(node.value) < 1e300:
            raise refuse("a number that is too large", "expected below 1e300")
    elif isinstance(node, ast.Call):
        name, arguments = _called(node)
        if name not in FUNCTIONS:
            raise refuse(f"the function {name!r}" if name else "a call", f"there are {', '.join(FUNCTIONS)}")
        if any(isinstance(a, ast.Starred) for a in arguments) or any(k.arg is None for k in node.keywords):
            raise refuse("a star", "expected arguments one by one")
        allowed = _SELECTORS if name in FIELDS else ("over",) if name in ("max", "min", "mean") else ()
        for keyword in node.keywords:
            if keyword.arg not in allowed:
                raise refuse(f"{keyword.arg}=", f"{name} takes {', '.join(a + '=' for a in allowed) or 'no names'}")
            _word(keyword.value, f"{label}{keyword.arg}= of {text}")
        if name in FIELDS and arguments:
            raise refuse(f"an argument without a name in {name}", "expected part=, node=, along= or against=")
        if name not in FIELDS and not arguments:
            raise refuse(f"{name} without an argument", f"expected {name}(..)")
    elif not isinstance(node, ast.Name):
        raise refuse(f"{type(node).__name__.lower()}, which is not allowed", "expected numbers, names and functions")


def _word(node: ast.expr, place: str) -> str:
    """A selector: a bare name, a text, a whole number, or an axis with its sign."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Constant) and isinstance(node.value, (str, int)) and not isinstance(node.value, bool):
        return str(node.value)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub) and isinstance(node.operand, ast.Name):
        return f"-{node.operand.id}"
    raise EvaluationError(f"{place}: expected a name, such as part=box, part='rail*', node=120 or along=-x")


def _no_circle(name: str, formulas: Mapping[str, Formula], above: tuple[str, ...]) -> None:
    if name in above:
        raise EvaluationError(f"{' -> '.join((*above, name))}: numbers that name each other in a circle")
    for other in formulas[name].asked & formulas.keys():
        _no_circle(other, formulas, (*above, name))


# --- walking ---------------------------------------------------------------------------------------------------


@dataclass
class _Walk:
    formula: Formula
    runs: FormulaRuns
    others: dict[str, Formula]

    def of(self, node: ast.expr) -> Value:
        if isinstance(node, ast.Constant):
            if isinstance(node.value, str):
                raise self.wrong(f"the text {node.value!r} stands where a value is expected")
            return Value(np.array([float(node.value)]))  # type: ignore[arg-type]
        if isinstance(node, ast.Name):
            return self.name(node.id)
        if isinstance(node, ast.UnaryOp):
            inner = self.of(node.operand)
            sign = -1.0 if isinstance(node.op, ast.USub) else 1.0
            return Value(sign * inner.array, inner.axes, inner.time, inner.unit)
        if isinstance(node, ast.BinOp):
            return self.both(node)
        assert isinstance(node, ast.Call)
        name, arguments = _called(node)
        words = {str(k.arg): _word(k.value, self.formula.text) for k in node.keywords}
        if name in FIELDS:
            return self.field(name, words)
        if name in _FILTERS:
            return self.filtered(self.only(name, arguments), _FILTERS[name])
        if name in ("max", "min") and len(arguments) > 1:
            return self.extreme(name, arguments)
        if name == "at":
            return self.at(arguments)
        value = self.only(name, arguments)
        if name in ("max", "min", "mean"):
            return self.shrunk(name, value, words.get("over"))
        return self.along_time(name, value)

    def wrong(self, what: str) -> EvaluationError:
        return EvaluationError(f"{self.formula.name}: {what}; the formula is {self.formula.text}")

    def only(self, name: str, arguments: Sequence[ast.expr]) -> Value:
        if len(arguments) != 1:
            raise self.wrong(f"{name} takes one value, and {len(arguments)} are given")
        return self.of(arguments[0])

    def name(self, name: str) -> Value:
        if name in self.others:
            return _Walk(self.others[name], self.runs, self.others).of(self.others[name].tree)
        found = self.runs.named(name)
        if found is not None:
            return found
        parts = [self.runs.named(f"{name}_{axis}") for axis in AXES]
        there = [p for p in parts if p is not None]
        if there and all(p.axes == ("time",) for p in there):  # a resultant of its components
            squares = [np.square(np.asarray(p.array, np.float64)) for p in there]
            return Value(np.sqrt(np.sum(squares, axis=0)), ("time",), there[0].time, there[0].unit)
        known = ", ".join([*self.others, *self.runs.names][:16]) or "none"
        raise self.wrong(f"{name} is no history, parameter or number; there are {known}")

    def field(self, kind: str, words: Mapping[str, str]) -> Value:
        nodes = self.chosen(words)
        time, u = self.runs.displacement(nodes)
        u = np.asarray(u)
        if "against" in words:
            u = self.seen_from(u, nodes, part_nodes(self.runs.parts, words["against"]))
        unit = "m"
        for _ in range(FIELDS.index(kind)):
            if len(time) < 3:
                raise self.wrong(f"{kind} needs at least three states")
            u = np.gradient(u.astype(np.float64), time, axis=1, edge_order=2)
            unit = "m s-1" if unit == "m" else "m s-2"
        along = words.get("along", "")
        axis = along.lstrip("-")
        if along and axis not in AXES:
            raise self.wrong(f"along={along} is no direction; expected x, -x, y, -y, z or -z")
        if along:
            values = u[..., AXES[axis]] * (-1.0 if along.startswith("-") else 1.0)
        else:
            values = np.sqrt(np.einsum("...k,...k->...", u, u))
        return Value(values, ("time", "node"), time, unit)

    def chosen(self, words: Mapping[str, str]) -> NDArray[np.int64] | None:
        try:
            if "node" in words:
                nodes = self.runs.nodes(int(words["node"]))
                if not len(nodes):
                    raise self.wrong(f"there is no node {words['node']}")
                return nodes
            return part_nodes(self.runs.parts, words["part"]) if "part" in words else None
        except ValueError as error:
            raise self.wrong(f"node={words['node']} is no node number") from error
        except EvaluationError as error:
            raise EvaluationError(f"{self.formula.name}: {error}") from None

    def seen_from(
        self, u: NDArray[np.floating], nodes: NDArray[np.int64] | None, watching: NDArray[np.int64]
    ) -> NDArray[np.floating]:
        """`u` without the motion of the nodes `watching`."""
        x, there = self.runs.position(None), self.runs.displacement(watching)[1]
        if len(watching) < 3:
            raise self.wrong(f"against= has {len(watching)} nodes; expected at least three")
        mine = x if nodes is None else x[nodes]
        out = np.empty(u.shape)
        for k, (run, seat) in enumerate(zip(u, there, strict=True)):
            out[k] = fit_rigid(x[watching], seat).deformation(mine, run)
        return out

    def filtered(self, value: Value, cfc: int) -> Value:
        if value.axes[:1] != ("time",) or value.time is None:
            raise self.wrong(f"cfc{cfc} filters a curve over time")
        turned = np.moveaxis(np.asarray(value.array, np.float64), 1, 0)
        try:
            return Value(np.moveaxis(cfc_filter(value.time, turned, cfc), 0, 1), value.axes, value.time, value.unit)
        except EvaluationError as error:
            raise self.wrong(str(error)) from error

    def extreme(self, name: str, arguments: Sequence[ast.expr]) -> Value:
        values = [self.of(a) for a in arguments]
        if len({tuple(sorted(powers(v.unit).items())) for v in values}) > 1:
            raise self.wrong(f"{name} of values in {', '.join(v.unit for v in values)}")
        if any(v.axes for v in values):
            raise self.wrong(f"{name} of several values takes numbers; take {name} of each first")
        pick = np.fmax if name == "max" else np.fmin
        out = values[0].array
        for v in values[1:]:
            out = pick(out, v.array)
        return Value(out, (), None, values[0].unit)

    def shrunk(self, name: str, value: Value, over: str | None) -> Value:
        if over is not None and over not in value.axes:
            raise self.wrong(f"over={over}, and the value has {' and '.join(value.axes) or 'no axis'}")
        places = tuple(1 + k for k, axis in enumerate(value.axes) if over is None or axis == over)
        left = tuple(a for a in value.axes if over is not None and a != over)
        if not places:
            return value
        time = value.time if "time" in left else None
        return Value(_without_gaps(name, value.array, places), left, time, value.unit)

    def along_time(self, name: str, value: Value) -> Value:
        array = np.asarray(value.array, np.float64)
        if name == "abs":
            return Value(np.abs(array), value.axes, value.time, value.unit)
        if name == "sqrt":
            half = {base: times // 2 for base, times in powers(value.unit).items() if times % 2 == 0}
            if len(half) < len(powers(value.unit)):
                raise self.wrong(f"the root of a value in {value.unit}")
            return Value(np.sqrt(np.where(array < 0, np.nan, array)), value.axes, value.time, unit_of(half))
        if value.axes[:1] != ("time",) or value.time is None:
            raise self.wrong(f"{name} takes a value over time")
        rest, time = value.axes[1:], value.time
        if name == "first":
            return Value(array[:, 0], rest, None, value.unit)
        if name == "last":
            return Value(_last(array), rest, None, value.unit)
        if name == "time_of_max":
            return Value(time[np.argmax(np.where(np.isfinite(array), array, -np.inf), axis=1)], rest, None, "s")
        if name == "integral":
            total = np.asarray(np.trapezoid(np.nan_to_num(array), time, axis=1))
            return Value(total, rest, None, _times(value.unit, "s", 1))
        slope = np.gradient(array, time, axis=1, edge_order=2 if len(time) > 2 else 1)
        return Value(slope, value.axes, time, _times(value.unit, "s", -1))

    def at(self, arguments: Sequence[ast.expr]) -> Value:
        if len(arguments) != 2 or not isinstance(arguments[1], ast.Constant):
            raise self.wrong("at takes a value and a time, such as at(displacement(node=3), '20 ms')")
        value, given = self.of(arguments[0]), arguments[1].value
        if value.axes[:1] != ("time",) or value.time is None:
            raise self.wrong("at takes a value over time")
        when = float(given) if isinstance(given, (int, float)) else _seconds(str(given))
        if not value.time[0] - 1e-12 <= when <= value.time[-1] * (1 + 1e-9):
            raise self.wrong(f"{given!r} lies outside the times {value.time[0]:g} to {value.time[-1]:g} s")
        place = int(np.clip(np.searchsorted(value.time, when) - 1, 0, max(len(value.time) - 2, 0)))
        if len(value.time) == 1:
            return Value(value.array[:, 0], value.axes[1:], None, value.unit)
        share = (when - value.time[place]) / (value.time[place + 1] - value.time[place])
        between = value.array[:, place] * (1 - share) + value.array[:, place + 1] * share
        return Value(between, value.axes[1:], None, value.unit)

    def both(self, node: ast.BinOp) -> Value:
        a, b = self.of(node.left), self.of(node.right)
        if a.axes and b.axes and (a.axes != b.axes or not _same_times(a.time, b.time)):
            raise self.wrong(
                "two values at different times or on different nodes; take max, mean or last of them first"
            )
        wide = a if len(a.axes) >= len(b.axes) else b
        left, right = _spread(a, wide), _spread(b, wide)
        with np.errstate(divide="ignore", invalid="ignore"):
            if isinstance(node.op, ast.Pow):
                times = int(node.right.value)  # type: ignore[attr-defined]
                unit = unit_of({base: p * times for base, p in powers(a.unit).items()})
                return Value(left**times, wide.axes, wide.time, unit)
            if isinstance(node.op, (ast.Add, ast.Sub)):
                if powers(a.unit) != powers(b.unit):
                    raise self.wrong(f"{a.unit} and {b.unit} are added or subtracted")
                return Value(
                    left + right if isinstance(node.op, ast.Add) else left - right, wide.axes, wide.time, a.unit
                )
            if isinstance(node.op, ast.Mult):
                return Value(left * right, wide.axes, wide.time, _times(a.unit, b.unit, 1))
            return Value(left / right, wide.axes, wide.time, _times(a.unit, b.unit, -1))


def _same_times(a: Floats | None, b: Floats | None) -> bool:
    return a is None or b is None or (len(a) == len(b) and bool(np.allclose(a, b, rtol=1e-6, atol=1e-12)))


def _spread(value: Value, wide: Value) -> Floats:
    array = np.asarray(value.array, np.float64)
    return array if value.axes == wide.axes else array.reshape(len(array), *([1] * len(wide.axes)))


def _times(a: str, b: str, power: int) -> str:
    out = powers(a)
    for base, times in powers(b).items():
        out[base] = out.get(base, 0) + power * times
    return unit_of(out)


def _seconds(text: str) -> float:
    found = re.fullmatch(r"\s*(\d+\.?\d*(?:[eE][-+]?\d+)?)\s*(\S+)\s*", text)
    if found is None or to_si(found[2])[1] != "s":
        raise EvaluationError(f"{text!r} is no time; expected for example '20 ms'")
    return float(found[1]) * to_si(found[2])[0]


def _without_gaps(name: str, array: NDArray[np.floating], places: tuple[int, ...]) -> Floats:
    """Largest, smallest or mean over axes, of what is there; NaN where nothing is."""
    there = np.isfinite(array)
    if name == "mean":
        count = there.sum(axis=places)
        total = np.where(there, array, 0).sum(axis=places, dtype=np.float64)
        return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))
    beyond = -np.inf if name == "max" else np.inf
    pick: Callable[..., Any] = np.max if name == "max" else np.min
    found = np.asarray(pick(np.where(there, array, beyond), axis=places), np.float64)
    return np.where(np.isfinite(found), found, np.nan)


def _last(array: Floats) -> Floats:
    """The last value that is there along axis 1."""
    there = np.isfinite(array)
    place = array.shape[1] - 1 - np.argmax(there[:, ::-1], axis=1)
    return np.asarray(np.take_along_axis(array, place[:, None], axis=1)[:, 0])
