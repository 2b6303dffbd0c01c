"""The regression of one level, chosen on encoded runs: who trains on what, what is chosen, and what happens when it fails."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from surrogates.record import Fit
from surrogates.regression.gaussian import Gaussian
from surrogates.regression.network import Course, Regressor
from surrogates.training.latents import Latents
from surrogates.training.loop import Diverged, Objective
from surrogates.training.regression import (
    Chosen,
    FoldedNetworks,
    choose_regression,
    course_of,
    left_out_by_process,
)

RUNS, STATES, LATENT = 5, 4, 2
# A run and its image, five behind it, are left out together.
PART = torch.tensor([0, 1, 2, 0, 1] * 2)
TIME = torch.linspace(-1, 1, STATES)


def latents(values: Tensor | None = None, **changes: Any) -> Latents:
    """Runs and images with one parameter, whose latent vectors are linear in parameter and time unless given."""
    parameter = torch.cat([torch.linspace(-1, 1, RUNS), -torch.linspace(-1, 1, RUNS)])
    inputs = torch.stack([parameter[:, None].expand(-1, STATES), TIME.expand(2 * RUNS, -1)], dim=2)
    straight = torch.stack([inputs[..., 0] + inputs[..., 1], 2 * inputs[..., 0]], dim=2)
    whole = Latents(
        inputs, straight if values is None else values, torch.ones(2 * RUNS, STATES, dtype=torch.bool),
        torch.tensor([0.5, 0.25]), 0.01, PART, RUNS, time_column=1,
    )  # fmt: skip
    return replace(whole, **changes)


def level(coarse: int = 0, widths: tuple[int, ...] = (), **regressor: Any) -> Any:
    """What the choice needs of a level; its unit is 2 m."""
    torch.manual_seed(0)
    made = Regressor(2, LATENT, widths, "tanh", coarse=coarse, **regressor)
    return SimpleNamespace(regressor=made, at_rest=False, scale=2.0, course=None, process=None)


def steps(count: int) -> Callable[[Objective], Fit]:
    """Some steps on all samples; nothing chooses an epoch."""

    def train(objective: Objective) -> Fit:
        optimiser = torch.optim.Adam(objective.parameters(), lr=0.05)
        for _ in range(count):
            optimiser.zero_grad()
            objective(torch.arange(objective.size)).sum().backward()
            optimiser.step()
        return Fit()

    return train


def random_like(seed: int, shape: tuple[int, ...] = (2 * RUNS, STATES, LATENT)) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).standard_normal(shape).astype(np.float32))


@pytest.mark.parametrize("wish", ["network", "process", "mean"])
@pytest.mark.parametrize("residual", [False, True])
def test_what_is_said_without_a_fold_does_not_change_with_the_runs_it_leaves_out(wish: Any, residual: bool) -> None:
    below = random_like(1, (4, 2 * RUNS, STATES, 1))

    def said(values: Tensor) -> Tensor:
        of = level(coarse=1, widths=(4,), residual=residual, members=2)
        return choose_regression(of, latents(values, below=below), wish, steps(3), seed=0).said

    values = random_like(2)
    before = said(values)
    for fold in range(3):
        changed = values.clone()
        changed[fold == PART] += 3.0
        after = said(changed)
        torch.testing.assert_close(after[fold], before[fold], rtol=0, atol=0)
        others = [k for k in range(4) if k != fold]
        assert (after[others] - before[others]).abs().amax(dim=(1, 2, 3)).min() > 1e-2


def test_each_own_run_is_judged_by_the_fold_without_it() -> None:
    said = 100.0 * torch.arange(4)[:, None] + torch.arange(2 * RUNS)
    chosen = Chosen(said[..., None, None].expand(-1, -1, STATES, LATENT), 0.0, Fit())
    found = chosen.left_out(latents())
    assert found.shape == (RUNS, STATES, LATENT)
    assert found[:, 0, 0].tolist() == [0, 101, 202, 3, 104]


def test_validation_is_on_left_out_runs_as_computed_and_states_that_were() -> None:
    """By hand, from what each fold's networks say of the runs it leaves out; images and unknown states do not count."""
    known = torch.ones(2 * RUNS, STATES, dtype=torch.bool)
    known[1, 2:] = known[3, 3:] = False
    of, given = level(widths=(3,)), latents(random_like(3), known=known)
    objective = FoldedNetworks(of.regressor, courses(given), given, 2.0)
    assert objective.size == int(known.sum())
    squares = []
    for run in range(RUNS):
        wrong = objective.said(int(PART[run]), torch.tensor([run]))[0] - given.values[run]
        squares.append((wrong.square() * torch.tensor([0.25, 0.0625])).sum(dim=1)[known[run]])
    found = objective.validation()
    assert found is not None
    assert found.tolist() == pytest.approx([float(torch.cat(squares).mean()) + 0.01, 0.01])


def courses(given: Latents) -> list[Course]:
    return [course_of(given, fold, residual=False, at_rest=False) for fold in range(given.folds + 1)]


def test_the_loss_counts_each_sample_for_the_networks_that_may_see_it() -> None:
    of, given = level(), latents(random_like(4))
    objective = FoldedNetworks(of.regressor, courses(given), given, 2.0)
    gradient = []
    for run in range(2 * RUNS):
        objective.zero_grad()
        objective(torch.arange(STATES) + run * STATES)[0].backward()
        weight = objective.regressor.get_parameter("weight_0").grad
        assert weight is not None
        gradient.append((weight.abs().amax(dim=(1, 2)) > 0).tolist())
    assert gradient == [[fold != int(PART[run]) for fold in range(3)] + [True] for run in range(2 * RUNS)]


def test_the_course_is_the_mean_of_the_runs_that_train_and_grows_as_they_come_apart() -> None:
    given = latents(random_like(5))
    found = course_of(given, 1, residual=False, at_rest=True)
    mine = given.values[PART != 1]
    torch.testing.assert_close(found.mean, mine.mean(dim=0))
    apart = (((mine - mine.mean(dim=0)) * torch.tensor([0.5, 0.25])) ** 2).sum(dim=2).mean(dim=0).sqrt()
    grown = torch.cummax(apart, dim=0).values
    torch.testing.assert_close(found.growth, grown / grown[-1])
    torch.testing.assert_close(course_of(given, 3, residual=False, at_rest=False).mean, given.values.mean(dim=0))
    assert course_of(given, 3, residual=False, at_rest=False).growth.tolist() == [1.0] * STATES


def test_a_residual_course_is_what_the_runs_add_to_the_coarse_level_of_the_same_fold() -> None:
    below = random_like(6, (4, 2 * RUNS, STATES, 1))
    given = latents(random_like(7), below=below)
    found = course_of(given, 2, residual=True, at_rest=False)
    added = given.values.clone()
    added[..., :1] -= below[2]
    torch.testing.assert_close(found.mean, added[PART != 2].mean(dim=0))


@pytest.mark.parametrize("residual", [False, True])
def test_networks_of_a_fold_read_what_the_coarse_level_says_without_that_fold(residual: bool) -> None:
    below = random_like(11, (4, 2 * RUNS, STATES, 1))
    everyone = torch.arange(2 * RUNS)

    def said(below: Tensor) -> Tensor:
        of, given = level(coarse=1, widths=(3,), residual=residual), latents(below=below)
        torch.manual_seed(1)
        objective = FoldedNetworks(of.regressor, [Course.of(TIME, torch.zeros(STATES, LATENT), torch.ones(STATES))] * 4,
                                   given, 2.0)  # fmt: skip
        with torch.no_grad():  # else a residual network says nothing of its own
            for parameter in objective.parameters():
                parameter.uniform_(-1, 1)
        return torch.stack([objective.said(fold, everyone) for fold in range(4)])

    before = said(below)
    for fold in range(4):
        changed = below.clone()
        changed[fold] += 1.0
        moved = (said(changed) - before).abs().amax(dim=(1, 2, 3)) > 0
        assert moved.tolist() == [k == fold for k in range(4)]


def exact(objective: Objective) -> Fit:
    """Networks without hidden layers that say what is linear exactly: (p, 2 p), beside the mean course (t, 0)."""
    assert isinstance(objective, FoldedNetworks)
    with torch.no_grad():
        objective.regressor.get_parameter("weight_0").copy_(torch.tensor([[1.0, 2.0], [0.0, 0.0]]))
        objective.regressor.get_parameter("bias_0").zero_()
    return Fit(best_epoch=1)


def test_auto_takes_the_network_where_it_is_best_on_left_out_runs() -> None:
    of = level()
    chosen = choose_regression(of, latents(), "auto", exact, seed=0)
    assert chosen.share == 0.0
    assert chosen.told == "network"
    assert chosen.errors["network"] == pytest.approx(2.0 * np.sqrt(3 * 0.01), rel=1e-4)  # what decoding loses, in m
    assert chosen.errors["network"] == min(chosen.errors.values())
    assert list(chosen.errors) == ["network", "25 % process", "50 % process", "75 % process", "process"]
    assert of.process is None
    assert of.course is not None


def test_the_networks_of_all_runs_are_the_ones_kept() -> None:
    of, given = level(widths=(4,), members=2), latents(random_like(8))
    chosen = choose_regression(of, given, "network", steps(2), seed=0)
    course = of.course(given.inputs[3, :, 1])
    torch.testing.assert_close(of.regressor(given.inputs[3], None, course), chosen.said[-1, 3])


def test_auto_takes_the_process_where_the_network_has_learnt_nothing() -> None:
    of = level()
    chosen = choose_regression(of, latents(), "auto", lambda _: Fit(), seed=0)
    assert chosen.told == "process"
    assert chosen.errors["process"] < 0.9 * chosen.errors["network"]
    assert of.course is None
    assert float(of.process.share) == 1.0
    torch.testing.assert_close(of.process(latents().inputs[1]), chosen.said[-1, 1], rtol=1e-4, atol=1e-4)


def test_of_equal_choices_the_network_is_taken() -> None:
    of = level()
    chosen = choose_regression(of, latents(sizes=torch.zeros(LATENT)), "auto", lambda _: Fit(), seed=0)
    assert len(set(chosen.errors.values())) == 1
    assert chosen.told == "network"


def test_a_mean_is_half_of_each_and_never_chosen() -> None:
    of = level()
    chosen = choose_regression(of, latents(), "mean", exact, seed=0)
    network = choose_regression(level(), latents(), "network", exact, seed=0).said
    process = choose_regression(level(), latents(), "process", exact, seed=0).said
    torch.testing.assert_close(chosen.said, (network + process) / 2)
    assert chosen.told == "50 % process"
    assert float(of.process.share) == 0.5
    assert of.course is not None


def test_the_error_is_the_root_mean_square_distance_averaged_over_known_states_of_own_runs() -> None:
    known = torch.ones(2 * RUNS, STATES, dtype=torch.bool)
    known[2, 1:] = False
    given = latents(random_like(9), known=known)
    chosen = choose_regression(level(), given, "process", steps(0), seed=0)
    wrong = (chosen.left_out(given) - given.values[:RUNS]).numpy() * [0.5, 0.25]
    distance = 2.0 * np.sqrt(3 * (np.square(wrong).sum(axis=2) + 0.01))
    assert chosen.errors == {"process": pytest.approx(distance[known[:RUNS].numpy()].mean(), rel=1e-5)}


def test_left_out_runs_are_said_by_a_process_fitted_without_them() -> None:
    given = latents(random_like(10))
    found = left_out_by_process(given, seed=0)
    assert found is not None
    train = (PART != 1).numpy()
    x, y = given.inputs[train, 0, :1].double().numpy(), given.values[train].double().numpy()
    machine = Gaussian(x).fit((y * [0.5, 0.25]).reshape(len(y), -1), 0)
    expected = machine.weights(given.inputs[[4], 0, :1].double().numpy()) @ y.reshape(len(y), -1)
    np.testing.assert_allclose(found[4].ravel(), expected[0], rtol=1e-4, atol=1e-5)


def diverging(_: Objective) -> Fit:
    error = Diverged("MH1: the loss is not finite in epoch 1")
    error.fit = Fit(status="diverged")
    raise error


def test_where_the_network_diverges_auto_falls_back_on_the_process_and_says_so() -> None:
    of = level()
    chosen = choose_regression(of, latents(), "auto", diverging, seed=0)
    assert (chosen.told, list(chosen.errors), chosen.fit.status) == ("process", ["process"], "diverged")
    assert chosen.notes == ["MH1: the loss is not finite in epoch 1; the process alone is used"]
    assert of.process is not None
    assert of.course is None


@pytest.mark.parametrize("wish", ["network", "mean"])
def test_where_the_network_diverges_and_is_asked_for_that_is_an_error(wish: Any) -> None:
    of = level()
    with pytest.raises(Diverged) as caught:
        choose_regression(of, latents(), wish, diverging, seed=0)
    assert caught.value.fit is None  # there is no regression to keep
    assert of.process is None


@pytest.mark.parametrize("wish", ["process", "mean", "auto"])
def test_runs_that_agree_in_all_parameters_leave_the_network_alone(wish: Any) -> None:
    inputs = latents().inputs.clone()
    inputs[..., 0] = 0.0
    of = level()
    chosen = choose_regression(of, latents(inputs=inputs), wish, steps(1), seed=0)
    assert list(chosen.errors) == ["network"]
    assert of.process is None
    assert left_out_by_process(latents(inputs=inputs), seed=0) is None
    with pytest.raises(Diverged):
        choose_regression(of, latents(inputs=inputs), wish, diverging, seed=0)


@pytest.mark.parametrize(("tried", "trained"), [(lambda _: Fit(), 0), (None, 1)])
def test_a_network_far_from_the_process_after_its_trial_is_trained_no_further(tried, trained: int) -> None:
    whole: list[object] = []

    def train(objective: object) -> Fit:
        whole.append(objective)
        return exact(objective)

    chosen = choose_regression(level(), latents(), "auto", train, seed=0, trial=tried or exact)
    assert len(whole) == trained
    assert chosen.told == ("network" if trained else "process")
    assert bool(chosen.notes) == (not trained)
