"""A surrogate as plain values and arrays from which a web page can compute its predictions.

Nothing is executed on the way: a process is its kernel's numbers and what stands by them, a network is a list of steps on
named vectors (`linear`, `activation`, `chebyshev`, ...). `evaluation/explorer/model.js` reads both.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogates.errors import SurrogateError
from surrogates.local_errors import HARD, REACH, LocalErrors
from surrogates.models.average import Average, some_states
from surrogates.models.base import Network
from surrogates.models.cascade import Cascade
from surrogates.models.pod_regression import PodRegression
from surrogates.regression.gaussian import Gaussian
from surrogates.storage.steps import SHARE, cascade_steps, side_by_side
from surrogates.surrogate import Surrogate


@dataclass(frozen=True)
class Browsable:
    """What the page needs of one model.

    Attributes
    ----------
    about
        Plain values; names in it mean arrays.
    arrays
        Numbers by name.
    steps
        For arrays (row, column) that may be rounded: to multiples of what, for each column or for a group of columns
        that comes again and again.
    """

    about: dict[str, Any]
    arrays: dict[str, NDArray[Any]]
    steps: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)


def browsable(surrogate: Surrogate, name: str, prefix: str, share: float = 0.9) -> Browsable:
    """The model `surrogate`, called `name`, with arrays whose names begin with `prefix`.

    Raises
    ------
    SurrogateError
        For a kind of model that has no form for a browser; says which have.
    """
    core = surrogate.core
    arrays: dict[str, NDArray[Any]] = {}
    steps: dict[str, NDArray[np.float64]] = {}
    about: dict[str, Any] = {
        "name": name, "time": surrogate.record.time.tolist(), "registration": _registration(surrogate),
        "levels": _levels(surrogate, arrays, prefix), "bands": _bands(surrogate, arrays, prefix, share), "hard": _hard(surrogate),
    }  # fmt: skip
    if isinstance(core, PodRegression):
        about |= _process(core, arrays, steps, prefix)
    elif isinstance(core, Cascade):
        about |= cascade_steps([core], about["levels"], arrays, prefix, steps, _known(surrogate, core))
    elif isinstance(core, Average) and all(isinstance(member, Cascade) for member in core.networks):
        known = _known(surrogate, core)
        about |= cascade_steps(core.networks, about["levels"], arrays, prefix, steps, known)  # type: ignore[arg-type]
        places = some_states(len(surrogate.record.time))
        about["apart"] = {
            "level": max(core.numbers), "floor": core.floor, "time": surrogate.record.time[places].tolist(),
        }  # fmt: skip
    else:
        raise SurrogateError(
            f"{name}: unified levels have no form for a browser; use mh, podnn, aenn, gaenn or pod-gpr"
        )
    return Browsable(about, arrays, steps)


def _known(surrogate: Surrogate, network: Network) -> Tensor | None:
    """(sample, input): what the regressions read for training runs at some states; None where those are not kept."""
    record, registration = surrogate.record, surrogate.registration
    if any(name not in record.parameters for name in record.ranges.names):
        return None
    runs = registration.read(np.array([record.parameters[name] for name in record.ranges.names], np.float64).T)
    grid = record.time if registration.is_identity else registration.grid
    time = grid[some_states(len(grid))]
    at = torch.from_numpy(np.repeat(runs, len(time), axis=0)), torch.from_numpy(np.tile(time, len(runs)))
    with torch.no_grad():
        known: Tensor = network.inputs(*at)
    return known


def _process(
    core: PodRegression, arrays: dict[str, NDArray[Any]], steps: dict[str, NDArray[np.float64]], prefix: str
) -> dict[str, Any]:
    if not isinstance(core.machine, Gaussian) or core.inputs != "trajectory":
        raise SurrogateError("only Gaussian processes over whole runs have a form for a browser; train pod-gpr or mh")
    known = core.data.values.reshape(len(core.data.values), -1).astype(np.float64)
    mean, pull = core.machine.expanded(known)
    inverse = core.machine.inverse()
    named = {
        "x": core.machine.x, "mix": core.machine.kernel.mix, "mean": mean, "pull": pull, "modes": core.modes,
        "grid": core.data.time, "low": core.low, "high": core.high, "inverse": inverse,
    }  # fmt: skip
    for key, values in named.items():
        arrays[prefix + key] = np.asarray(values, np.float32 if key == "modes" else np.float64)
    base = core.base
    coefficients = np.abs(core.courses).max(axis=(0, 1)).astype(np.float64)
    largest = np.abs(core.modes).max(axis=0)
    allowed = SHARE * float((coefficients * largest).max())
    steps[f"{prefix}modes"] = allowed / np.maximum(coefficients, 1e-30)

    def rounded(machine: Gaussian) -> NDArray[np.float64]:
        """To what its pull may be rounded."""
        weights = np.linalg.norm(machine.kernel(machine.x, machine.x), axis=1).max()
        return np.asarray(allowed / np.maximum(largest * weights, 1e-30))

    steps[f"{prefix}pull"] = rounded(core.machine)
    added = []
    of_base = [] if base is None else [*([base.beside] if base.beside else []), (base.process, base.values)]
    for number, (machine, values) in enumerate(of_base):
        mean, pull = machine.expanded(values.reshape(len(values), -1).astype(np.float64))
        parts = {"x": machine.x, "mix": machine.kernel.mix, "mean": mean, "pull": pull}
        names = {key: f"{prefix}added_{number}_{key}" for key in parts}
        arrays.update({names[key]: np.asarray(part, np.float64) for key, part in parts.items()})
        steps[names["pull"]] = rounded(machine)
        added.append({"arrays": names, "kernel": _numbers(machine), "samples": len(machine.x)})
    return {
        "kind": "process", "arrays": {key: prefix + key for key in named},
        "kernel": _numbers(core.machine), "added": added,
        "modes": core.modes.shape[1], "samples": len(core.machine.x), "kept": (core.high > core.low).tolist(),
    }  # fmt: skip


def _numbers(machine: Gaussian) -> dict[str, float]:
    kernel = machine.kernel
    return {"variance": float(kernel.variance), "slope": float(kernel.slope), "noise": float(kernel.noise)}


def _registration(surrogate: Surrogate) -> dict[str, Any]:
    told: Mapping[str, Any] = surrogate.registration.as_dict()
    clock = told["clock"]
    return {
        "columns": told["inputs"]["columns"], "flagged": told["symmetry"]["flagged"], "speed": clock["speed"],
        "exponents": clock["exponents"], "reference": clock["reference"], "start": clock["start"],
    }  # fmt: skip


def _levels(surrogate: Surrogate, arrays: dict[str, NDArray[Any]], prefix: str) -> list[dict[str, Any]]:
    """The model's levels, the finest first, and the maps from coarse ones to the full mesh."""
    out: list[dict[str, Any]] = []
    for name, number in sorted(surrogate.level_names.items(), key=lambda item: item[1]):
        level: dict[str, Any] = {"number": number, "name": name, "nodes": surrogate.graphs.n_nodes(number)}
        if number:
            columns, weights = side_by_side(surrogate.graphs.to_full(number))
            level["lift"] = {"columns": f"{prefix}lift_{number}_columns", "weights": f"{prefix}lift_{number}_weights"}
            arrays[level["lift"]["columns"]], arrays[level["lift"]["weights"]] = columns, weights
        out.append(level)
    return out


def _bands(surrogate: Surrogate, arrays: dict[str, NDArray[Any]], prefix: str, share: float) -> dict[str, Any]:
    """Of each level, the band on the full mesh: a half-width per node and state of the trained times."""
    out: dict[str, Any] = {}
    for number in surrogate.level_names.values():
        if not surrogate.has_band(number):
            continue
        width = surrogate.band(share, surrogate.record.time, number, full=True)
        largest = width.max(axis=0)
        place = int(largest.argmax())
        names = {key: f"{prefix}band_{number}_{key}" for key in ("node", "state", "time")}
        arrays[names["node"]] = largest.astype(np.float32)
        arrays[names["state"]] = (width[:, place] / max(float(largest[place]), 1e-12)).astype(np.float64)
        arrays[names["time"]] = surrogate.record.time.astype(np.float64)
        band = surrogate.bands[number, number > 0]
        out[str(number)] = {
            **names, "spread": band.spread, "unit": band.unit,
            "local": None if band.local is None else _local(band.local),
        }  # fmt: skip
    return out


def _local(local: LocalErrors) -> dict[str, Any]:
    return {
        "points": local.points.tolist(), "ratio": local.ratio.tolist(), "width": local.width, "prior": local.prior,
    }  # fmt: skip


def _hard(surrogate: Surrogate) -> dict[str, Any] | None:
    """Where runs were predicted badly when left out: as `Surrogate.hard` says it."""
    local = surrogate.local_errors()
    if local is None:
        return None
    return {
        **_local(local), "run": local.run.tolist(), "limit": HARD, "reach": REACH,
        "runs": [[name, error] for name, (error, _) in surrogate.record.left_out.items()],
    }  # fmt: skip
