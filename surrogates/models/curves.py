"""Time histories as functions of the parameters: functional PCA and a Gaussian process over whole curves.

A curve is one sample, as a run is for displacements. Its principal components under the time integral (functional
PCA: Ramsay and Silverman 2005, chapter 8) are predicted by a process with one kernel. Which inputs it reads, the parameters
or those that the registration of the displacements derives from them, whether curves are played on the registration's clock
first, and whether a mirrored run has the same curve (an energy) or its opposite (a lateral force), is chosen by folds over the
training runs for every channel by itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogates.data.campaign import CurveTarget
from surrogates.data.inputs import over_range
from surrogates.errors import SurrogateError
from surrogates.physics.registration import Registration
from surrogates.physics.trials import Folds
from surrogates.regression.gaussian import Gaussian
from surrogates.uncertainty import FEWEST_BY_FOLDS, Band, Beliefs, calibrate

Floats = NDArray[np.float64]

# Share of the curves' energy that components keep; runs with the whole curve that it takes.
_ENERGY, _FEWEST = 0.9995, 3
# Another way to read the parameters is chosen if it lowers the error by this share.
_MARGIN = 0.01
# Share of the usual size that is added to that of a run, as the root of squares: no band is without width.
_FLOOR = 0.05
# What a curve's band may follow.
_SPREADS = ("constant", "size", "deviation")


@dataclass
class Curve:
    """One channel of the histories.

    Attributes
    ----------
    name, unit, time
        Of the channel; (sample,) s.
    registered, clock
        Whether it reads the inputs of the registration, and is played on its clock.
    grid
        (sample of the grid,) s, where the components live.
    low, high
        (input,) ranges that scale the inputs.
    modes, values
        (mode, sample of the grid) components, and (run, mode) of the training runs; in the unit of the channel.
    band
        How far it may be off, None with too few runs.
    errors
        Root mean square error over left-out runs by what was tried, and `chosen`.
    held
        Place of a training run -> (sample,) as the others predict it; not stored.
    """

    name: str
    unit: str
    time: Floats
    registered: bool
    clock: bool
    grid: Floats
    low: Floats
    high: Floats
    modes: Floats
    values: Floats
    machine: Gaussian
    band: Band | None = None
    errors: dict[str, float] = field(default_factory=dict)
    held: dict[int, Floats] = field(default_factory=dict)

    def predict(self, registration: Registration, parameters: Floats) -> Floats:
        """(run, sample) for parameters (run, parameter)."""
        found = self.machine.weights(self._read(registration, parameters)) @ self.values @ self.modes
        if not self.clock:
            return np.asarray(found)
        return np.stack(
            [
                np.interp(registration.clock.times(p, self.time), self.grid, c)
                for p, c in zip(parameters, found, strict=True)
            ]
        )

    def _read(self, registration: Registration, parameters: Floats) -> Floats:
        """(run, input) of the process, scaled."""
        inputs = registration.read(parameters) if self.registered else parameters
        return over_range(inputs, np.stack([self.low, self.high]))

    def beliefs(self, registration: Registration, parameters: Floats) -> Beliefs:
        """What is said of runs before they are computed: how large their curves are, and the process's own deviation."""
        size = np.sqrt(np.square(self.predict(registration, parameters)).mean(axis=1))
        usual = float(np.sqrt(np.square(self.values @ self.modes).mean()))
        deviation = self.machine.deviation(self._read(registration, parameters))
        return Beliefs(np.hypot(size, _FLOOR * max(usual, 1e-30)), deviation)

    def half_width(
        self, coverage: float, registration: Registration | None = None, parameters: Floats | None = None
    ) -> Floats:
        """(sample,): the share `coverage` of samples of a new run lies as near; of a typical run.

        With `registration` and `parameters` (run, parameter): (run, sample), of these runs.

        Raises
        ------
        SurrogateError
            With too few runs.
        """
        if self.band is None:
            raise SurrogateError(f"there is no band for {self.name}: it takes {FEWEST_BY_FOLDS} training runs")
        typical = np.asarray(self.band.half_width(coverage, self.time)[:, 0], np.float64)
        if registration is None or parameters is None:
            return typical
        return np.asarray(self.band.of_runs(self.beliefs(registration, parameters))[:, None] * typical)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What has to be kept."""
        out: dict[str, NDArray[Any]] = {
            "time": self.time, "grid": self.grid, "low": self.low, "high": self.high, "modes": self.modes,
            "values": self.values, "x": self.machine.x, **self.machine.numbers(),
        }  # fmt: skip
        if self.band is not None:
            out |= {"band_node": self.band.node, "band_state": self.band.state, "band_factor": self.band.factor}
        return out

    def told(self) -> dict[str, Any]:
        """What is said of it beside the arrays."""
        return {
            "unit": self.unit, "registered": self.registered, "clock": self.clock, "errors": self.errors,
            "runs": 0 if self.band is None else self.band.runs,
            **({} if self.band is None else {"spread": self.band.spread, "spread_unit": self.band.unit}),
        }  # fmt: skip

    @classmethod
    def load(cls, name: str, told: Mapping[str, Any], a: Mapping[str, NDArray[Any]]) -> Curve:
        """From what `arrays` and `told` gave."""
        machine = Gaussian.load(a["x"], a)
        band = None
        if "band_node" in a:
            spread = told.get("spread", "constant")
            if spread not in _SPREADS:
                raise SurrogateError(f"the band of {name} follows {spread!r}; expected {', '.join(_SPREADS)}")
            band = Band(
                a["band_node"], a["band_state"], a["time"], a["band_factor"], int(told["runs"]), spread,
                float(told.get("spread_unit", 1.0)),
            )  # fmt: skip
        return cls(
            name, str(told["unit"]), a["time"], bool(told["registered"]), bool(told["clock"]), a["grid"], a["low"],
            a["high"], a["modes"], a["values"], machine, band, {str(k): float(v) for k, v in told["errors"].items()},
        )  # fmt: skip


@dataclass(frozen=True)
class _Way:
    """How parameters and curves are read: see `Curve`; mirror 1: a mirrored run has the same curve, -1: its opposite, 0: unknown."""

    registered: bool = False
    clock: bool = False
    mirror: int = 0

    @property
    def told(self) -> str:
        own = {(False, False): "parameters as they are", (True, False): "derived inputs"}
        out = own.get((self.registered, self.clock), "derived inputs and clock")
        return out + {0: "", 1: ", mirrored runs the same", -1: ", mirrored runs the opposite"}[self.mirror]


def fit_curve(
    target: CurveTarget,
    time: Floats,
    parameters: Floats,
    registration: Registration,
    folds: int,
    seed: int,
    names: tuple[str, ...] = (),
) -> Curve:
    """A channel fitted to training runs with `parameters` (run, parameter).

    Runs that lack a sample are left out. `names` of the parameters say which change their sign in a mirror.

    Raises
    ------
    SurrogateError
        Where too few runs have the channel.
    """
    whole = np.flatnonzero(np.isfinite(target.values).all(axis=1))
    if len(whole) < _FEWEST:
        raise SurrogateError(
            f"history:{target.name}: {len(whole)} of {len(target.values)} training runs have the whole channel; expected at "
            f"least {_FEWEST}"
        )
    curves, runs = target.values[whole].astype(np.float64), parameters[whole]
    ways = [_Way(), _Way(True)][: 1 if registration.inputs.is_identity else 2]
    if not registration.clock.is_identity:
        ways.append(_Way(True, True))
    parts = Folds.of(len(whole), folds, seed)
    errors: dict[str, float] = {}
    held: dict[_Way, dict[int, list[Floats]]] = {}
    doubted: dict[_Way, dict[int, Beliefs]] = {}
    mirrors = not registration.symmetry.is_identity

    def judge(way: _Way) -> None:
        said: dict[int, list[Floats]] = {}
        believed: dict[int, Beliefs] = {}
        for train, left in parts:
            if not len(left):
                continue
            fitted = _fitted(target, time, curves[train], runs[train], registration, way, seed, names)
            for run, curve in zip(left, fitted.predict(registration, runs[left]), strict=True):
                said.setdefault(int(run), []).append(curve)
            beliefs = fitted.beliefs(registration, runs[left])
            for place, run in enumerate(left):
                believed[int(run)] = Beliefs(beliefs.size[place : place + 1], beliefs.deviation[place : place + 1])
        wrong = [np.square(c - curves[run]).mean() for run, found in said.items() for c in found]
        errors[way.told] = float(np.sqrt(np.mean(wrong))) if wrong else float("nan")
        held[way], doubted[way] = said, believed

    best = ways[0]
    for way in ways:
        judge(way)
        best = way if errors[way.told] < (1 - _MARGIN) * errors[best.told] else best
    for way in [replace(best, mirror=1), replace(best, mirror=-1)] if mirrors else []:
        judge(way)
        best = way if errors[way.told] < (1 - _MARGIN) * errors[best.told] else best
    out = _fitted(target, time, curves, runs, registration, best, seed, names)
    out.errors = {**errors, "chosen": errors[best.told]}
    out.held = {int(whole[run]): np.mean(found, axis=0) for run, found in held[best].items()}
    if len(held[best]) >= FEWEST_BY_FOLDS:
        known = [doubted[best][run] for run in held[best]]
        beliefs = Beliefs(np.concatenate([b.size for b in known]), np.concatenate([b.deviation for b in known]))
        out.band = calibrate(_distances(held[best], curves), time, beliefs)
    return out


def _distances(held: Mapping[int, list[Floats]], curves: Floats) -> Iterator[NDArray[np.float32]]:
    for run, found in held.items():
        yield np.abs(np.mean(found, axis=0) - curves[run])[:, None].astype(np.float32)


def _fitted(
    target: CurveTarget,
    time: Floats,
    curves: Floats,
    runs: Floats,
    registration: Registration,
    way: _Way,
    seed: int,
    names: tuple[str, ...],
) -> Curve:
    registered, clock = way.registered, way.clock
    computed = len(runs)
    if way.mirror:
        runs = np.concatenate([runs, registration.symmetry.images(runs, names)])
        curves = np.concatenate([curves, way.mirror * curves])
    grid = registration.clock.grid(runs, time) if clock else time
    if clock:
        start, rates = registration.clock.start, registration.clock.rate(runs)
        curves = np.stack(
            [np.interp(start + (grid - start) / rate, time, c) for rate, c in zip(rates, curves, strict=True)]
        )
    inputs = registration.read(runs) if registered else runs
    if way.mirror and registered and registration.symmetry.flagged:
        inputs[computed:, -1] = 1.0
    modes, values = _components(curves, grid)
    x = over_range(inputs, inputs)
    machine = Gaussian(x).fit(values - values.mean(axis=0), seed)
    return Curve(
        target.name, target.unit, np.asarray(time, np.float64), registered, clock, np.asarray(grid, np.float64),
        inputs.min(axis=0), inputs.max(axis=0), modes, values, machine,
    )  # fmt: skip


def _components(curves: Floats, time: Floats) -> tuple[Floats, Floats]:
    """Components (mode, sample) and values (run, mode); the mean curve is one of them, so that weights that sum to one keep it."""
    weight = np.sqrt(np.gradient(time) if len(time) > 1 else np.ones(1))
    mean = curves.mean(axis=0)
    left, size, right = np.linalg.svd((curves - mean) * weight, full_matrices=False)
    energy = np.cumsum(size**2)
    keep = int(np.searchsorted(energy, _ENERGY * energy[-1])) + 1 if energy[-1] > 0 else 1
    modes = np.concatenate([mean[None], right[:keep] / weight])
    return modes, np.concatenate([np.ones((len(curves), 1)), left[:, :keep] * size[:keep]], axis=1)
