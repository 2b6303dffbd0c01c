"""The campaign file: one YAML that says what varies, how one run is computed, and which error to reach."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from crashkit.campaign.box import Box, CampaignError
from crashkit.quality import LIMITS
from crashkit.yaml_file import checked, read_yaml


def _split(value: Any) -> Any:
    """A command may be written as one text; it is split as a shell splits words, and no shell ever sees it."""
    return (
        shlex.split(value) if isinstance(value, str) else [str(v) for v in value] if isinstance(value, list) else value
    )


def _seconds(value: Any) -> Any:
    """Seconds, also from "90 s", "10 min", "2 h"."""
    if not isinstance(value, str):
        return value
    number, _, unit = value.strip().partition(" ")
    factors = {"": 1, "s": 1, "min": 60, "h": 3600, "d": 86400}
    try:
        return float(number) * factors[unit.strip()]
    except (ValueError, KeyError):
        raise ValueError("expected a duration such as 90 s, 10 min, 2 h or 1 d") from None


Command = Annotated[list[str], BeforeValidator(_split), Field(min_length=1)]
Duration = Annotated[float, BeforeValidator(_seconds), Field(gt=0)]


Method = Literal["expected-reduction", "halton", "sobol", "random"]


def sequence(method: Method) -> Literal["halton", "sobol", "random"]:
    """The sequence that fills the box where no model is asked."""
    return "halton" if method == "expected-reduction" else method


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Finished(_Strict):
    """How a run that ended well is known: `text` near the end of one of the files `file` (a pattern in its folder)."""

    file: str
    text: str


class QualityLimits(_Strict):
    """Limits of a run, in per cent; a run beyond one of them is refused. None: no limit."""

    energy_error: float | None = Field(LIMITS["energy_error"], gt=0)
    hourglass_share: float | None = Field(LIMITS["hourglass_share"], gt=0)
    mass_added: float | None = Field(LIMITS["mass_added"], gt=0)


class Design(_Strict):
    """start: space-filling runs first; batch: runs that are proposed at a time; seed: of everything random."""

    start: int = Field(16, ge=2)
    batch: int = Field(8, ge=1)
    seed: int = Field(0, ge=0)
    method: Method = "expected-reduction"


class Ingest(_Strict):
    """Options of `crashkit ingest` for the runs."""

    units: str | None = None
    reader: str | None = None
    parts: tuple[str, ...] = ()
    exclude_parts: tuple[str, ...] = ()
    fields: tuple[str, ...] = ()
    time: tuple[float, ...] | None = None


class Plan(Box):
    """A campaign.

    parameters, constraints  the box

    Attributes
    ----------
    template
        Deck files (patterns) into which `{{impact_speed}}` is written, with arithmetic: {{ "%10.4f" | format(t /
        1000) }}.
    files
        Further files (patterns) that every run needs beside the deck.
    prepare
        A command of the user's that writes the deck; {impact_speed} is a value, {study} this file's folder.
    command
        The command that computes one run, in the run's folder.
    results
        What ingest is given of a run's folder (a pattern); default: the folder.
    finished
        How a run that ended well is known; default: what OpenRadioss and LS-DYNA write.
    at_a_time
        Runs computed at the same time; timeout: of one run, s or "10 min".
    nodes
        Sizes of the mesh hierarchy, where the model wants one.
    model
        What is trained (pod-gpr, mh, ...), with `settings`.
    until, confidence, most_runs, most_hours, least_gain
        When the loop ends; hours count from the start of the command.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    template: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    prepare: Command | None = None
    command: Command
    results: str = ""
    finished: Finished | None = None
    quality: QualityLimits = QualityLimits.model_validate({})
    at_a_time: int = Field(1, ge=1)
    timeout: Duration = 24 * 3600.0
    retries: int = Field(0, ge=0)
    design: Design = Design(start=16, batch=8, seed=0)
    ingest: Ingest = Ingest()
    nodes: tuple[int, ...] = ()
    model: str = "pod-gpr"
    settings: dict[str, Any] = Field(default_factory=dict)
    until: str | None = None
    confidence: float = Field(0.9, gt=0.5, lt=1)
    most_runs: int = Field(200, ge=1)
    most_hours: float | None = Field(None, gt=0)
    least_gain: float = Field(0.01, ge=0, lt=1)
    executor: Literal["local", "slurm"] = "local"
    slurm: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _whole(self) -> Plan:
        if not self.template and self.prepare is None:
            raise ValueError("neither template nor prepare is given; one of them must write the deck of a run")
        reserved = {"study", "run", "name"} & set(self.parameters)
        if reserved:
            raise ValueError(f"a parameter cannot be called {reserved.pop()!r}; that name means a folder in commands")
        return self

    def target(self) -> float | None:
        """The error to reach, m; None where the campaign has none."""
        return None if self.until is None else length_of(self.until)


def length_of(text: str) -> float:
    """A length with its unit, such as "8 mm", in m. Raises CampaignError."""
    from data_schema.units import UnknownUnits, length

    try:
        return length(text)
    except UnknownUnits as error:
        raise CampaignError(f"until: {error}") from error


def read_plan(path: str | Path) -> Plan:
    """The campaign file at `path`.

    Raises
    ------
    CrashkitError
        Where the file cannot be read or something in it does not fit, naming the place.
    """
    plan = checked(Plan, read_yaml(path, "a campaign, such as examples/campaign/frame.yaml"), path)
    plan.target()
    return plan
