"""Which point to compute next, given what a process believes: small objects with `ask` and `tell`.

A process with one kernel for all outputs knows how sure it will be anywhere without knowing what it will see: its posterior
variance depends on the places of the runs alone. The run that lowers the deviation averaged over the box most is asked
for first, then counted as computed, and so on, so that a batch does not cluster.

Sources: Cohn, Ghahramani, Jordan 1996, "Active learning with statistical models", section 4 (expected reduction of
the variance integrated over the box; here of its root, since that is what an error is proportional to); Gramacy and
Apley 2015, equation 5 (the greedy step).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Kernel = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
Inputs = Callable[[NDArray[np.float64]], list[NDArray[np.float64]]]


class Criterion(Protocol):
    """`ask` gives the next points (point, parameter) out of `candidates`; `tell` says that points were computed."""

    def ask(self, candidates: NDArray[np.float64], count: int) -> NDArray[np.float64]: ...

    def tell(self, points: NDArray[np.float64]) -> None: ...


@dataclass
class Posterior:
    """What a process believes, up to the scale of its outputs.

    Parameters
    ----------
    kernel
        (a, d) and (b, d) inputs -> (a, b) covariance, without noise, in units of the outputs' spread.
    noise
        Variance of a computed run around the process.
    inputs
        (point, parameter) -> inputs of the points themselves and of each mirror image, a list of (point, d).
    known
        (run, parameter): the runs that are computed.
    """

    kernel: Kernel
    noise: float
    inputs: Inputs
    known: NDArray[np.float64]

    def variance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(point,): posterior variance of the field at (point, parameter), in units of the outputs' spread."""
        x = self.inputs(points)[0]
        seen, solve = self._seen()
        k = self.kernel(x, seen)
        own = _diagonal(self.kernel, x)
        return np.asarray(np.maximum(own - (k * solve(k.T).T).sum(axis=1), 0.0))

    def reductions(
        self, candidates: NDArray[np.float64], over: NDArray[np.float64], weights: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(candidate,): how much a run at each candidate, with its images, lowers the weighted sum of deviations at `over`.

        A deviation is the root of the posterior variance with the noise of a run: what an error is proportional to.
        """
        falls, before = self._falls(candidates, over)
        after = np.maximum(before[None] - falls, self.noise)
        return np.asarray((np.sqrt(before)[None] - np.sqrt(after)) @ weights)

    def _falls(
        self, candidates: NDArray[np.float64], over: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(candidate, over): by how much the variance at `over` falls with a run at each candidate; (over,): what it is."""
        seen, solve = self._seen()
        x = self.inputs(over)[0]
        images = self.inputs(candidates)
        known_over = solve(self.kernel(seen, x))
        before = _diagonal(self.kernel, x) - (self.kernel(x, seen) * known_over.T).sum(axis=1) + self.noise
        to_over = [self.kernel(c, x) - self.kernel(c, seen) @ known_over for c in images]
        known_images = [solve(self.kernel(seen, c)) for c in images]
        inner = np.empty((len(candidates), len(images), len(images)))
        for a, first in enumerate(images):
            towards = self.kernel(first, seen)
            for b, second in enumerate(images):
                inner[:, a, b] = _between(self.kernel, first, second) - (towards * known_images[b].T).sum(axis=1)
            inner[:, a, a] += self.noise + 1e-10
        outer = np.stack(to_over, axis=1)  # (candidate, image, over)
        return np.einsum("cao,cao->co", outer, np.linalg.solve(inner, outer)), np.maximum(before, self.noise)

    def with_runs(self, points: NDArray[np.float64]) -> Posterior:
        """The same process once `points` (point, parameter) are computed."""
        return Posterior(self.kernel, self.noise, self.inputs, np.concatenate([self.known, points]))

    def _seen(self) -> tuple[NDArray[np.float64], Callable[[NDArray[np.float64]], NDArray[np.float64]]]:
        from scipy.linalg import cho_factor, cho_solve

        seen = np.concatenate(self.inputs(self.known))
        factor = cho_factor(self.kernel(seen, seen) + (self.noise + 1e-10) * np.eye(len(seen)), lower=True)
        return seen, lambda b: cho_solve(factor, b)


@dataclass
class ExpectedReduction:
    """Asks for the runs that lower the deviation averaged over the box most.

    Parameters
    ----------
    posterior
        What is believed now.
    over
        (point, parameter) points that stand for the box.
    weights
        (point,) how much each of them counts, such as how wrong the process is around it; all alike without.
    """

    posterior: Posterior
    over: NDArray[np.float64]
    weights: NDArray[np.float64] | None = None
    chosen: list[NDArray[np.float64]] = field(default_factory=list)

    def ask(self, candidates: NDArray[np.float64], count: int) -> NDArray[np.float64]:
        """The next `count` of `candidates` (candidate, parameter), one after the other."""
        weights = np.ones(len(self.over)) if self.weights is None else self.weights
        left = np.ones(len(candidates), bool)
        belief, out = self.posterior, []
        for _ in range(min(count, len(candidates))):
            gain = np.where(left, belief.reductions(candidates, self.over, weights / weights.sum()), -np.inf)
            best = int(np.argmax(gain))
            left[best] = False
            out.append(candidates[best])
            belief = belief.with_runs(candidates[best][None])
        return np.array(out).reshape(-1, candidates.shape[1])

    def tell(self, points: NDArray[np.float64]) -> None:
        """Count `points` (point, parameter) as computed."""
        self.posterior = self.posterior.with_runs(np.atleast_2d(points))


def _diagonal(kernel: Kernel, x: NDArray[np.float64]) -> NDArray[np.float64]:
    return _between(kernel, x, x)


def _between(kernel: Kernel, a: NDArray[np.float64], b: NDArray[np.float64], size: int = 128) -> NDArray[np.float64]:
    """(n,): the kernel of each row of `a` with the same row of `b`."""
    return np.concatenate([np.diagonal(kernel(a[k : k + size], b[k : k + size])) for k in range(0, len(a), size)])
