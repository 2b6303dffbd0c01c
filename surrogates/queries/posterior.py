"""The distribution of parameters that a misfit leaves over a box: by cells for few parameters, by a sampler for more."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from surrogates.errors import SurrogateError

# Up to this many parameters the box is cut into cells; the first cut has about as many.
CELLS_UP_TO = 3
_FIRST = 1000
# Cells with a smaller share of all are left as they are; so are those within which the prediction changes by less than
# so many deviations of its noise.
_SHARE, _EVEN = 1e-4, 0.4
_MOST, _ROUNDS = 60_000, 40
# Live points of the sampler, and independent samples that it stops at.
_LIVE, _EFFECTIVE = 500, 2000
# Two optima are one explanation unless the logarithm of the density falls by this between them.
_VALLEY = 2.0
# A parameter that keeps more of its range is hardly told.
_WIDE = 0.8


class Density(Protocol):
    """Log density of points (n, parameter), and averaged over boxes around them; see `surrogates.queries.misfit.Misfit`."""

    def __call__(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]: ...

    def explored(
        self, parameters: NDArray[np.float64], reach: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]: ...


@dataclass(frozen=True)
class Explanation:
    """A local optimum: parameters (parameter,), its log density, and the share of the posterior that belongs to it."""

    parameters: NDArray[np.float64]
    density: float
    share: float


@dataclass(frozen=True)
class ParameterPosterior:
    """Parameters as an even prior over the box and the density leave them.

    Attributes
    ----------
    samples
        (sample, parameter), all of one weight; those that are known have one value.
    density
        (sample,) log density.
    explanations
        The optima, the best first.
    low, high
        (parameter,) the box.
    """

    samples: NDArray[np.float64]
    density: NDArray[np.float64]
    explanations: tuple[Explanation, ...]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @property
    def best(self) -> NDArray[np.float64]:
        """(parameter,): where the density is largest."""
        return self.explanations[0].parameters

    def interval(self, share: float = 0.9) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(parameter,) bounds that hold the middle `share` of each parameter."""
        low, high = np.quantile(self.samples, [(1 - share) / 2, (1 + share) / 2], axis=0)
        return low, high

    def threshold(self, share: float = 0.9) -> float:
        """The log density above which the region of the highest density lies that holds `share`."""
        return float(np.quantile(self.density, 1 - share))

    def narrowing(self) -> NDArray[np.float64]:
        """(parameter,): width of the 90 % interval against that of an even distribution over the box; 0 for known ones."""
        low, high = self.interval()
        span = 0.9 * (self.high - self.low)
        return np.asarray(np.where(span > 0, (high - low) / np.where(span > 0, span, 1), 0.0))

    def at_edge(self, share: float = 0.01) -> NDArray[np.bool_]:
        """(parameter,): whether the best value lies at the edge of the box, within `share` of its width.

        Where nearly the whole box is left (see `hardly_told`), the best value says nothing.
        """
        span = self.high - self.low
        near = np.minimum(self.best - self.low, self.high - self.best) <= share * span
        return np.asarray(near & (span > 0) & ~self.hardly_told())

    def hardly_told(self) -> NDArray[np.bool_]:
        """(parameter,): whether its 90 % interval is nearly as wide as the box."""
        return np.asarray(self.narrowing() > _WIDE)


def posterior(
    density: Density,
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    *,
    samples: int = 4000,
    seed: int = 0,
    starts: int = 12,
) -> ParameterPosterior:
    """The posterior over the box from `low` to `high` (parameter,); parameters with low == high are known.

    Optima are sought from `starts` samples.

    Raises
    ------
    SurrogateError
        Where nothing is left to find.
    """
    free = high > low
    if not free.any():
        raise SurrogateError("all parameters are known; leave at least one to be found")
    count = int(free.sum())
    drawn = (
        _by_cells(density, low, high, samples, seed)
        if count <= CELLS_UP_TO
        else _by_sampler(density, low, high, samples, seed)
    )
    values = density(drawn)
    found = _explanations(density, drawn, values, low, high, starts)
    return ParameterPosterior(drawn, values, found, low, high)


def _by_cells(
    density: Density, low: NDArray[np.float64], high: NDArray[np.float64], samples: int, seed: int
) -> NDArray[np.float64]:
    """Samples (sample, parameter): the box is cut into cells, and those that matter are halved until they are even.

    A cell's share is the average of the density over it, within which the model is linear; it is halved along the
    parameters that change the prediction most, so that those of no effect are never cut.
    """
    free = high > low
    each = max(2, round(_FIRST ** (1 / free.sum())))
    axes = [(np.arange(each) + 0.5) / each * (b - a) + a if f else np.array([a]) for a, b, f in zip(low, high, free)]
    middle = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(low))
    reach = np.broadcast_to((high - low) / (2 * each), middle.shape).copy()
    logs, change = density.explored(middle, reach)
    asked = len(middle)
    for _ in range(_ROUNDS):
        share = _shares(logs, reach, free)
        uneven = (share > _SHARE) & (change.max(axis=1) > _EVEN)
        if not uneven.any() or asked > _MOST:
            break
        new_middle, new_reach = _halved(middle[uneven], reach[uneven], change[uneven])
        new_logs, new_change = density.explored(new_middle, new_reach)
        asked += len(new_middle)
        middle, reach = np.concatenate([middle[~uneven], new_middle]), np.concatenate([reach[~uneven], new_reach])
        logs, change = np.concatenate([logs[~uneven], new_logs]), np.concatenate([change[~uneven], new_change])
    random = np.random.default_rng(seed)
    share = _shares(logs, reach, free)
    # Low-variance draw: as many of each cell as its share says.
    places = np.searchsorted(np.cumsum(share), (np.arange(samples) + random.random()) / samples * (1 - 1e-12))
    places = np.minimum(places, len(share) - 1)
    return np.asarray(middle[places] + reach[places] * random.uniform(-1, 1, (samples, len(low))))


def _shares(logs: NDArray[np.float64], reach: NDArray[np.float64], free: NDArray[np.bool_]) -> NDArray[np.float64]:
    mass = logs + np.log(reach[:, free]).sum(axis=1)
    weight = np.exp(mass - mass.max())
    return np.asarray(weight / weight.sum())


def _halved(
    middle: NDArray[np.float64], reach: NDArray[np.float64], change: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Each cell cut in two along every parameter that changes the prediction at least half as much as the strongest."""
    for k in range(middle.shape[1]):
        cut = (change[:, k] > _EVEN) & (change[:, k] >= 0.5 * change.max(axis=1))
        half = reach[cut].copy()
        half[:, k] /= 2
        step = np.zeros_like(half)
        step[:, k] = half[:, k]
        middle = np.concatenate([middle[~cut], middle[cut] - step, middle[cut] + step])
        reach = np.concatenate([reach[~cut], half, half])
        change = np.concatenate([change[~cut], change[cut], change[cut]])
    return middle, reach


def _by_sampler(
    density: Density, low: NDArray[np.float64], high: NDArray[np.float64], samples: int, seed: int
) -> NDArray[np.float64]:
    """Samples (sample, parameter) by importance nested sampling (nautilus: Lange 2023, doi 10.1093/mnras/stad2441)."""
    from nautilus import Sampler

    free = high > low

    def placed(unit: NDArray[np.float64]) -> NDArray[np.float64]:
        out = np.repeat(low[None], len(unit), axis=0)
        out[:, free] += unit * (high - low)[free]
        return out

    sampler = Sampler(
        lambda unit: unit, lambda unit: density(placed(np.atleast_2d(unit))), n_dim=int(free.sum()), n_live=_LIVE, n_networks=0,
        vectorized=True, seed=seed,
    )  # fmt: skip
    sampler.run(n_eff=min(samples, _EFFECTIVE), discard_exploration=True, verbose=False)
    unit, logs, _ = sampler.posterior()
    weight = np.exp(logs - logs.max())
    random = np.random.default_rng(seed)
    return placed(unit[random.choice(len(unit), samples, p=weight / weight.sum())])


def _explanations(
    density: Density,
    samples: NDArray[np.float64],
    values: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    count: int,
) -> tuple[Explanation, ...]:
    """Optima that samples lead to and that a valley lies between; each with the share of the samples next to it."""
    from scipy.optimize import minimize

    free = high > low
    size = np.maximum(samples[:, free].std(axis=0), 1e-9 * (high - low)[free])
    scaled = samples[:, free] / size

    def whole(x: NDArray[np.float64]) -> NDArray[np.float64]:
        out = np.repeat(low[None], len(x), axis=0)
        out[:, free] = np.clip(x * size, low[free], high[free])
        return out

    def downhill(x: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        step = 1e-3
        towards = np.where(x * size + step * size > high[free], -step, step)
        found = density(whole(np.concatenate([x[None], x + np.diag(towards)])))
        return -float(found[0]), -(found[1:] - found[0]) / towards

    starts = [int(values.argmax())]
    good = np.flatnonzero(values >= np.quantile(values, 0.5))
    for _ in range(count - 1):  # each as far as can be from those before
        gap = np.linalg.norm(scaled[good, None] - scaled[starts][None], axis=2).min(axis=1)
        starts.append(int(good[gap.argmax()]))
    bounds = list(zip(low[free] / size, high[free] / size, strict=True))
    optima: list[tuple[float, NDArray[np.float64]]] = []
    for start in starts:
        x = np.clip(scaled[start], [b[0] for b in bounds], [b[1] for b in bounds])
        found = minimize(downhill, x, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 60})
        optima.append((-float(found.fun), found.x))
    optima.sort(key=lambda pair: -pair[0])
    kept: list[tuple[float, NDArray[np.float64]]] = []
    for value, x in optima:
        if all(_valley(density, whole, x, other, value) for _, other in kept):
            kept.append((value, x))
    nearest = np.linalg.norm(scaled[:, None] - np.array([x for _, x in kept])[None], axis=2).argmin(axis=1)
    shares = np.bincount(nearest, minlength=len(kept)) / len(samples)
    return tuple(
        Explanation(whole(x[None])[0], value, float(share)) for (value, x), share in zip(kept, shares, strict=True)
    )


def _valley(density, whole, a, b, lower: float) -> bool:  # type: ignore[no-untyped-def]
    """Whether the density falls between two optima, of which `lower` is that of the smaller one."""
    way = np.linspace(0, 1, 17)[1:-1, None]
    return bool(density(whole(a * (1 - way) + b * way)).min() < lower - _VALLEY)
