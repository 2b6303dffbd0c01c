"""The box of the parameters: what a campaign may vary, between which bounds, under which constraints."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from crashkit.errors import CrashkitError
from crashkit.yaml_file import checked, read_yaml
from data_schema.mirror import ODD, comes_near_zero


class CampaignError(CrashkitError):
    """A campaign file, a template, a command or a run that does not fit; says what to do."""


class Range(BaseModel):
    """One parameter: from `low` to `high`, in `unit`.

    Attributes
    ----------
    odd
        The parameter changes its sign when the structure is mirrored (an impact angle, a lateral offset).
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    low: float
    high: float
    unit: str = "1"
    odd: bool = False

    @model_validator(mode="after")
    def _ordered(self) -> Range:
        if not (np.isfinite(self.low) and np.isfinite(self.high)) or not self.low < self.high:
            raise ValueError(
                f"low {self.low:g} and high {self.high:g} make no range; expected low < high (leave out what is not varied)"
            )
        if self.odd and not comes_near_zero(self.low, self.high):
            raise ValueError(f"{self.low:g} to {self.high:g} is marked odd; {ODD} leave odd out")
        return self


class Box(BaseModel):
    """Parameters by name, and constraints between them such as "box_thickness <= beam_thickness"."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    parameters: dict[str, Range] = Field(min_length=1)
    constraints: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _understood(self) -> Box:
        for name in self.parameters:
            if not name.isidentifier():
                raise ValueError(f"parameter {name!r} is no name; expected letters, digits and _, such as impact_speed")
        for text in self.constraints:
            _condition(text, tuple(self.parameters))
        return self

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.parameters)

    @property
    def low(self) -> NDArray[np.float64]:
        return np.array([r.low for r in self.parameters.values()])

    @property
    def high(self) -> NDArray[np.float64]:
        return np.array([r.high for r in self.parameters.values()])

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(r.unit for r in self.parameters.values())

    @property
    def odd(self) -> tuple[bool, ...]:
        return tuple(r.odd for r in self.parameters.values())

    def allowed(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which of `points` (point, parameter) keep all constraints."""
        conditions = [_condition(text, self.names) for text in self.constraints]
        return np.array(
            [
                all(condition(dict(zip(self.names, map(float, p), strict=True))) for condition in conditions)
                for p in points
            ],
            bool,
        )

    @classmethod
    def of_values(cls, names: Sequence[str], units: Sequence[str], values: NDArray[np.float64]) -> Box:
        """The box that the computed runs `values` (run, parameter) span; constant parameters are left out."""
        low, high = values.min(axis=0), values.max(axis=0)
        ranges = {
            n: Range(low=float(a), high=float(b), unit=u)
            for n, u, a, b in zip(names, units, low, high, strict=True)
            if a < b
        }
        if not ranges:
            raise CampaignError("no parameter differs between the runs; give the box with --box")
        # Without constraints, a name need not be one that they can speak of ("2nd_impact").
        return cls.model_construct(parameters=ranges, constraints=())


def _condition(text: str, names: tuple[str, ...]) -> Callable[[Mapping[str, float]], bool]:
    """A constraint as a function of the parameters by name; read by a template engine's sandbox, never executed."""
    from jinja2 import TemplateError, meta
    from jinja2.sandbox import SandboxedEnvironment

    environment = SandboxedEnvironment()
    try:
        unknown = meta.find_undeclared_variables(environment.parse("{{ " + text + " }}")) - set(names)
        compiled = environment.compile_expression(text, undefined_to_none=False)
    except TemplateError as error:
        raise ValueError(f"constraint {text!r} cannot be read ({error}); expected one such as 'a <= 2 * b'") from error
    if unknown:
        raise ValueError(f"constraint {text!r} names {sorted(unknown)[0]!r}; the box has {', '.join(names)}")
    return lambda values: bool(compiled(**values))


def read_box(path: str | Path) -> Box:
    """The box in a YAML file: `parameters: {impact_speed: {low: 5, high: 35, unit: m/s}}`, and `constraints`.

    Raises
    ------
    CrashkitError
        Where the file cannot be read or says something else.
    """
    found = read_yaml(
        path, "parameters with bounds, such as 'parameters: {impact_speed: {low: 5, high: 35, unit: m/s}}'"
    )
    return checked(Box, {k: v for k, v in found.items() if k in Box.model_fields}, path)
