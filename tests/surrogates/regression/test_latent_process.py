"""A Gaussian process over whole runs beside a level's network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plate
import pytest
import torch
from scipy.interpolate import CubicHermiteSpline

from surrogates.models.cascade import Cascade
from surrogates.regression.gaussian import Gaussian
from surrogates.regression.latent_process import LatentProcess, fit_process
from surrogates.settings import settings
from surrogates.storage.folder import load, save
from surrogates.surrogate import Surrogate
from surrogates.training.train import train_surrogate

RUNS = np.random.default_rng(0).uniform(-1, 1, (12, 2))
TIME = np.array([-1.0, -0.4, 0.1, 0.5, 1.0])


def courses() -> np.ndarray:
    """(run, state, 3), smooth in parameters and time."""
    a, b = RUNS[:, :1], RUNS[:, 1:]
    return np.stack([a * TIME + b, np.sin(a + TIME) * b, a * b * TIME**2], axis=-1)


def fitted() -> LatentProcess:
    return fit_process(RUNS, TIME, courses(), np.array([1.0, 2.0, 0.5]), seed=0).double()


def at(parameters: np.ndarray, time: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.concatenate([parameters, time[:, None]], axis=1))


def test_at_trained_times_it_is_the_gaussian_process_of_whole_courses() -> None:
    machine = Gaussian(RUNS).fit((courses() * [1.0, 2.0, 0.5]).reshape(12, -1), seed=0)
    query = np.random.default_rng(1).uniform(-1, 1, (1, 2))
    mean = courses().mean(axis=0)
    expected = mean + np.tensordot(machine.weights(query)[0], courses() - mean, axes=1)
    found = fitted()(at(np.repeat(query, 5, axis=0), TIME))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_one_run_costs_one_course_and_gives_what_any_batch_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    kernel = LatentProcess._kernel
    monkeypatch.setattr(LatentProcess, "_kernel", lambda self, x: asked.append(len(x)) or kernel(self, x))
    query = at(np.repeat([[0.3, -0.2]], 5, axis=0), TIME)
    other = at(np.array([[0.5, 0.5]]), TIME[:1])
    process = fitted()
    with torch.no_grad():
        alone, among = process(query), process(torch.cat([query, other]))[:5]
    torch.testing.assert_close(alone, among, rtol=1e-12, atol=1e-12)
    assert asked == [1, 6]


def test_between_trained_times_it_is_a_cubic_hermite_spline_and_held_outside() -> None:
    query = np.array([[0.3, -0.2]])
    process = fitted()
    known = process(at(np.repeat(query, 5, axis=0), TIME)).numpy()
    slopes = np.empty_like(known)
    for k in range(5):
        a, b = max(k - 1, 0), min(k + 1, 4)
        slopes[k] = (known[b] - known[a]) / (TIME[b] - TIME[a])
    fine = np.linspace(-1, 1, 41)
    expected = CubicHermiteSpline(TIME, known, slopes)(fine)
    np.testing.assert_allclose(process(at(np.repeat(query, 41, axis=0), fine)), expected, atol=1e-6)
    outside = process(at(np.repeat(query, 2, axis=0), np.array([-3.0, 3.0])))
    np.testing.assert_allclose(outside, known[[0, -1]], atol=1e-9)


def test_one_state_is_its_own_course() -> None:
    process = fit_process(RUNS, TIME[:1], courses()[:, :1], np.ones(3), seed=0).double()
    x = np.random.default_rng(2).uniform(-1, 1, (4, 2))
    assert torch.equal(process(at(x, np.full(4, -1.0))), process(at(x, np.full(4, 0.7))))


def test_it_can_be_differentiated_by_the_parameters_also_on_a_training_run() -> None:
    process = fitted()
    x = at(np.array([[0.1, 0.2], RUNS[3]]), np.array([0.3, 0.3])).requires_grad_()
    (gradient,) = torch.autograd.grad(process(x).sum(), x)
    step = 1e-5 * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    with torch.no_grad():
        slope = (process(x + step) - process(x - step)).sum(dim=1) / 2e-5
    np.testing.assert_allclose(gradient[0, 0], slope[0], rtol=1e-4)
    assert torch.isfinite(gradient).all()


def trained(wish: str, *more: str, runs: int = 12) -> Surrogate:
    return train_surrogate(
        plate.campaign(runs), settings("mh", overrides=["level.epochs=3", f"level.regression={wish}", *more])
    )


def shares(surrogate: Surrogate) -> list[float]:
    core = surrogate.core
    assert isinstance(core, Cascade)
    return [0.0 if level.process is None else float(level.process.share) for level in core.levels.values()]


@pytest.mark.parametrize(("wish", "expected"), [("network", [0, 0]), ("mean", [0.5, 0.5]), ("process", [1, 1])])
def test_the_share_is_the_one_asked_for(wish: str, expected: list[float]) -> None:
    assert shares(trained(wish)) == expected


def test_auto_takes_what_is_best_on_validation_runs() -> None:
    chosen = trained("auto", "levels=[2]")
    share = shares(chosen)[0]
    assert share > 0  # three epochs make no good network
    errors = {w: trained(w, "levels=[2]").record.errors["MH2"] for w in ("network", "mean", "process")}
    assert chosen.record.errors["MH2"] == pytest.approx(min(errors.values()), rel=0.05)


def test_it_is_stored_and_counted(tmp_path: Path) -> None:
    surrogate = trained("mean")
    again = load(save(surrogate, tmp_path / "model"))
    mu = plate.parameters(2, seed=5)
    np.testing.assert_array_equal(again.predict(mu), surrogate.predict(mu))
    assert again.n_parameters() == surrogate.n_parameters() > trained("network").n_parameters()


@pytest.mark.parametrize("runs", [1, 2])
def test_too_few_runs_leave_the_network_alone(runs: int) -> None:
    assert shares(trained("mean", runs=runs)) == [0, 0]
