"""Runs that fill the box before anything is known: low-discrepancy sequences whose points reach the edges."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from surrogates.errors import SurrogateError

Sequence = Literal["halton", "sobol", "random"]
Allowed = Callable[[NDArray[np.float64]], NDArray[np.bool_]]

# Points drawn for each one wanted before a box is said to be empty.
_TRIES = 2000


def everywhere(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """The box without constraints."""
    return np.ones(len(points), bool)


def fill(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    count: int,
    *,
    seed: int = 0,
    sequence: Sequence = "halton",
    allowed: Allowed = everywhere,
    skip: int = 0,
    edges: bool = False,
) -> NDArray[np.float64]:
    """`count` points (point, parameter) of a scrambled sequence in the box that keep its constraints.

    Parameters
    ----------
    low, high
        (parameter,) bounds of the box.
    seed
        The same seed gives the same points.
    skip
        Points of the sequence that are left out first, so that later calls go on with it.
    edges
        Stretch each parameter, so that its smallest and largest value lie on the bounds. A surrogate interpolates
        well and extrapolates badly; this is for the first runs of a campaign.

    Raises
    ------
    SurrogateError
        If the constraints leave (almost) nothing of the box.

    Notes
    -----
    Halton sequence scrambled after Owen 2017 and Sobol sequence, from `scipy.stats.qmc`.
    """
    from scipy.stats import qmc

    p = len(low)
    engine = {
        "halton": lambda: qmc.Halton(p, scramble=True, seed=seed),
        "sobol": lambda: qmc.Sobol(p, scramble=True, seed=seed),
    }.get(sequence)
    draw = engine().random if engine is not None else np.random.default_rng(seed).random
    found: list[NDArray[np.float64]] = []
    have, drawn, wanted = 0, 0, count + skip
    while have < wanted:
        if drawn > _TRIES * wanted:
            raise SurrogateError(
                f"the constraints leave {have} of {drawn} points of the box; loosen them, or make the box smaller"
            )
        size = max(64, wanted)
        unit = draw(size) if engine is not None else draw((size, p))
        points = low + (high - low) * unit
        good = points[allowed(points)]
        found.append(good)
        have, drawn = have + len(good), drawn + size
    out = np.concatenate(found)[skip:wanted]
    return _stretched(out, low, high, allowed) if edges and count > 1 else out


def _stretched(
    points: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64], allowed: Allowed
) -> NDArray[np.float64]:
    """Each parameter stretched to its bounds, but for points that would then break a constraint."""
    first, last = points.min(axis=0), points.max(axis=0)
    out = low + (points - first) / np.where(last > first, last - first, 1) * (high - low)
    return np.where(allowed(out)[:, None], out, points)
