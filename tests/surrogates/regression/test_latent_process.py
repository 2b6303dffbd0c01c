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
from surrogates.regression.latent_process import LatentProcess, fit_process, mix_in
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
    kernel = LatentProcess.weights
    monkeypatch.setattr(LatentProcess, "weights", lambda self, x: asked.append(len(x)) or kernel(self, x))
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


# The process itself


def test_it_passes_through_the_training_runs_at_trained_times() -> None:
    process = fitted()
    for run in range(12):
        found = process(at(np.repeat(RUNS[run : run + 1], 5, axis=0), TIME))
        np.testing.assert_allclose(found, courses()[run], atol=1e-3)


def test_far_from_all_runs_it_is_the_mean_course_and_a_linear_trend() -> None:
    """The kernel's first part has died out there, so that second differences vanish."""
    process = fitted()
    longest = 1 / np.linalg.svd(process.mix.numpy())[1].min()
    far = [np.array([[60.0, -40.0]]) * longest * k for k in (1, 2, 3)]
    a, b, c = (process(at(np.repeat(x, 5, axis=0), TIME)).numpy() for x in far)
    assert np.abs(c - a).max() > 1e-2, "there is a trend"
    np.testing.assert_allclose(a - 2 * b + c, 0, atol=1e-9 * np.abs(c).max())


def test_what_stands_behind_the_time_is_not_read() -> None:
    process = fitted()
    x = at(RUNS[:3] * 0.7, TIME[:3])
    more = torch.cat([x, torch.randn(3, 4, dtype=torch.float64)], dim=1)
    assert torch.equal(process(more), process(x))


def test_runs_may_be_mixed_in_a_batch() -> None:
    process = fitted()
    x = at(np.array([[0.3, -0.2], [0.5, 0.1], [0.3, -0.2]]), np.array([-0.7, 0.3, 0.9]))
    for k in range(3):
        torch.testing.assert_close(process(x)[k], process(x[k : k + 1])[0], rtol=1e-9, atol=1e-9)


def test_room_is_made_for_what_was_stored() -> None:
    process = fitted()
    again = LatentProcess.like(process.state_dict()).double()
    again.load_state_dict(process.state_dict())
    x = at(RUNS[:2], TIME[:2])
    assert torch.equal(again(x), process(x))
    assert (len(again.runs), again.mean.shape, again.mix.shape) == (12, (5, 3), (2, 2))


def test_latent_numbers_that_move_nothing_have_no_say_in_theweights() -> None:
    """Noise in a number of size 0 changes the kernel's numbers for no other."""
    noisy = courses()
    noisy[..., 2] = np.random.default_rng(5).normal(size=noisy.shape[:2])
    sizes = np.array([1.0, 2.0, 0.0])
    still = courses()
    still[..., 2] = 0
    one, other = (fit_process(RUNS, TIME, c, sizes, seed=0) for c in (noisy, still))
    for name in ("numbers", "mix"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name))
    weighted = fit_process(RUNS, TIME, noisy, np.ones(3), seed=0)
    assert not torch.allclose(weighted.mix, one.mix, rtol=1e-3)


# Its share in a level


class Level:
    process: LatentProcess | None = None


class Judge:
    """A level's samples, run by run, and losses by share: approximation as given, reconstruction misleading."""

    def __init__(self, losses: dict[float, float] | None, runs: np.ndarray = RUNS) -> None:
        self.losses, self.runs, self.level, self.asked = losses, runs, Level(), 0

    def latents(self) -> tuple[torch.Tensor, torch.Tensor]:
        self.asked += 1
        some = len(self.runs)
        inputs = np.concatenate(
            [np.repeat(self.runs, 5, axis=0), np.tile(TIME, some)[:, None], np.ones((5 * some, 1))], axis=1
        )
        return torch.from_numpy(inputs).float(), torch.from_numpy(courses()[:some].reshape(-1, 3)).float()

    def latent_sizes(self) -> torch.Tensor:
        return torch.tensor([1.0, 2.0, 0.5])

    def validation(self) -> torch.Tensor | None:
        if self.losses is None:
            return None
        assert self.level.process is not None
        loss = self.losses[float(self.level.process.share)]
        return torch.tensor([loss, 1.0 - loss])

    def mixed(self, wish: str) -> float:
        mix_in(self.level, self, wish, 2, 5, 0)  # type: ignore[arg-type]
        return 0.0 if self.level.process is None else float(self.level.process.share)


@pytest.mark.parametrize("best", [0.0, 0.5, 1.0])
def test_auto_takes_the_share_with_the_least_approximation_loss(best: float) -> None:
    losses = {share: 0.4 if share != best else 0.1 for share in (0.0, 0.5, 1.0)}
    assert Judge(losses).mixed("auto") == best


def test_auto_takes_the_mean_where_nothing_can_be_compared_or_all_are_equal() -> None:
    assert Judge(None).mixed("auto") == 0.5
    assert Judge(dict.fromkeys((0.0, 0.5, 1.0), 0.3)).mixed("auto") == 0.5


@pytest.mark.parametrize(("wish", "share"), [("process", 1.0), ("mean", 0.5)])
def test_a_share_asked_for_is_taken_whatever_validation_says(wish: str, share: float) -> None:
    assert Judge({0.0: 0.0, 0.5: 9.0, 1.0: 9.0}).mixed(wish) == share
    assert Judge(None).mixed(wish) == share


def test_a_network_alone_is_not_even_encoded() -> None:
    judge = Judge(None)
    assert judge.mixed("network") == 0.0
    assert judge.asked == 0


@pytest.mark.parametrize(("count", "share"), [(2, 0.0), (3, 0.5)])
def test_three_runs_are_the_fewest(count: int, share: float) -> None:
    assert Judge(None, RUNS[:count]).mixed("mean") == share


def test_runs_that_agree_in_all_parameters_teach_a_process_nothing() -> None:
    assert Judge(None, np.repeat(RUNS[:1], 5, axis=0)).mixed("mean") == 0.0
    one_differs = np.repeat(RUNS[:1], 5, axis=0)
    one_differs[3, 1] += 0.5
    assert Judge(None, one_differs).mixed("mean") == 0.5


def test_the_process_of_a_level_is_that_of_its_encoded_runs() -> None:
    judge = Judge(None)
    judge.mixed("process")
    found, expected = judge.level.process, fitted()
    assert found is not None
    x = at(np.random.default_rng(3).uniform(-1, 1, (4, 2)), np.array([-0.9, 0.0, 0.3, 0.8]))
    torch.testing.assert_close(found.double()(x), expected(x), rtol=1e-3, atol=1e-3)
