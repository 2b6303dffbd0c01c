"""What became of a training: runs, errors, choices, versions; kept in the model folder."""

from __future__ import annotations

import datetime
import math
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from surrogates.data.campaign import Campaign
from surrogates.data.inputs import Ranges
from surrogates.data.samples import ValidationSplit
from surrogates.settings import Settings

HISTORY = (
    "total", "approximation", "reconstruction",
    "validation_total", "validation_approximation", "validation_reconstruction",
)  # fmt: skip


@dataclass
class Fit:
    """How a training went. `best_epoch` counts from 1; `history` has one value an epoch: HISTORY and learning_rate."""

    history: dict[str, list[float]] = field(default_factory=dict)
    best_epoch: int = 0
    best: float = math.inf
    seconds: float = 0.0
    status: Literal["finished", "interrupted", "diverged"] = "finished"

    @property
    def epochs(self) -> int:
        return len(self.history.get("total", ()))

    @property
    def seconds_per_epoch(self) -> float:
        return self.seconds / self.epochs if self.epochs else math.nan


@dataclass
class Record:
    """Where a surrogate comes from and how its training went.

    ranges      names, units and ranges of the parameters, and of the time, over the runs it was fitted to
    time        (state,) s, the states it was trained on
    fits        how each level's training went
    errors      e2 (m) by what was measured, on validation runs or on the runs that folds left out, on the level's own
                nodes unless it says lifted; "reduction alone" is that of the reduction kept
    choice      what was chosen by cross-validation: inputs and modes of a POD regression, or by level, in words
    physics     inputs, clock and symmetry in words, and "errors": e2 (m) by what each was worth in cross-validation
    parameters  parameter -> its values in the runs it was fitted to, for marks on sliders
    left_out    run -> e2 (m) when it is left out of the training, of the finest level; and the deviation the process
                then believes in, up to a factor (1 for a cascade). Empty where validation runs judged
    members     seed -> e2 (m) of that training alone, by level, where the model is the mean of several
    coarse      coarse runs beneath the fine ones: dataset, checksum, runs, nodes, the way they are used, slopes by mode,
                and e2 (m) of each way in cross-validation; empty without any
    numbers     name -> formula, unit, and the errors of a number on runs that were left out
    notes       what was unusual about the data
    """

    ranges: Ranges
    time: NDArray[np.float64]
    checksum: str
    fitted_runs: tuple[str, ...]
    validation_runs: tuple[str, ...]
    held_out_runs: tuple[str, ...]
    seed: int
    created: str
    versions: dict[str, str]
    attributes: dict[str, str]
    fits: dict[int, Fit] = field(default_factory=dict)
    errors: dict[str, float] = field(default_factory=dict)
    choice: dict[str, Any] = field(default_factory=dict)
    physics: dict[str, Any] = field(default_factory=dict)
    parameters: dict[str, list[float]] = field(default_factory=dict)
    left_out: dict[str, tuple[float, float]] = field(default_factory=dict)
    members: dict[str, dict[str, float]] = field(default_factory=dict)
    numbers: dict[str, dict[str, Any]] = field(default_factory=dict)
    coarse: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def error_name(self) -> str:
        """What its errors are called: they come from folds, which judge every training run, or from validation runs."""
        return "validation error" if self.validation_runs else "error by folds"

    @property
    def runs_told(self) -> str:
        """How many runs there are of each kind."""
        held = f"{len(self.held_out_runs)} held out"
        if self.validation_runs:
            return f"{len(self.fitted_runs)} training, {len(self.validation_runs)} validation, {held}"
        return f"{len(self.fitted_runs)} training{' (judged by folds)' if self.left_out else ''}, {held}"

    @classmethod
    def of(cls, campaign: Campaign, settings: Settings, ranges: Ranges, split: ValidationSplit) -> Record:
        names = campaign.runs or tuple(str(k) for k in range(len(campaign.parameters)))
        return cls(
            ranges=ranges,
            time=np.asarray(campaign.time, np.float64),
            checksum=campaign.checksum,
            fitted_runs=tuple(names[k] for k in split.training),
            validation_runs=tuple(names[k] for k in split.validation),
            held_out_runs=campaign.held_out,
            seed=settings.seed,
            created=datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
            versions=_versions(),
            attributes=dict(campaign.attributes or {}),
            parameters={
                n: campaign.parameters[split.training, k].tolist() for k, n in enumerate(campaign.parameter_names)
            },
        )


def record_as_dict(record: Record) -> dict[str, Any]:
    """Plain values for JSON, without the histories."""
    out = asdict(record)
    out["ranges"] = ranges_as_dict(record.ranges)
    out["time"] = record.time.tolist()
    out["fits"] = {
        str(k): {"best_epoch": f.best_epoch, "best": f.best, "seconds": f.seconds, "status": f.status}
        for k, f in record.fits.items()
    }
    return out


def record_from_dict(values: Mapping[str, Any], histories: Mapping[int, dict[str, list[float]]]) -> Record:
    """The way back; raises KeyError or TypeError where something is missing."""
    return Record(
        ranges=ranges_from_dict(values["ranges"]),
        time=np.array(values["time"], np.float64),
        checksum=values["checksum"],
        fitted_runs=tuple(values["fitted_runs"]),
        validation_runs=tuple(values["validation_runs"]),
        held_out_runs=tuple(values["held_out_runs"]),
        seed=int(values["seed"]),
        created=values["created"],
        versions=dict(values["versions"]),
        attributes=dict(values["attributes"]),
        fits={
            int(k): Fit(histories.get(int(k), {}), f["best_epoch"], f["best"], f["seconds"], f["status"])
            for k, f in values["fits"].items()
        },
        errors=dict(values["errors"]),
        choice=dict(values["choice"]),
        physics=dict(values["physics"]),
        parameters={str(k): [float(x) for x in v] for k, v in values.get("parameters", {}).items()},
        left_out={str(k): (float(e), float(d)) for k, (e, d) in values.get("left_out", {}).items()},
        members={str(k): {str(n): float(e) for n, e in v.items()} for k, v in values.get("members", {}).items()},
        numbers={str(k): dict(v) for k, v in values.get("numbers", {}).items()},
        coarse=dict(values.get("coarse", {})),
        notes=list(values["notes"]),
    )  # fmt: skip


def ranges_as_dict(ranges: Ranges) -> dict[str, Any]:
    """Plain values."""
    return {
        "names": list(ranges.names), "units": list(ranges.units), "low": ranges.low.tolist(),
        "high": ranges.high.tolist(), "time": list(ranges.time), "table": [list(unit) for unit in ranges.written],
    }  # fmt: skip


def ranges_from_dict(values: Mapping[str, Any]) -> Ranges:
    """The way back."""
    return Ranges(
        tuple(values["names"]), tuple(values["units"]), np.array(values["low"], np.float64),
        np.array(values["high"], np.float64), (float(values["time"][0]), float(values["time"][1])),
        tuple((str(unit), float(factor)) for unit, factor in values.get("table", ())),
    )  # fmt: skip


def _versions() -> dict[str, str]:
    from importlib.metadata import PackageNotFoundError, version

    out = {"python": platform.python_version()}
    for name in ("crashkit", "torch", "numpy", "scipy", "scikit-learn", "safetensors"):
        try:
            out[name] = version(name)
        except PackageNotFoundError:
            out[name] = "unknown"
    return out
