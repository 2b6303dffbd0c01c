"""What a trained process says about its box: how wrong it is there, and which runs would help most."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from crashkit.campaign.box import Box, CampaignError

if TYPE_CHECKING:
    from surrogates.design.criteria import Posterior
    from surrogates.design.judgement import Judgement
    from surrogates.models.pod_regression import PodRegression
    from surrogates.physics.registration import Registration
    from surrogates.regression.gaussian import Gaussian
    from surrogates.surrogate import Surrogate

# Points that stand for the box, and candidates for the next runs.
_OVER, _CANDIDATES = 512, 1024
# Variance of the constant that stands for the unknown mean of the process.
_MEAN = 100.0


@dataclass
class TrainedProcess:
    """A trained process and its box, in the units of the process.

    Attributes
    ----------
    scale
        (parameter,) SI value of one unit of the box.
    fixed
        Parameters that are the same in all runs and that the box does not name, in the units of the model.
    """

    surrogate: Surrogate
    box: Box
    scale: NDArray[np.float64]
    fixed: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, surrogate: Surrogate, box: Box) -> TrainedProcess:
        """Raises CampaignError where the box is not that of the model."""
        from data_schema import to_si

        ranges = surrogate.record.ranges
        names, units = ranges.names, ranges.units
        fixed = {
            n: float(a) for n, a, b in zip(names, ranges.low, ranges.high, strict=True) if a == b and n not in box.names
        }
        missing = sorted((set(names) - set(fixed)) ^ set(box.names))
        if missing:
            raise CampaignError(
                f"the box and the runs differ in {', '.join(missing)}; the runs have {', '.join(names)}, the box "
                f"{', '.join(box.names)}"
            )
        factors = []
        for name, unit in zip(box.names, box.units, strict=True):
            own = units[names.index(name)]
            (mine, si), (theirs, theirs_si) = to_si(unit), to_si(own)
            if si != theirs_si:
                raise CampaignError(
                    f"{name} is in {unit or 'no unit'} in the box and in {own or 'no unit'} in the runs"
                )
            factors.append(mine / theirs)
        return cls(surrogate, box, np.array(factors), fixed)

    def parameters(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(point, parameter) of the box -> in the order and units of the model."""
        given = points * self.scale
        columns = [
            given[:, self.box.names.index(n)] if n in self.box.names else np.full(len(given), self.fixed[n])
            for n in self.surrogate.record.ranges.names
        ]
        return np.stack(columns, axis=1)

    def of_runs(self, names: Sequence[str], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """(run, parameter) of a dataset's names and values, in the order of the model."""
        return values[:, [names.index(n) for n in self.surrogate.record.ranges.names]]

    def points(self, seed: int, count: int) -> NDArray[np.float64]:
        """(point, parameter) all over the box, its constraints kept."""
        from surrogates.design.space import fill

        return fill(self.box.low, self.box.high, count, seed=seed, allowed=self.box.allowed, sequence="sobol")

    def judge(self, confidence: float, seed: int = 0) -> Judgement:
        """The error over the box, by runs that were left out while the process was trained."""
        from surrogates.design.judgement import judge

        ratios, _ = self._ratios()
        return judge(ratios, np.ones(len(ratios)), self.deviation(self.points(seed, _OVER)), confidence, seed)

    def deviation(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(point,): what the process believes its error to be at points of the box, up to a factor."""
        core, _, registration = _process(self.surrogate)
        parameters = self.parameters(points)
        return np.asarray(core.deviation(registration.read(parameters)) * self.size(parameters))

    def size(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """(point,): how large errors at (point, parameter) are for one unit of the process's deviation, up to a factor.

        The process lives on the reference's clock and size. A run of higher speed moves further, and goes further along
        the course, where runs are further apart: size of the run times the mean spread of the training runs over the
        part of the course that it goes through.
        """
        core, _, registration = _process(self.surrogate)
        courses = core.data.values.astype(np.float64)
        spread = np.sqrt(((courses - courses.mean(axis=0)) ** 2).sum(axis=2).mean(axis=0))
        out = registration.clock.size(parameters)
        for k, one in enumerate(parameters):
            passed = registration.clock.times(one, self.surrogate.record.time)
            out[k] *= np.interp(passed, core.data.time, spread).mean()
        return np.asarray(out)

    def wrongness(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """(point,): how often the error of left-out runs near (point, parameter) was what the process expected, squared.

        The ratios of error to deviation of left-out runs, averaged with the process's own correlation as weight: where
        the process is wrong rather than far from runs, as at a fold, it is above its mean of about 1.
        """
        core, machine, registration = _process(self.surrogate)
        ratios, runs = self._ratios()
        kernel = machine.kernel
        corners = np.stack([core.low, core.high])
        from surrogates.data.inputs import over_range

        here, there = (over_range(registration.read(p), corners) for p in (parameters, runs))
        distance = np.sqrt(3 * (((here @ kernel.mix.T)[:, None] - (there @ kernel.mix.T)[None]) ** 2).sum(axis=2))
        near = (1 + distance) * np.exp(-distance) + 1e-3
        local = (near @ ratios**2) / near.sum(axis=1)
        return np.asarray(local / np.mean(ratios**2))

    def _ratios(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Error over deviation of each left-out run, and its parameters (run, parameter)."""
        record = self.surrogate.record
        if len(record.left_out) < 2:
            raise CampaignError("the model knows no errors of left-out runs; train it with more runs")
        places = [record.fitted_runs.index(name) for name in record.left_out]
        runs = np.array([record.parameters[n] for n in record.ranges.names], np.float64).T[places]
        errors, deviations = np.array(list(record.left_out.values()), np.float64).T
        return errors / (deviations * self.size(runs)), runs

    def posterior(self, known: NDArray[np.float64]) -> Posterior:
        """The belief behind it, for runs at `known` (run, parameter) in the units of the model."""
        from surrogates.data.inputs import over_range
        from surrogates.design.criteria import Posterior

        core, machine, registration = _process(self.surrogate)
        kernel = machine.kernel
        corners = np.stack([core.low, core.high])

        def inputs(parameters: NDArray[np.float64]) -> list[NDArray[np.float64]]:
            own = registration.read(parameters)
            out = [over_range(own, corners)]
            if not registration.symmetry.is_identity:
                image = registration.read(registration.symmetry.images(parameters, self.surrogate.record.ranges.names))
                if registration.symmetry.flagged:
                    image[:, -1] = 1.0
                out.append(over_range(image, corners))
            return out

        return Posterior(lambda a, b: kernel(a, b) + _MEAN, kernel.noise, inputs, known)

    def best(self, known: NDArray[np.float64], count: int, seed: int) -> tuple[NDArray[np.float64], float]:
        """The next `count` points (point, parameter) of the box, and by which share the mean deviation falls with them."""
        from surrogates.design.criteria import ExpectedReduction

        over, candidates = self.points(seed, _OVER), self.points(seed + 1, _CANDIDATES)
        belief = self.posterior(known)
        method = ExpectedReduction(belief, self.parameters(over), self.size(self.parameters(over)))
        chosen = method.ask(self.parameters(candidates), count)
        found = self.parameters(candidates)
        share = self.fall(known, chosen, seed)
        places = [int(np.flatnonzero((found == row).all(axis=1))[0]) for row in chosen]
        return candidates[places], share

    def fall(self, known: NDArray[np.float64], points: NDArray[np.float64], seed: int) -> float:
        """The mean deviation over the box with runs at `points` against that without, all in the units of the model."""
        over, belief = self.parameters(self.points(seed, _OVER)), self.posterior(known)
        size = self.size(over)
        before = (size * np.sqrt(belief.variance(over) + belief.noise)).mean()
        after = (size * np.sqrt(belief.with_runs(points).variance(over) + belief.noise)).mean()
        return float(after / before)


def _process(surrogate: Surrogate) -> tuple[PodRegression, Gaussian, Registration]:
    """The POD model in `surrogate`, its process over whole runs, and their registration. Raises CampaignError."""
    from surrogates.models.pod_regression import PodRegression
    from surrogates.regression.gaussian import Gaussian

    core = surrogate.core
    if not isinstance(core, PodRegression) or not isinstance(core.machine, Gaussian) or core.inputs != "trajectory":
        raise CampaignError("proposals ask a process over whole runs; train pod-gpr on these runs")
    return core, core.machine, surrogate.registration
