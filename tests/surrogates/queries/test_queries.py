"""A surrogate at a few points, and the distribution of parameters that a misfit leaves."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
import plate
import pytest
from scipy import sparse
from scipy.interpolate import PchipInterpolator

from surrogates.errors import SurrogateError
from surrogates.models.pod_regression import PodRegression
from surrogates.queries.misfit import _power
from surrogates.queries.points import AtPoints, between_courses
from surrogates.queries.posterior import posterior
from surrogates.regression.gaussian import Gaussian
from surrogates.settings import settings
from surrogates.surrogate import Surrogate
from surrogates.training.train import train_surrogate
from surrogates.uncertainty import Spread


@pytest.fixture(scope="module")
def process() -> Surrogate:
    return train_surrogate(
        plate.campaign(16),
        settings("pod-gpr", overrides=["physics.clock=off", "physics.symmetry=off", "inputs.derived=off"]),
    )


@pytest.fixture(scope="module")
def network() -> Surrogate:
    return train_surrogate(plate.campaign(10), settings("mh", overrides=["level.epochs=1"]))


WHERE = sparse.csr_matrix(([1.0, 0.25, 0.75], ([0, 1, 1], [3, 40, 41])), shape=(2, 81))


@pytest.mark.parametrize("name", ["process", "network"])
def test_points_are_the_prediction_at_these_nodes(name: str, request: pytest.FixtureRequest) -> None:
    surrogate: Surrogate = request.getfixturevalue(name)
    mu, time = plate.parameters(5, seed=3), np.array([0.0123, 0.03])
    full = surrogate.predict_full(mu, time)
    expected = np.stack([full[:, :, 3], 0.25 * full[:, :, 40] + 0.75 * full[:, :, 41]], axis=2)
    assert np.abs(AtPoints(surrogate, WHERE, time)(mu) - expected).max() < 1e-5 * np.abs(full).max()


def test_courses_are_interpolated_as_predictions_are() -> None:
    random = np.random.default_rng(0)
    weights, known = random.normal(size=(6, 4)), random.normal(size=(4, 9, 3))
    grid, time = np.sort(random.uniform(0, 1, 9)), random.uniform(-0.1, 1.1, 6)
    whole = PchipInterpolator(grid, np.einsum("rs,stn->rtn", weights, known), axis=1)
    expected = [whole(np.clip(t, grid[0], grid[-1]))[k] for k, t in enumerate(time)]
    assert np.allclose(between_courses(weights, known, grid, time), expected)


def test_a_model_without_a_band_has_no_deviation(process: Surrogate) -> None:
    few = train_surrogate(plate.campaign(5), settings("pod-gpr"))
    assert AtPoints(few, WHERE, np.array([0.03])).deviation() is None
    known = AtPoints(process, WHERE, np.array([0.03])).deviation()
    assert known is not None
    assert (known > 0).all()


@pytest.mark.parametrize("spread", ["constant", "size", "deviation", "local"])
def test_the_error_of_a_run_goes_with_the_width_of_its_band(process: Surrogate, spread: Spread) -> None:
    surrogate = copy(process)
    band = replace(process.bands[0, False], spread=spread, unit=2.0, local=process.local_errors())
    surrogate.bands = {(0, False): band}
    mu = plate.parameters(4, seed=3)
    found = AtPoints(surrogate, WHERE, plate.TIME).spread(mu)
    widths = [surrogate.band(0.9, parameters=one).mean() / surrogate.band(0.9).mean() for one in mu]
    np.testing.assert_allclose(found, widths, rtol=1e-5)


def test_errors_of_left_out_runs_are_those_of_a_process_without_them(process: Surrogate) -> None:
    """Left out by linear algebra, and left out in fact: the same kernel and modes, one run fewer."""
    core = process.core
    assert isinstance(core, PodRegression)
    points = AtPoints(process, WHERE, plate.TIME[[3, 6]])
    found = points.left_out()
    assert found is not None
    runs = np.array([process.record.parameters[n] for n in process.record.ranges.names]).T
    rest = np.arange(1, len(runs))
    machine = Gaussian(core.machine.x[rest], core.machine.kernel)
    weights = machine.weights(core.machine.x[:1])
    values = core.data.values.astype(np.float64)
    course = values[0] - np.einsum("s,stm->tm", weights[0], values[rest])
    here = (core.modes.reshape(81, -1)[3]).reshape(3, -1)  # of the first point
    assert np.allclose(found[0, :, 0], course[[3, 6]] @ here.T, atol=1e-4 * np.abs(found).max())


class Bells:
    """A density of normal bells of one width."""

    def __init__(self, *middles: tuple[float, ...], width: float = 0.02) -> None:
        self.middles, self.width = np.array(middles), width

    def __call__(self, x: np.ndarray) -> np.ndarray:
        square = np.square((x[:, None, : self.middles.shape[1]] - self.middles) / self.width).sum(axis=2)
        return np.logaddexp.reduce(-square / 2, axis=1)

    def explored(self, x: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        size = self.middles.shape[1]
        wide = self.width**2 + np.square(reach[:, :size]) / 3
        square = (np.square(x[:, None, :size] - self.middles) / wide[:, None]).sum(axis=2)
        change = np.zeros_like(x)
        change[:, :size] = reach[:, :size] / self.width
        return np.logaddexp.reduce(-square / 2, axis=1) - np.log(wide / self.width**2).sum(axis=1) / 2, change


BOX = np.array([0.0, 0.0, 0.0]), np.array([1.0, 1.0, 1.0])


def test_a_bell_is_found_with_its_width() -> None:
    found = posterior(Bells((0.31, 0.72)), *BOX)
    assert np.allclose(found.best[:2], [0.31, 0.72], atol=1e-3)
    assert np.allclose(found.samples.std(axis=0)[:2], 0.02, rtol=0.1)
    assert found.narrowing()[2] == pytest.approx(1.0, abs=0.03)  # of no effect: all of the box is left
    assert len(found.explanations) == 1
    assert not found.at_edge().any()
    inside = Bells((0.31, 0.72))(np.array([[0.31 + 0.02 * 2.0, 0.72, 0.5], [0.31 + 0.02 * 2.4, 0.72, 0.5]]))
    assert list(inside >= found.threshold(0.9)) == [True, False]  # two parameters: 90 % within 2.146 deviations


def test_two_bells_are_two_explanations() -> None:
    found = posterior(Bells((0.2, 0.2, 0.5), (0.8, 0.7, 0.5)), *BOX)
    assert [round(e.share, 1) for e in found.explanations] == [0.5, 0.5]
    assert sorted(e.parameters[0].round(2) for e in found.explanations) == [0.2, 0.8]


def test_an_optimum_beyond_the_box_is_told() -> None:
    assert list(posterior(Bells((1.05, 0.4)), *BOX).at_edge()) == [True, False, False]


def test_known_parameters_stay() -> None:
    found = posterior(Bells((0.31, 0.72)), np.array([0.3, 0.0, 0.0]), np.array([0.3, 1.0, 1.0]))
    assert (found.samples[:, 0] == 0.3).all()
    with pytest.raises(SurrogateError, match="leave at least one"):
        posterior(Bells((0.5, 0.5)), BOX[0], BOX[0])


def test_more_parameters_are_sampled() -> None:
    found = posterior(Bells((0.3, 0.4, 0.5, 0.6), width=0.1), np.zeros(4), np.ones(4), samples=600, starts=2)
    assert np.allclose(found.samples.mean(axis=0), [0.3, 0.4, 0.5, 0.6], atol=0.02)
    assert np.allclose(found.samples.std(axis=0), 0.1, rtol=0.15)


def test_the_region_is_wider_where_few_runs_tell_the_correlation() -> None:
    drops = np.linspace(1, 20, 100)
    few, many, all_known = (_power(drops, 5, runs) for runs in (24, 96, 10**6))
    assert few < many < all_known
    assert many / few == pytest.approx(1.4, abs=0.1)  # Hotelling's T squared: 1.49 against 1.08
    assert _power(drops, 5, 4) > 0


def test_a_left_out_run_is_as_uncertain_as_a_new_one(process: Surrogate) -> None:
    """At runs it knows a process believes in next to no error; without them it does not."""
    band = process.bands[0, False]
    doubted = copy(process)
    doubted.bands = {(0, False): replace(band, spread="deviation", unit=1.0)}
    runs = np.array([process.record.parameters[n] for n in process.record.ranges.names]).T
    points = AtPoints(doubted, sparse.identity(process.graphs.n_full, format="csr")[:3], process.record.time[-1:], None)
    new = points.spread(runs + 0.05 * np.ptp(runs, axis=0))
    assert np.median(points.spread(runs)) < 0.5 * np.median(points.spread_left_out(runs))
    assert np.median(points.spread_left_out(runs)) > 0.5 * np.median(new)
