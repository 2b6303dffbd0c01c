"""POD with Gaussian processes and radial basis functions, against scikit-learn and scipy."""

from __future__ import annotations

import numpy as np
import plate
import pytest
from scipy.interpolate import RBFInterpolator

from surrogates.data.campaign import Campaign
from surrogates.errors import SurrogateError
from surrogates.models.pod_regression import Held, PodRegression
from surrogates.regression.gaussian import RadialBasis
from surrogates.settings import settings
from surrogates.training.train import train_surrogate


def e2(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b, axis=-1).mean())


def test_radial_basis_functions_are_scipys() -> None:
    draw = np.random.default_rng(0)
    x, y, query = draw.uniform(-1, 1, (15, 2)), draw.standard_normal((15, 4)), draw.uniform(-1, 1, (6, 2))
    theirs = RBFInterpolator(x, y, kernel="thin_plate_spline", degree=1, smoothing=1e-9)(query)
    np.testing.assert_allclose(RadialBasis(x).weights(query) @ y, theirs, atol=1e-8)


@pytest.mark.parametrize("inputs", ["trajectory", "point"])
@pytest.mark.parametrize("model", ["pod-gpr", "pod-rbf"])
def test_runs_never_seen_are_predicted(model: str, inputs: str) -> None:
    surrogate = train_surrogate(
        plate.campaign(24), settings(model, overrides=[f"pod.inputs={inputs}", "pod.modes=[8]"])
    )
    mu = plate.parameters(3, seed=9)
    truth = plate.displacement(mu)
    nothing = e2(truth, np.zeros_like(truth))
    assert e2(surrogate.predict(mu), truth) < 0.2 * nothing


def test_test_runs_do_not_enter_and_cross_validation_chooses() -> None:
    surrogate = train_surrogate(plate.campaign(16), settings("pod-rbf", overrides=["pod.modes=[1, 6]"]))
    record = surrogate.record
    assert len(record.fitted_runs) == 16
    assert not record.validation_runs
    assert set(record.held_out_runs).isdisjoint(record.fitted_runs)
    tried = {name: error for name, error in record.errors.items() if "modes" in name}
    best = min(tried, key=lambda name: tried[name])
    assert best == f"{record.choice['inputs']}, {record.choice['modes']} modes"
    assert surrogate.n_latent() == record.choice["modes"]


def test_runs_named_for_validation_are_the_ones_that_choose() -> None:
    named = train_surrogate(
        plate.campaign(16), settings("pod-gpr", overrides=["validation.runs=[run_003, run_007]", "pod.modes=[4]"])
    )
    assert named.record.validation_runs == ("run_003", "run_007")
    assert len(named.record.fitted_runs) == 16


def test_between_trained_times_the_course_is_interpolated_and_held_at_its_ends() -> None:
    surrogate = train_surrogate(
        plate.campaign(12),
        settings("pod-rbf", overrides=["pod.inputs=trajectory", "pod.modes=[4]", "physics.clock=off"]),
    )
    mu = plate.parameters(1, seed=5)[0]
    all_at_once = surrogate.predict(mu)
    np.testing.assert_allclose(surrogate.predict(mu, plate.TIME[[2]])[0], all_at_once[2], atol=1e-6)
    between = surrogate.predict(mu, [(plate.TIME[2] + plate.TIME[3]) / 2])[0]
    np.testing.assert_allclose(between, (all_at_once[2] + all_at_once[3]) / 2, atol=0.02)
    np.testing.assert_allclose(surrogate.predict(mu, [1.0])[0], all_at_once[-1], atol=1e-6)


def test_reconstruction_is_the_projection_on_the_modes() -> None:
    surrogate = train_surrogate(
        plate.campaign(12), settings("pod-gpr", overrides=["pod.modes=[3]", "pod.inputs=trajectory"])
    )
    core = surrogate.core
    assert isinstance(core, PodRegression)
    states = plate.displacement(plate.parameters(1, seed=5))[0]
    modes = core.modes.astype(np.float64)
    expected = (states.reshape(7, -1) @ modes @ modes.T).reshape(7, 81, 3)
    np.testing.assert_allclose(surrogate.reconstruct(states), expected, atol=1e-5)


def test_one_training_run_is_repeated_whatever_is_asked() -> None:
    surrogate = train_surrogate(plate.campaign(1), settings("pod-gpr"))
    asked = surrogate.predict(plate.parameters(1, seed=5)[0])
    np.testing.assert_allclose(asked, plate.displacement(plate.parameters(1))[0], atol=1e-4)
    assert any("one training run" in note for note in surrogate.record.notes)


def test_a_parameter_that_one_run_alone_changes_is_constant_in_the_fold_without_it() -> None:
    mu = plate.parameters(8)
    mu[:, 2] = 3e8
    mu[4, 2] = 4e8
    u = plate.displacement(mu)
    off = ["inputs.derived=off", "physics.clock=off", "pod.modes=[4]", "pod.inputs=trajectory"]
    surrogate = train_surrogate(
        plate.campaign(8, parameters=mu, displacement=lambda level: u), settings("pod-gpr", overrides=off)
    )
    assert len(surrogate.record.left_out) == 8
    assert np.isfinite(surrogate.predict(mu[4])).all()


def still(runs: int) -> Campaign:
    return plate.campaign(runs, displacement=lambda level: np.zeros((runs, 7, 81, 3), np.float32))


def test_a_campaign_in_which_nothing_moves_is_refused() -> None:
    with pytest.raises(SurrogateError, match="no training run moves"):
        train_surrogate(still(6), settings("pod-gpr"))


def test_each_run_is_read_for_the_basis_for_its_coefficients_and_once_to_judge_it() -> None:
    class Counted:
        def __init__(self, field: np.ndarray) -> None:
            self.field, self.shape, self.reads = field, field.shape, np.zeros(len(field), int)

        def __getitem__(self, run: int) -> np.ndarray:
            self.reads[run] += 1
            return self.field[run]

    runs = 14  # each fold is drawn twice, so every run is left out twice
    field = Counted(plate.displacement(plate.parameters(runs)))
    found = train_surrogate(
        plate.campaign(runs, displacement=lambda level: field), settings("pod-gpr", overrides=["pod.modes=[4]"])
    )
    assert found.bands
    assert field.reads.tolist() == [3] * runs


def test_distances_of_a_left_out_run_are_those_of_its_whole_prediction(monkeypatch: pytest.MonkeyPatch) -> None:
    draw = np.random.default_rng(0)
    course, modes = draw.normal(size=(7, 4)).astype("f4"), draw.normal(size=(3 * 50, 4)).astype("f4")
    truth = draw.normal(size=(7, 50, 3)).astype("f4")
    held = Held(0, course, modes, 1.0)
    monkeypatch.setattr("surrogates.models.pod_regression._NODES", 16)
    np.testing.assert_allclose(held.off(truth), np.linalg.norm(held.predicted - truth, axis=-1), rtol=1e-5)
