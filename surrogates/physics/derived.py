"""Inputs derived from units: logarithms, a warped angle, and monomials that are dimensionless with what is constant.

Runs of equal density * speed^2 / strength deform alike (Johnson's damage number; Johnson 1972, Impact Strength of
Materials). The density is the same in all runs of a campaign, and so is the size of the structure, so a monomial of
parameters counts as dimensionless if it is so together with powers of a density and a length: only time must cancel.
In logarithms a monomial is a sum, so it is one more way to choose the axes along which a process has its lengths. A full
matrix of lengths finds such axes by itself, given runs enough; a few named ones do it with fewer.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from surrogates.errors import SurrogateError

Dimension = tuple[float, float, float] | None

SPEED, STRESS, LENGTH, MASS = (0.0, 1.0, -1.0), (1.0, -1.0, -2.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)
# A logarithm is worth its name where the largest value is at least this many times the smallest.
_SPREADS = 1.2
# A parameter that changes its sign is warped as asinh(x / w), w being this share of its largest value.
WARP = 1 / 3
# Monomials that are tried at most.
_MOST = 40
_TOKEN = re.compile(r"\*\*|\d+\.?\d*|\.\d+|[^\W\d]\w*|\S")


@dataclass(frozen=True)
class Column:
    """One input: a parameter as it is, warped, or the logarithm of a monomial of parameters.

    Attributes
    ----------
    powers
        Exponent of each parameter; for a parameter as it is, or warped, a single 1.
    width
        W of asinh(x / w); 0 where it is not warped.
    """

    powers: tuple[float, ...]
    logarithm: bool = False
    width: float = 0.0

    def values(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """(run, parameter) -> (run,)"""
        powers = np.array(self.powers)
        if self.logarithm:
            used = powers != 0
            return np.asarray(np.log(parameters[:, used]) @ powers[used])
        value = parameters[:, int(np.argmax(powers))]
        return np.arcsinh(value / self.width) if self.width else value

    def named(self, names: Sequence[str]) -> str:
        """Such as "ln(impact_speed^2 / yield_stress)"."""
        if not self.logarithm:
            name = names[int(np.argmax(self.powers))]
            return f"asinh({name} / {self.width:.3g})" if self.width else name
        return f"ln({monomial(self.powers, names)})"


@dataclass(frozen=True)
class DerivedInputs:
    """Which inputs a model reads in place of the parameters.

    Attributes
    ----------
    names
        Of the parameters.
    columns
        As many as there are parameters, and as much in them: the way back exists.
    mixed
        Columns whose lengths may form a full matrix in a process.
    """

    names: tuple[str, ...]
    columns: tuple[Column, ...]
    mixed: tuple[int, ...] = ()

    @classmethod
    def identity(cls, names: Sequence[str]) -> DerivedInputs:
        """The parameters as they are."""
        return cls(tuple(names), tuple(Column(row) for row in _unit_rows(len(names))))

    @property
    def is_identity(self) -> bool:
        return not self.mixed and not any(c.logarithm or c.width for c in self.columns)

    def apply(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """(run, parameter) -> (run, column).

        Raises
        ------
        SurrogateError
            For a logarithm of what is not positive.
        """
        values = np.atleast_2d(np.asarray(parameters, np.float64))
        for k, name in enumerate(self.names):
            if any(c.logarithm and c.powers[k] for c in self.columns) and (values[:, k] <= 0).any():
                raise SurrogateError(
                    f"{name} = {values[:, k].min():g}: the model takes its logarithm; expected a value above 0"
                )
        return np.stack([c.values(values) for c in self.columns], axis=1)

    def undo(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """(run, column) -> (run, parameter)"""
        out = np.zeros_like(inputs)
        logs = [k for k, c in enumerate(self.columns) if c.logarithm]
        for k, column in enumerate(self.columns):
            if not column.logarithm:
                value = np.sinh(inputs[:, k]) * column.width if column.width else inputs[:, k]
                out[:, int(np.argmax(column.powers))] = value
        if logs:
            powers = np.array([self.columns[k].powers for k in logs])
            used = np.flatnonzero(powers.any(axis=0))
            out[:, used] = np.exp(np.linalg.solve(powers[:, used], inputs[:, logs].T).T)
        return out

    def told(self) -> list[str]:
        """The inputs by name."""
        return [column.named(self.names) for column in self.columns]

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        columns = [{"powers": list(c.powers), "logarithm": c.logarithm, "width": c.width} for c in self.columns]
        return {"names": list(self.names), "columns": columns, "mixed": list(self.mixed)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> DerivedInputs:
        """The way back."""
        columns = tuple(
            Column(tuple(float(p) for p in c["powers"]), bool(c["logarithm"]), float(c["width"]))
            for c in values["columns"]
        )
        return cls(tuple(values["names"]), columns, tuple(int(k) for k in values["mixed"]))


def logarithms(
    names: Sequence[str], parameters: NDArray[np.float64], *, warp: bool, odd: Sequence[str] = ()
) -> DerivedInputs:
    """Logarithms of the parameters that are positive and spread; those that change sign warped, if asked.

    Parameters
    ----------
    parameters
        (run, parameter).
    odd
        Parameters that change their sign in mirrored runs, whatever sign they have here.
    """
    columns = []
    for k, row in enumerate(_unit_rows(len(names))):
        value = parameters[:, k]
        if is_positive(value) and names[k] not in odd:
            columns.append(Column(row, logarithm=True))
        elif warp and (names[k] in odd or value.min() < 0 < value.max()) and value.any():
            columns.append(Column(row, width=float(f"{WARP * np.abs(value).max():.3g}")))
        else:
            columns.append(Column(row))
    return DerivedInputs(tuple(names), tuple(columns))


def is_positive(value: NDArray[np.float64]) -> bool:
    """Whether values (run,) have logarithms that are worth taking."""
    return bool(value.min() > 0 and value.max() >= _SPREADS * value.min())


def with_matrix(inputs: DerivedInputs, odd: Sequence[str]) -> DerivedInputs:
    """`inputs` with a full matrix over the logarithms of parameters that the mirror leaves as they are."""
    mixed = [
        k for k, c in enumerate(inputs.columns)
        if c.logarithm and not any(c.powers[inputs.names.index(name)] for name in odd)
    ]  # fmt: skip
    return DerivedInputs(inputs.names, inputs.columns, tuple(mixed) if len(mixed) > 1 else ())


def with_monomial(inputs: DerivedInputs, powers: Sequence[float], replaced: int) -> DerivedInputs:
    """`inputs` with the logarithm of a monomial in the place of column `replaced`."""
    columns = list(inputs.columns)
    columns[replaced] = Column(tuple(float(p) for p in powers), logarithm=True)
    return DerivedInputs(inputs.names, tuple(columns), inputs.mixed)


def places_for(inputs: DerivedInputs, powers: Sequence[float]) -> list[int]:
    """Columns that a monomial can take the place of without anything being lost."""
    out = []
    logs = [k for k, c in enumerate(inputs.columns) if c.logarithm]
    for k in logs:
        rows = np.array([powers if j == k else inputs.columns[j].powers for j in logs])
        if np.linalg.matrix_rank(rows) == len(logs):
            out.append(k)
    return out


def candidates(
    names: Sequence[str], dimensions: Sequence[Dimension], parameters: NDArray[np.float64]
) -> list[tuple[float, ...]]:
    """Monomials worth trying: powers of each parameter, positive ones only, the simplest first.

    Damage numbers speed^2 / strength, also times a mass and over one or two lengths; and ratios of parameters of one kind.
    """
    good = [k for k in range(len(names)) if is_positive(parameters[:, k]) and dimensions[k] is not None]
    kinds = {kind: [k for k in good if dimensions[k] == kind] for kind in (SPEED, STRESS, LENGTH, MASS)}
    out: list[dict[int, float]] = []
    thin = [[], *([k] for k in kinds[LENGTH]), *itertools.combinations_with_replacement(kinds[LENGTH], 2)]
    for speed, stress in itertools.product(kinds[SPEED], kinds[STRESS]):
        for masses in ([], *([k] for k in kinds[MASS])):
            for lengths in thin:
                one: dict[int, float] = {speed: 2.0, stress: -1.0}
                for k in masses:
                    one[k] = one.get(k, 0.0) + 1
                for k in lengths:
                    one[k] = one.get(k, 0.0) - 1
                out.append(one)
    for a, b in itertools.combinations(good, 2):
        if dimensions[a] == dimensions[b]:
            out.append({a: 1.0, b: -1.0})
    unique = sorted({tuple(one.get(k, 0.0) for k in range(len(names))) for one in out}, key=_effort)
    return [powers for powers in unique if is_free(powers, dimensions)][:_MOST]


def is_free(powers: Sequence[float], dimensions: Sequence[Dimension]) -> bool:
    """Whether the monomial is dimensionless together with powers of a density (kg m-3) and a length (m)."""
    total = np.zeros(3)
    for power, dimension in zip(powers, dimensions, strict=True):
        if power and dimension is None:
            return False
        total += power * np.array(dimension or (0.0, 0.0, 0.0))
    # Mass goes with a density, length with a length; nothing constant carries time.
    return bool(abs(total[2]) < 1e-9)


def parse_monomial(text: str, names: Sequence[str]) -> tuple[float, ...]:
    """Powers of each parameter in a text such as "impact_speed**2/(yield_stress*thickness)"; nothing is evaluated.

    Raises
    ------
    SurrogateError
        Saying where it was not understood.
    """
    powers = _Monomial(text, names).read()
    if not powers.any():
        raise SurrogateError(f"inputs.derived: {text!r} is constant; expected such as impact_speed**2/yield_stress")
    return tuple(float(p) for p in powers)


class _Monomial:
    """Reads `term (*|/ term)..` with `term = (name | bracket) [**|^ number]`, from left to right."""

    def __init__(self, text: str, names: Sequence[str]) -> None:
        self.text, self.names = text, list(names)
        self.tokens = _TOKEN.findall(text)
        self.place = 0

    def read(self) -> NDArray[np.float64]:
        out = self._product()
        if self._next() is not None:
            self._refuse()
        return out

    def _product(self) -> NDArray[np.float64]:
        out = self._term()
        while self._next() in ("*", "/"):
            sign = 1 if self._take() == "*" else -1
            out = out + sign * self._term()
        return out

    def _term(self) -> NDArray[np.float64]:
        token = self._take()
        if token == "(":
            out = self._product()
            if self._next() is None:
                raise SurrogateError(f"inputs.derived: {self.text!r} lacks a closing bracket ')'")
            if self._take() != ")":
                self._refuse()
        elif token in self.names:
            out = np.array([float(name == token) for name in self.names])
        elif token is not None and re.fullmatch(r"[^\W\d]\w*", token):
            raise SurrogateError(
                f"inputs.derived: {self.text!r} names {token!r}, which is no parameter; there are {', '.join(self.names)}"
            )
        else:
            self._refuse()
        if self._next() in ("**", "^"):
            self._take()
            out = out * self._number()
        return out

    def _number(self) -> float:
        bracket = self._next() == "("
        if bracket:
            self._take()
        sign = 1.0
        while self._next() in ("+", "-"):
            sign *= -1.0 if self._take() == "-" else 1.0
        token = self._take()
        if token is None or not re.fullmatch(r"\d+\.?\d*|\.\d+", token) or (bracket and self._take() != ")"):
            self._refuse()
        return sign * float(token)

    def _next(self) -> str | None:
        return self.tokens[self.place] if self.place < len(self.tokens) else None

    def _take(self) -> str | None:
        token = self._next()
        self.place += 1
        return token

    def _refuse(self) -> NoReturn:
        left = " ".join(self.tokens[max(0, self.place - 1) :]) or "its end"
        raise SurrogateError(
            f"inputs.derived: {self.text!r} is not understood at {left!r}; expected names joined by * and /, each with a "
            "power, such as impact_speed**2/(yield_stress*thickness**2)"
        )


def monomial(powers: Sequence[float], names: Sequence[str]) -> str:
    """Such as "impact_speed^2 / (yield_stress box_thickness^2)"."""

    def side(sign: int) -> list[str]:
        return [
            n if abs(p) == 1 else f"{n}^{abs(p):g}"
            for p, n in sorted(zip(powers, names, strict=True), key=lambda pair: -abs(pair[0]))
            if p * sign > 0
        ]

    above, below = side(1), side(-1)
    if not below:
        return " ".join(above)
    under = below[0] if len(below) == 1 else f"({' '.join(below)})"
    return f"{' '.join(above) or '1'} / {under}"


def _unit_rows(count: int) -> list[tuple[float, ...]]:
    return [tuple(float(j == k) for j in range(count)) for k in range(count)]


def _effort(powers: tuple[float, ...]) -> tuple[float, tuple[float, ...]]:
    return math.fsum(abs(p) for p in powers), powers
