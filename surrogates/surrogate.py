"""A fitted surrogate: one object whatever is inside, asked for displacements at any of its levels."""

from __future__ import annotations

import datetime
import platform
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from torch import Tensor

from surrogates.data.campaign import Campaign
from surrogates.data.graphs import Graphs
from surrogates.data.inputs import Ranges
from surrogates.data.samples import Split
from surrogates.errors import SurrogateError
from surrogates.models.base import Network
from surrogates.models.pod_regression import PodRegression
from surrogates.settings import Settings
from surrogates.training.loop import Fit
from surrogates.uncertainty import Band

# Samples predicted at once.
_CHUNK = 512
_NAMES = {"podnn": "PODNN", "aenn": "AENN", "gaenn": "GAENN", "pod-gpr": "POD-GPR", "pod-rbf": "POD-RBF"}


def level_name(settings: Settings, number: int) -> str:
    """What tables call the level: MH1, MH2, .. or the baseline's name."""
    return _NAMES.get(settings.model, f"MH{number}")


@dataclass
class Record:
    """Where a surrogate comes from and how its training went.

    ranges      names, units and ranges of the parameters, and of the time, over the runs it was fitted to
    time        (state,) s, the states it was trained on
    fits        how each level's training went
    errors      e2 (m) by what was measured, on validation runs, on the level's own nodes
    choice      what a POD regression chose on the validation runs: inputs and modes
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
    notes: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, campaign: Campaign, settings: Settings, ranges: Ranges, split: Split) -> Record:
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
        )


class Surrogate:
    """A fitted surrogate.

    settings, record  what it was asked to be, and what became of it
    graphs            the levels it knows; with them predictions are lifted to the full mesh without the data
    points, faces     the full mesh (node, 3), m, and (face, corner), where the training data told them
    """

    def __init__(
        self,
        settings: Settings,
        record: Record,
        graphs: Graphs,
        core: Network | PodRegression,
        points: NDArray[np.float64] | None = None,
        faces: NDArray[np.int32] | None = None,
    ) -> None:
        self.settings, self.record, self.graphs, self.core = settings, record, graphs, core
        self.points, self.faces = points, faces
        self.bands: dict[tuple[int, bool], Band] = {}
        self._upward: dict[int, sparse.csr_matrix] = {}

    @property
    def level_names(self) -> dict[str, int]:
        """Name of each level it answers on -> mesh level, coarsest first, such as {"MH3": 3, "MH2": 2, "MH1": 1}."""
        return {level_name(self.settings, k): k for k in self.core.numbers}

    def predict(
        self, parameters: ArrayLike, time: ArrayLike | None = None, level: int | None = None
    ) -> NDArray[np.float32]:
        """Displacements, m, on the nodes of `level` (default: the finest one it has).

        parameters  (p,) -> (state, node, 3), or (batch, p) -> (batch, state, node, 3), in the units it was trained with
        time        (state,) s, any times; default: those it was trained on

        Raises SurrogateError for a level it does not have, or parameters of the wrong number or not finite.
        """
        number = self.number(level)
        values, times = self.checked(parameters, time)
        if isinstance(self.core, PodRegression):
            out = self.core.displacement(values, times, number)
        else:
            out = self._by_network(values, times, number)
        return out[0] if np.ndim(parameters) == 1 else out

    def predict_full(
        self, parameters: ArrayLike, time: ArrayLike | None = None, level: int | None = None
    ) -> NDArray[np.float32]:
        """`predict` lifted to the full mesh by the level's static U."""
        number = self.number(level)
        values, times = self.checked(parameters, time)
        if number == 0 or isinstance(self.core, PodRegression):
            return self.lift(self.predict(parameters, times, number), number)
        out = self._by_network(values, times, number, lambda states: self._lifted(states, number))
        return out[0] if np.ndim(parameters) == 1 else out

    def lift(self, states: NDArray[np.float32], level: int) -> NDArray[np.float32]:
        """(..., node of `level`, 3) -> (..., node of the full mesh, 3)"""
        if level == 0:
            return states
        flat = torch.from_numpy(np.asarray(states, np.float32).reshape(-1, *states.shape[-2:]))
        return self._lifted(flat.transpose(0, 1), level).numpy().reshape(*states.shape[:-2], -1, 3)

    def _lifted(self, states: Tensor, level: int) -> Tensor:
        """(node of `level`, b, 3) -> (b, node of the full mesh, 3), a view: transposing it costs more than lifting."""
        by_channel = states.transpose(1, 2)  # predictions lie in memory this way
        if level not in self._upward:
            self._upward[level] = self.graphs.to_full(level).astype(np.float32)
        rows = self._upward[level] @ by_channel.flatten(1).numpy()
        return torch.from_numpy(rows).view(-1, *by_channel.shape[1:]).permute(2, 0, 1)

    def reconstruct(self, states: ArrayLike, level: int | None = None) -> NDArray[np.float32]:
        """Encode and decode displacements (state, node of `level`, 3), m: what the reduction alone costs."""
        number = self.number(level)
        x = np.asarray(states, np.float32)
        nodes = self.graphs.n_nodes(number)
        if x.ndim != 3 or x.shape[1:] != (nodes, 3):
            raise SurrogateError(f"states have the shape {x.shape}; expected (state, {nodes} nodes, 3)")
        if isinstance(self.core, PodRegression):
            return self.core.reconstruct(x, number)
        core = self.core
        with torch.no_grad():
            parts = [core.reconstruct(part.transpose(0, 1), number) for part in torch.from_numpy(x).split(_CHUNK)]
        return torch.cat([part.transpose(0, 1) for part in parts]).contiguous().numpy()

    def has_band(self, level: int | None = None) -> bool:
        """Whether enough validation runs were held out for `band` on the full mesh."""
        number = self.number(level)
        return (number, number > 0) in self.bands

    def band(
        self, coverage: float = 0.9, time: ArrayLike | None = None, level: int | None = None, *, full: bool = False
    ) -> NDArray[np.float32]:
        """How far, m, the true node may lie from the predicted one: (state, node of `level` or of the full mesh).

        The share `coverage` of nodes and states of a new run lies within it, as far as the validation runs tell; see
        `surrogates.uncertainty`. Raises SurrogateError where no validation runs were held out.
        """
        number = self.number(level)
        found = self.bands.get((number, full and number > 0))
        if found is None:
            raise SurrogateError(
                f"there is no band for {level_name(self.settings, number)}: too few validation runs were held out; see the model card"
            )
        return found.half_width(
            coverage, self.record.time if time is None else np.atleast_1d(np.asarray(time, np.float64))
        )

    def sensitivity(
        self,
        parameters: ArrayLike,
        time: ArrayLike | None = None,
        level: int | None = None,
        nodes: ArrayLike | None = None,
    ) -> NDArray[np.float32]:
        """Derivatives by the parameters (state, node, 3, parameter); see `surrogates.uncertainty.sensitivity`."""
        from surrogates.uncertainty import sensitivity

        return sensitivity(self, parameters, time, level, nodes)

    def outside(self, parameters: ArrayLike, time: ArrayLike | None = None) -> list[str]:
        """One sentence for each parameter, and the time, beyond the trained range; empty inside."""
        return self.record.ranges.outside(*self.checked(parameters, time))

    def n_parameters(self, level: int | None = None) -> int:
        """Numbers behind a prediction on `level`, those of the coarser levels it rests on included."""
        return self.core.n_parameters(self.number(level))

    def n_latent(self, level: int | None = None) -> int:
        """Length of the latent vector."""
        return self.core.latent(self.number(level))

    def history(self, level: int | None = None) -> Mapping[str, NDArray[np.float64]]:
        """Losses by epoch: "total", "approximation", "reconstruction", the same with "validation_", "learning_rate"."""
        kept = self.record.fits.get(self.number(level))
        return {} if kept is None else {k: np.asarray(v, np.float64) for k, v in kept.history.items() if v}

    def fit(self, level: int | None = None) -> Fit | None:
        """The training behind `level`: its own, or that of all levels where they were trained together."""
        number = self.number(level)
        return self.record.fits.get(min(self.core.numbers) if self.settings.unified else number)

    def seconds_per_epoch(self, level: int | None = None) -> float:
        """As measured in training; NaN for models without epochs."""
        kept = self.fit(level)
        return float("nan") if kept is None else kept.seconds_per_epoch

    def training_seconds(self, level: int | None = None) -> float:
        """Of `level` and the coarser ones it rests on, or of all levels where they were trained together."""
        number = self.number(level)
        return sum(kept.seconds for k, kept in self.record.fits.items() if k >= number or self.settings.unified)

    def _by_network(
        self,
        parameters: NDArray[np.float64],
        time: NDArray[np.float64],
        number: int,
        end: Callable[[Tensor], Tensor] = lambda states: states.transpose(0, 1).contiguous(),
    ) -> NDArray[np.float32]:
        """(batch, state, node, 3); `end` makes (b, node, 3) of states (node, b, 3)."""
        core = self.core
        at = torch.from_numpy(np.repeat(parameters, len(time), axis=0))
        when = torch.from_numpy(np.tile(time, len(parameters)))
        with torch.no_grad():
            parts = [
                end(core(a, t, number))  # type: ignore[operator]
                for a, t in zip(at.split(_CHUNK), when.split(_CHUNK), strict=True)
            ]
        out = (parts[0] if len(parts) == 1 else torch.cat(parts)).numpy()
        return out.reshape(len(parameters), len(time), *out.shape[1:])

    def number(self, level: int | None = None) -> int:
        """The mesh level meant by `level`, the finest for None; raises SurrogateError for one it does not have."""
        if not self.core.numbers:
            raise SurrogateError("the surrogate has no trained level")
        if level is None:
            return min(self.core.numbers)
        if level not in self.core.numbers:
            has = ", ".join(f"{n} ({k})" for n, k in self.level_names.items())
            raise SurrogateError(f"level {level} was asked for; this surrogate predicts on {has}")
        return level

    def checked(self, parameters: ArrayLike, time: ArrayLike | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Parameters as (batch, p) and times (state,); raises SurrogateError unless some, finite and of the right number."""
        values = np.atleast_2d(np.asarray(parameters, np.float64))
        names = self.record.ranges.names
        if values.ndim != 2 or values.shape[1] != len(names):
            raise SurrogateError(
                f"parameters have the shape {np.shape(parameters)}; expected ({len(names)},) or (batch, {len(names)}): {', '.join(names)}"
            )
        times = self.record.time if time is None else np.atleast_1d(np.asarray(time, np.float64))
        if not len(values) or not len(times):
            raise SurrogateError(
                f"{len(values)} sets of parameters and {len(times)} times were asked for; expected at least one of each"
            )
        if not np.isfinite(values).all() or not np.isfinite(times).all():
            raise SurrogateError("parameters and times must be finite numbers; found NaN or infinity")
        return values, times


def record_as_dict(record: Record) -> dict[str, Any]:
    """Plain values for JSON, without the histories."""
    ranges = record.ranges
    out = asdict(record)
    out["ranges"] = {
        "names": list(ranges.names), "units": list(ranges.units), "low": ranges.low.tolist(),
        "high": ranges.high.tolist(), "time": list(ranges.time),
    }  # fmt: skip
    out["time"] = record.time.tolist()
    out["fits"] = {
        str(k): {"best_epoch": f.best_epoch, "best": f.best, "seconds": f.seconds, "status": f.status}
        for k, f in record.fits.items()
    }
    return out


def record_from_dict(values: Mapping[str, Any], histories: Mapping[int, dict[str, list[float]]]) -> Record:
    """The way back; raises KeyError or TypeError where something is missing."""
    ranges = values["ranges"]
    return Record(
        ranges=Ranges(
            tuple(ranges["names"]), tuple(ranges["units"]), np.array(ranges["low"], np.float64),
            np.array(ranges["high"], np.float64), (float(ranges["time"][0]), float(ranges["time"][1])),
        ),
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
        notes=list(values["notes"]),
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
