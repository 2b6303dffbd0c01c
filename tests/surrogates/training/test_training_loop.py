"""The training loop on a problem small enough to know: best weights, resuming, divergence, Ctrl-C."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import plate
import pytest
import torch
from torch import Tensor, nn

from surrogates.errors import SurrogateError
from surrogates.record import Fit
from surrogates.settings import LevelSettings, settings
from surrogates.training import loop
from surrogates.training.best import BestWeights
from surrogates.training.checkpoints import Checkpoints
from surrogates.training.loop import Diverged, Epoch, Objective, device_of, fit, learning_rates, set_up
from surrogates.training.objectives import pieces
from surrogates.training.train import train_surrogate

SETTINGS = LevelSettings(epochs=12, batch=8, learning_rate=0.05, schedule="one_cycle")


class Line(Objective):
    """y = a x + b on 32 samples; validation is another line, so that more training is not always better there."""

    def __init__(self, validated: bool = True, spoil: int | None = None) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.line = nn.Linear(1, 1)
        self.x = torch.linspace(-1, 1, 32)[:, None]
        self.y = 2 * self.x + 1
        self.size = 32
        self.validated, self.spoil, self.steps = validated, spoil, 0

    def networks(self) -> dict[str, nn.Module]:
        return {"line": self.line}

    def forward(self, index: Tensor) -> Tensor:
        self.steps += 1
        wrong = (self.line(self.x[index]) - self.y[index]).square().mean()
        if self.spoil is not None and self.steps > self.spoil:
            wrong = wrong * math.nan
        return torch.stack([wrong, 0.5 * wrong])

    def validation(self) -> Tensor | None:
        if not self.validated:
            return None
        wrong = (self.line(self.x) - (self.x + 1)).square().mean()
        return torch.stack([wrong, 0.5 * wrong])


def trained(objective: Line, **more: object) -> Fit:
    return fit(objective, SETTINGS, name="MH1", seed=3, **more)  # type: ignore[arg-type]


def weights(objective: Line) -> list[float]:
    return [float(p.detach()) for p in objective.parameters()]


def test_the_same_seed_gives_the_same_weights() -> None:
    first, second = Line(), Line()
    assert trained(first).history == trained(second).history
    assert weights(first) == weights(second)


def test_another_seed_takes_other_batches() -> None:
    first, second = Line(), Line()
    trained(first)
    fit(second, SETTINGS, name="MH1", seed=4)
    assert weights(first) != weights(second)


def test_the_weights_of_the_best_validation_epoch_stay() -> None:
    objective = Line()
    seen: list[list[float]] = []
    done = trained(objective, report=lambda epoch: seen.append(weights(objective)))
    curve = done.history["validation_total"]
    assert done.best_epoch == int(np.argmin(curve)) + 1
    assert done.best_epoch < SETTINGS.epochs
    assert weights(objective) == seen[done.best_epoch - 1]


def test_without_validation_the_training_loss_chooses() -> None:
    done = trained(Line(validated=False))
    assert done.best == min(done.history["total"])
    assert "validation_total" not in done.history


def test_the_total_is_the_weighted_sum_of_the_parts() -> None:
    changed = SETTINGS.model_copy(update={"weight_approximation": 3.0, "weight_reconstruction": 2.0})
    history = fit(Line(), changed, name="MH1", seed=0).history
    expected = 3 * np.array(history["approximation"]) + 2 * np.array(history["reconstruction"])
    np.testing.assert_allclose(history["total"], expected, rtol=1e-6)


def test_every_epoch_is_told() -> None:
    told: list[Epoch] = []
    trained(Line(), report=told.append)
    assert [t.epoch for t in told] == list(range(1, 13))
    assert told[-1].seconds_left == 0
    assert told[0].name == "MH1"


class Stop(Exception):
    """The process is killed."""


def test_killed_and_resumed_training_gives_the_same_weights(tmp_path: Path) -> None:
    whole = Line()
    expected = trained(whole)

    def kill(epoch: Epoch) -> None:
        if epoch.epoch == 8:
            raise Stop

    campaign, chosen = plate.campaign(4), settings("mh")
    with pytest.raises(Stop):
        trained(Line(), report=kill, keeper=Checkpoints(tmp_path / "state", chosen, campaign, every=3))
    resumed = Line()
    done = trained(resumed, keeper=Checkpoints(tmp_path / "state", chosen, campaign, every=3, resume=True))
    assert weights(resumed) == weights(whole)
    assert done.history == expected.history
    assert resumed.steps == 6 * 4  # epochs 7 to 12


def test_resuming_another_training_is_refused(tmp_path: Path) -> None:
    campaign = plate.campaign(4)
    Checkpoints(tmp_path / "state", settings("mh"), campaign)
    with pytest.raises(SurrogateError, match="belongs to a training with other settings"):
        Checkpoints(tmp_path / "state", settings("mh", overrides=["seed=9"]), campaign, resume=True)


def test_resuming_on_another_hierarchy_of_the_same_size_is_refused(tmp_path: Path) -> None:
    campaign = plate.campaign(4)
    Checkpoints(tmp_path / "state", settings("mh"), campaign)
    fine, coarse = campaign.levels
    other = replace(campaign, levels=(fine, replace(coarse, kept=coarse.kept[::-1])))
    with pytest.raises(SurrogateError, match="belongs to a training with other mesh hierarchy"):
        Checkpoints(tmp_path / "state", settings("mh"), other, resume=True)


def test_resuming_without_anything_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SurrogateError, match="holds no training to go on from"):
        Checkpoints(tmp_path / "nothing", settings("mh"), plate.campaign(4), resume=True)


def test_divergence_names_level_and_epoch_and_keeps_the_best_weights() -> None:
    objective = Line(spoil=5 * 4)
    seen: list[list[float]] = []
    with pytest.raises(
        Diverged, match=r"MH1: the loss is not finite in epoch 6; the weights of epoch \d are kept"
    ) as caught:
        trained(objective, report=lambda epoch: seen.append(weights(objective)))
    done = caught.value.fit
    assert done is not None
    assert done.status == "diverged"
    assert weights(objective) == seen[done.best_epoch - 1]


def test_divergence_in_the_first_epoch_keeps_nothing() -> None:
    with pytest.raises(Diverged, match="no epoch ended well"):
        trained(Line(spoil=0))


def test_ctrl_c_ends_with_the_best_weights_so_far() -> None:
    def press(epoch: Epoch) -> None:
        if epoch.epoch == 4:
            raise KeyboardInterrupt

    objective = Line()
    done = trained(objective, report=press)
    assert done.status == "interrupted"
    assert done.epochs == 4
    assert all(map(math.isfinite, weights(objective)))


def test_rates_rise_and_fall_once() -> None:
    rates = learning_rates(SETTINGS, 100)
    assert rates[0] == pytest.approx(0.005)
    assert rates.argmax() == 10
    assert rates.max() == pytest.approx(0.05)
    assert rates[-1] == pytest.approx(5e-5)
    assert (np.diff(rates[:10]) > 0).all()
    assert (np.diff(rates[10:]) < 0).all()


def test_a_constant_rate_is_constant() -> None:
    assert set(learning_rates(LevelSettings(learning_rate=1e-3), 7)) == {1e-3}


def test_a_device_that_is_not_there_is_refused() -> None:
    with pytest.raises(SurrogateError, match="device 'tpu' is not known; choose cpu, cuda, mps or auto"):
        device_of("tpu")


@pytest.mark.parametrize("model", ["mh", "aenn"])
def test_the_error_told_is_the_distance_of_validation_nodes_in_metres(model: str) -> None:
    told: list[Epoch] = []
    campaign = plate.campaign(10)
    surrogate = train_surrogate(
        campaign,
        settings(model, overrides=["level.epochs=1", "level.regression=network", "level.hidden=[9]"]),
        report=told.append,
    )
    validation = [campaign.runs.index(name) for name in surrogate.record.validation_runs]
    for epoch, number in zip(told, surrogate.level_names.values(), strict=True):
        truth = campaign.displacement(number)[validation]
        wrong = surrogate.predict(campaign.parameters[validation], campaign.time, number) - truth
        expected = np.sqrt(np.square(wrong).sum(axis=-1).mean())
        assert epoch.validation_error == pytest.approx(expected, rel=1e-3)
        assert epoch.best_error == epoch.validation_error


# Which samples, and how fast


class Recorder(Objective):
    """Notes the samples of every batch; one weight, whose gradient is 1 for approximation and 10 for reconstruction."""

    def __init__(self, size: int = 10) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(()))
        self.size, self.batches = size, []

    def networks(self) -> dict[str, nn.Module]:
        return {"all": self}

    def forward(self, index: Tensor) -> Tensor:
        self.batches.append(index.tolist())
        return torch.stack([self.weight, 10 * self.weight])

    def validation(self) -> Tensor | None:
        return None


def plain(**changes: object) -> LevelSettings:
    return LevelSettings(**{"epochs": 1, "batch": 100, "learning_rate": 0.5, "optimiser": "sgd", **changes})  # type: ignore[arg-type]


def test_an_epoch_takes_whole_batches_each_sample_once_and_leaves_out_others_each_time() -> None:
    objective = Recorder(10)
    fit(objective, plain(batch=4, epochs=20), name="x", seed=0)
    assert {len(b) for b in objective.batches} == {4}
    epochs = [objective.batches[2 * k] + objective.batches[2 * k + 1] for k in range(20)]
    assert len(objective.batches) == 40
    assert all(len(set(epoch)) == 8 for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) == 20
    assert set().union(*epochs) == set(range(10))


def test_an_epoch_of_a_share_takes_other_states_each_time() -> None:
    objective = Recorder(20)
    fit(objective, plain(batch=4, epochs=6, states=0.4), name="MH1", seed=0)
    epochs = np.array(objective.batches).reshape(6, 8)
    assert all(len(set(epoch)) == 8 for epoch in epochs.tolist())
    assert len(set(epochs.ravel().tolist())) > 16


def test_the_order_follows_from_seed_and_epoch_alone() -> None:
    first, second, other = Recorder(), Recorder(), Recorder()
    fit(first, plain(batch=3, epochs=4), name="x", seed=5)
    torch.manual_seed(99)
    fit(second, plain(batch=3, epochs=4), name="x", seed=5)
    fit(other, plain(batch=3, epochs=4), name="x", seed=6)
    assert first.batches == second.batches != other.batches


def test_a_batch_larger_than_the_samples_is_all_of_them() -> None:
    objective = Recorder(10)
    fit(objective, plain(batch=64, epochs=2), name="x", seed=0)
    assert [sorted(b) for b in objective.batches] == [list(range(10))] * 2


@pytest.mark.parametrize(
    ("approximation", "reconstruction", "gradient"), [(1.0, 0.0, 1.0), (0.0, 1.0, 10.0), (2.0, 0.5, 7.0)]
)
def test_the_losses_are_weighted_in_the_step_as_well(
    approximation: float, reconstruction: float, gradient: float
) -> None:
    objective = Recorder()
    chosen = plain(weight_approximation=approximation, weight_reconstruction=reconstruction)
    fit(objective, chosen, name="x", seed=0)
    assert float(objective.weight.detach()) == pytest.approx(-0.5 * gradient)


def test_a_batch_in_pieces_learns_what_the_whole_one_does() -> None:
    """Pieces of 3, 3 and 2 samples: each counts by its size."""
    whole, cut = Line(), Line()
    cut.pieces = lambda batch: 3  # type: ignore[method-assign]
    history = trained(whole).history
    np.testing.assert_allclose(trained(cut).history["total"], history["total"], rtol=1e-5)
    np.testing.assert_allclose(weights(cut), weights(whole), rtol=1e-5)


def test_a_batch_is_never_cut_into_more_pieces_than_samples() -> None:
    assert pieces(64, 1000) == 1
    assert pieces(64, 100_000) == 25
    assert pieces(4, 10_000_000) == 4


@pytest.mark.parametrize("in_memory", [0, 1 << 20])
def test_the_best_weights_come_back_from_memory_and_from_a_file(in_memory: int) -> None:
    line = Line()
    live = {name: p.detach() for name, p in line.named_parameters()}
    best = BestWeights(live, in_memory)
    best.restore()  # nothing is kept yet
    assert (bool(best), best.tensors()) == (False, {})
    for value in (1.0, 2.0):
        for tensor in live.values():
            tensor.fill_(value)
        best.keep()
    for tensor in live.values():
        tensor.fill_(3.0)
    assert {float(t.max()) for t in best.tensors().values()} == {2.0}
    best.restore()
    assert {float(t.min()) for t in live.values()} == {2.0}
    best.keep(lambda name: torch.full_like(live[name], 5.0))
    assert {float(t.min()) for t in live.values()} == {2.0}
    best.restore()
    assert {float(t.min()) for t in live.values()} == {5.0}


@pytest.mark.parametrize(("clip", "step"), [(0.0, 11.0), (2.0, 2.0), (20.0, 11.0)])
def test_gradients_are_clipped_to_the_length_asked_for(clip: float, step: float) -> None:
    objective = Recorder()
    fit(objective, plain(clip=clip), name="x", seed=0)
    assert float(objective.weight.detach()) == pytest.approx(-0.5 * step, rel=1e-4)


class Layers(Objective):
    """Layers that sum over different numbers of inputs; every weight has the gradient 1."""

    def __init__(self) -> None:
        super().__init__()
        self.decoder = nn.Linear(40, 3)
        self.regressor = nn.Linear(80, 3)
        self.encode_matrix = nn.Parameter(torch.zeros(20, 5))
        self.small = nn.Linear(4, 2)
        self.frozen = nn.Linear(2, 2).requires_grad_(False)
        self.size = 4

    def networks(self) -> dict[str, nn.Module]:
        return {"all": self}

    def forward(self, index: Tensor) -> Tensor:
        total = sum(p.sum() for p in self.parameters())
        return torch.stack([total, 0 * total])

    def validation(self) -> Tensor | None:
        return None


@pytest.mark.parametrize("optimiser", ["sgd", "adam", "adamw"])
@pytest.mark.parametrize(("rate_inputs", "decoder", "encoder"), [(0, 1.0, 1.0), (10, 0.25, 0.5), (30, 0.75, 1.0)])
def test_layers_that_sum_over_more_than_rate_inputs_learn_slower_in_proportion(
    optimiser: str, rate_inputs: int, decoder: float, encoder: float
) -> None:
    """In the first step of all optimisers a weight moves by its rate, since every gradient is 1."""
    objective = Layers()
    before = {name: p.detach().clone() for name, p in objective.named_parameters()}
    fit(objective, plain(rate_inputs=rate_inputs, optimiser=optimiser), name="x", seed=0)
    moved = {name: (before[name] - p.detach()) / 0.5 for name, p in objective.named_parameters()}
    expected = {
        "decoder.weight": decoder, "decoder.bias": 1.0, "regressor.weight": 1.0, "regressor.bias": 1.0,
        "encode_matrix": encoder, "small.weight": 1.0, "small.bias": 1.0, "frozen.weight": 0.0, "frozen.bias": 0.0,
    }  # fmt: skip
    for name, factor in expected.items():
        np.testing.assert_allclose(moved[name], factor, atol=1e-5, err_msg=name)


@pytest.mark.parametrize(("optimiser", "step"), [("sgd", 0.1), ("adamw", 0.1)])
def test_weight_decay_pulls_towards_zero(optimiser: str, step: float) -> None:
    objective = Recorder()
    with torch.no_grad():
        objective.weight.fill_(4.0)
    chosen = plain(weight_decay=0.05, optimiser=optimiser, weight_approximation=0.0, weight_reconstruction=0.0)
    fit(objective, chosen, name="x", seed=0)
    assert float(objective.weight.detach()) == pytest.approx(4.0 - step, rel=1e-4)


def test_adam_decays_by_the_gradient_and_adamw_beside_it() -> None:
    """Adam's first step is the rate whatever the gradient's size; decay through the gradient is such a step."""
    found = {}
    for optimiser in ("adam", "adamw"):
        objective = Recorder()
        with torch.no_grad():
            objective.weight.fill_(4.0)
        chosen = plain(weight_decay=0.05, optimiser=optimiser, weight_approximation=0.0, weight_reconstruction=0.0)
        fit(objective, chosen, name="x", seed=0)
        found[optimiser] = float(objective.weight.detach())
    assert found["adam"] == pytest.approx(3.5, rel=1e-4)
    assert found["adamw"] == pytest.approx(3.9, rel=1e-4)


def test_sgd_has_a_momentum_of_nine_tenths() -> None:
    objective = Recorder()
    fit(objective, plain(epochs=2, weight_reconstruction=0.0), name="x", seed=0)
    assert float(objective.weight.detach()) == pytest.approx(-0.5 * (1 + 1.9))


def test_each_step_has_its_rate_and_the_last_of_an_epoch_is_kept() -> None:
    objective = Recorder(8)
    chosen = plain(epochs=3, batch=4, schedule="cosine", weight_reconstruction=0.0)
    done = fit(objective, chosen, name="x", seed=0)
    rates = learning_rates(chosen, 6)
    assert done.history["learning_rate"] == pytest.approx(rates[1::2])


def test_a_cosine_falls_from_the_top_to_a_thousandth() -> None:
    rates = learning_rates(LevelSettings(learning_rate=2.0, schedule="cosine"), 5)
    middle = 0.002 + (2.0 - 0.002) / 2
    assert rates.tolist() == pytest.approx(
        [2.0, 0.002 + 1.998 * (1 + math.sqrt(0.5)) / 2, middle, 0.002 + 1.998 * (1 - math.sqrt(0.5)) / 2, 0.002]
    )


@pytest.mark.parametrize("steps", [1, 2, 5, 10, 11, 30])
def test_one_cycle_rises_over_a_tenth_from_a_tenth(steps: int) -> None:
    rates = learning_rates(LevelSettings(learning_rate=2.0, schedule="one_cycle"), steps)
    rise = max(1, steps // 10)
    assert len(rates) == steps
    assert rates[:rise].tolist() == pytest.approx([0.2 + 1.8 * k / rise for k in range(rise)])
    if steps > rise:
        assert rates[rise] == pytest.approx(2.0)
    if steps > rise + 1:
        assert rates[-1] == pytest.approx(0.002)


# What is told and kept


class Judged(Recorder):
    """Validation losses as given, epoch by epoch."""

    def __init__(self, losses: list[float]) -> None:
        super().__init__()
        self.losses = iter(losses)

    @property
    def scale(self) -> float:
        return 0.5

    def validation(self) -> Tensor | None:
        loss = next(self.losses)
        return torch.tensor([loss, 7.0])


def test_the_report_of_an_epoch() -> None:
    told: list[Epoch] = []
    done = fit(Judged([3.0, 0.75, 12.0]), plain(epochs=3, schedule="cosine"), name="MH2", seed=0, report=told.append)
    assert [e.validation for e in told] == [10.0, 7.75, 19.0]
    # Losses are mean squares of a component over the scale: a node has three, so sqrt(3 * loss) * scale is its distance.
    assert [e.validation_error for e in told] == pytest.approx([1.5, 0.75, 3.0])
    assert [e.best_error for e in told] == pytest.approx([1.5, 0.75, 0.75])
    assert [e.best_epoch for e in told] == [1, 2, 2]
    assert [(e.name, e.epoch, e.epochs) for e in told] == [("MH2", k, 3) for k in (1, 2, 3)]
    assert [e.learning_rate for e in told] == done.history["learning_rate"]
    for e in told:
        assert e.total == pytest.approx(e.approximation + e.reconstruction)
        assert e.reconstruction == pytest.approx(10 * e.approximation)
    assert told[0].seconds_left == pytest.approx(2 / told[0].rate)
    assert told[1].seconds_left == pytest.approx(1 / told[1].rate)
    assert done.seconds == pytest.approx(3 / told[2].rate)
    assert (done.best, done.best_epoch, done.epochs) == (7.75, 2, 3)


def test_without_validation_its_errors_are_unknown() -> None:
    told: list[Epoch] = []
    fit(Recorder(), plain(epochs=2), name="x", seed=0, report=told.append)
    assert all(math.isnan(v) for e in told for v in (e.validation, e.validation_error, e.best_error))


def test_of_equal_epochs_the_first_is_kept() -> None:
    assert fit(Judged([1.0, 1.0, 1.0]), plain(epochs=3), name="x", seed=0).best_epoch == 1


class Shelf:
    """Keeps what is given to it; due every second epoch."""

    def __init__(self, stored: tuple[dict[str, Tensor], dict] | None = None) -> None:
        self.stored, self.saved = stored, []

    def load(self, name: str) -> tuple[dict[str, Tensor], dict] | None:
        assert name == "MH1"
        return self.stored

    def due(self, epoch: int) -> bool:
        return epoch % 2 == 0

    def save(self, name: str, tensors: dict[str, Tensor], about: dict) -> None:
        assert name == "MH1"
        copied = {k: v.clone() for k, v in tensors.items()}
        self.saved.append((copied, {**about, "history": {k: list(v) for k, v in about["history"].items()}}))


def test_the_state_is_kept_when_due_and_at_the_end() -> None:
    shelf = Shelf()
    fit(Line(), SETTINGS.model_copy(update={"epochs": 5}), name="MH1", seed=3, keeper=shelf)
    assert [len(about["history"]["total"]) for _, about in shelf.saved] == [2, 4, 5]
    tensors, about = shelf.saved[-1]
    assert {"now.line.weight", "now.line.bias", "best.line.weight", "best.line.bias"} <= tensors.keys()
    assert {k for k in tensors if k.startswith("optimiser.0.")} == {
        f"optimiser.0.{k}" for k in ("step", "exp_avg", "exp_avg_sq")
    }
    assert about.keys() == {"history", "best_epoch", "best", "seconds"}


def test_a_stored_training_goes_on_with_its_best_weights_times_and_momentum() -> None:
    whole, shelf = Line(), Shelf()
    expected = fit(whole, SETTINGS, name="MH1", seed=3, keeper=shelf)
    tensors, about = shelf.saved[3]
    assert len(about["history"]["total"]) == 8
    resumed = Line()
    done = fit(resumed, SETTINGS, name="MH1", seed=3, keeper=Shelf((tensors, {**about, "seconds": 100.0})))
    assert weights(resumed) == weights(whole)
    assert (done.history, done.best_epoch, done.best) == (expected.history, expected.best_epoch, expected.best)
    assert 100.0 < done.seconds < 110.0


def test_a_training_that_was_finished_takes_no_step_and_gives_its_best_weights() -> None:
    whole, shelf = Line(), Shelf()
    fit(whole, SETTINGS, name="MH1", seed=3, keeper=shelf)
    again = Line()
    done = fit(again, SETTINGS, name="MH1", seed=3, keeper=Shelf(shelf.saved[-1]))
    assert again.steps == 0
    assert weights(again) == weights(whole)
    assert done.epochs == SETTINGS.epochs


# Patience


BETTER_UNTIL_TWO = [3.0, 1.0, *[2.0] * 8]


@pytest.mark.parametrize(
    ("losses", "patience", "epochs"),
    [
        (BETTER_UNTIL_TWO, 0.3, 5),
        (BETTER_UNTIL_TWO, 0.25, 5),  # a part of an epoch is a whole one
        (BETTER_UNTIL_TWO, 0.1, 3),
        ([1.0] * 10, 0.5, 6),  # the same is no better
        ([3.0, 2.0, 2.0, 1.0, *[2.0] * 6], 0.3, 7),  # counted from the best one
        (BETTER_UNTIL_TWO, 0.0, 10),
        (BETTER_UNTIL_TWO, 1.0, 10),
        ([float(10 - k) for k in range(10)], 0.1, 10),
    ],
)
def test_a_training_ends_when_a_share_of_its_epochs_brought_nothing_on_runs_left_out(
    losses: list[float], patience: float, epochs: int
) -> None:
    done = fit(Judged(losses), plain(epochs=10, patience=patience), name="x", seed=0)
    assert done.epochs == len(done.history["total"]) == epochs
    assert done.best_epoch == int(np.argmin(losses)) + 1


def test_without_runs_left_out_patience_ends_nothing() -> None:
    chosen = plain(epochs=10, patience=0.1, weight_approximation=0.0, weight_reconstruction=0.0)
    done = fit(Recorder(), chosen, name="x", seed=0)
    assert (done.epochs, done.best_epoch) == (10, 1)


def test_a_training_that_patience_ended_is_kept_and_not_taken_up_again() -> None:
    shelf, chosen = Shelf(), plain(epochs=10, patience=0.3)
    done = fit(Judged(BETTER_UNTIL_TWO), chosen, name="MH1", seed=0, keeper=shelf)
    assert [len(about["history"]["total"]) for _, about in shelf.saved] == [2, 4, 5]
    again = Judged([])
    resumed = fit(again, chosen, name="MH1", seed=0, keeper=Shelf(shelf.saved[-1]))
    assert again.batches == []
    assert (resumed.history, resumed.best_epoch) == (done.history, done.best_epoch)


def test_ctrl_c_before_the_first_epoch_is_done_is_passed_on() -> None:
    class Pressed(Recorder):
        def forward(self, index: Tensor) -> Tensor:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(Pressed(), plain(), name="x", seed=0)


def test_divergence_tells_what_to_do_and_keeps_the_curves_until_then() -> None:
    with pytest.raises(
        Diverged, match=r"epoch 3; the weights of epoch 2 are kept.*learning_rate.*level.clip=1"
    ) as caught:
        fit(Judged([3.0, 2.0, math.inf]), plain(epochs=5), name="x", seed=0)
    done = caught.value.fit
    assert done is not None
    assert (done.status, done.epochs, done.best_epoch) == ("diverged", 2, 2)
    assert done.seconds > 0


# Several processes


def test_processes_share_every_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    alone = [batch.tolist() for batch, _ in loop._Plan(10, plain(batch=4, epochs=3), 3, torch.device("cpu")).batches(2)]
    shares = []
    for rank in (0, 1):
        monkeypatch.setattr(loop, "_rank_and_size", lambda rank=rank: (rank, 2))
        plan = loop._Plan(10, plain(batch=4, epochs=3), 3, torch.device("cpu"))
        assert (plan.rank, plan.processes) == (rank, 2)
        shares.append([batch.tolist() for batch, _ in plan.batches(2)])
    assert [a + b for a, b in zip(*shares, strict=True)] == alone
    with pytest.raises(SurrogateError, match="a batch of 5 samples cannot be shared by 2 processes"):
        loop._Plan(10, plain(batch=5), 3, torch.device("cpu"))


@pytest.fixture
def one_process():  # type: ignore[no-untyped-def]
    """A process group of this process alone."""
    torch.distributed.init_process_group("gloo", store=torch.distributed.HashStore(), rank=0, world_size=1)
    yield
    torch.distributed.destroy_process_group()


def test_a_group_of_one_process_trains_as_without(one_process: None) -> None:
    alone, grouped = Line(), Line()
    found = trained(grouped)
    torch.distributed.destroy_process_group()
    expected = trained(alone)
    torch.distributed.init_process_group("gloo", store=torch.distributed.HashStore(), rank=0, world_size=1)
    np.testing.assert_allclose(weights(grouped), weights(alone), rtol=1e-5)
    np.testing.assert_allclose(found.history["total"], expected.history["total"], rtol=1e-5)


def test_losses_are_averaged_over_processes(one_process: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.distributed, "all_reduce", lambda t: t.mul_(3.0) if t is not None else None)
    monkeypatch.setattr(torch.distributed, "get_world_size", lambda: 2)
    found = loop._measured(Recorder(), torch.tensor([2.0, 4.0]), torch.tensor([1.0, 0.5]))
    assert found == {"total": 6.0, "approximation": 3.0, "reconstruction": 6.0}


def test_only_the_first_process_reports_and_keeps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "_rank_and_size", lambda: (1, 2))
    told: list[Epoch] = []
    shelf = Shelf()
    fit(Line(), SETTINGS, name="MH1", seed=3, report=told.append, keeper=shelf)
    assert (told, shelf.saved) == ([], [])


# Devices and precision


def test_the_best_device_there_is_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    for cuda, mps, best in ((True, True, "cuda"), (False, True, "mps"), (False, False, "cpu")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda cuda=cuda: cuda)
        monkeypatch.setattr(torch.backends.mps, "is_available", lambda mps=mps: mps)
        assert device_of("auto") == torch.device(best)
    assert device_of("cpu") == torch.device("cpu")
    with pytest.raises(SurrogateError, match=r"device 'cuda:1' is not there; this machine has cpu$"):
        device_of("cuda:1")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert device_of("cuda:1") == torch.device("cuda:1")


def test_each_process_has_its_gpu(one_process: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    monkeypatch.setattr(torch.distributed, "get_rank", lambda: 6)
    assert device_of("cuda") == torch.device("cuda:2")
    assert device_of("cuda:1") == torch.device("cuda:1")


@pytest.mark.parametrize(("precision", "products"), [("float32", "highest"), ("tf32", "high"), ("bfloat16", "high")])
def test_set_up_seeds_and_chooses_the_precision_of_products(precision: str, products: str) -> None:
    before = torch.get_float32_matmul_precision()
    try:
        set_up(5, precision)
        assert torch.get_float32_matmul_precision() == products
        assert torch.equal(torch.rand(2), torch.rand(2, generator=torch.Generator().manual_seed(5)))
    finally:
        torch.set_float32_matmul_precision(before)


@pytest.mark.parametrize(
    ("precision", "kind"), [("float32", torch.float32), ("tf32", torch.float32), ("bfloat16", torch.bfloat16)]
)
def test_bfloat16_is_that_of_products_alone(precision: str, kind: torch.dtype) -> None:
    seen = []

    class Product(Line):
        def forward(self, index: Tensor) -> Tensor:
            seen.append(self.line(self.x[index]).dtype)
            return super().forward(index).float()

    objective = Product()
    fit(objective, SETTINGS.model_copy(update={"epochs": 1}), name="x", seed=0, precision=precision)
    assert set(seen) == {kind}
    assert objective.line.weight.dtype == torch.float32


def test_the_step_that_is_captured_on_a_gpu_goes_the_same_way_on_the_cpu() -> None:
    eager, captured = Line(), Line()
    first, second = trained(eager), trained(captured, captured=True)
    assert weights(eager) == pytest.approx(weights(captured), rel=1e-6)
    assert first.history["total"] == pytest.approx(second.history["total"], rel=1e-6)


def test_steps_are_captured_where_all_they_read_lies_on_a_cuda_device(monkeypatch: pytest.MonkeyPatch) -> None:
    def kind(device: str, captured: bool | None = None, **changes: object) -> type:
        own = SETTINGS.model_copy(update=changes)
        return loop._kind_of_step(Line(), own, "float32", captured, torch.device(device))

    monkeypatch.setattr(Line, "in_place", True)
    assert kind("cuda") is loop.CapturedStep
    assert kind("cuda", False) is kind("cpu") is loop._Step
    assert kind("cuda", optimiser="sgd") is loop._Step
    monkeypatch.setattr(Line, "in_place", False)
    assert kind("cuda") is loop._Step


def test_what_cannot_be_captured_goes_on_call_by_call(monkeypatch: pytest.MonkeyPatch, caplog: Any) -> None:
    class Refusing(loop.CapturedStep):
        _BEFORE = 0

        def __init__(self, *given: Any) -> None:
            super().__init__(*given)
            self.cuda = True

        def _recorded(self) -> Any:
            raise RuntimeError("no copies while recording")

    eager, refused = Line(), Line()
    trained(eager)
    monkeypatch.setattr(loop, "CapturedStep", Refusing)
    trained(refused, captured=True)
    assert weights(refused) == pytest.approx(weights(eager), rel=1e-6)
    assert [r.message for r in caplog.records if "one by one" in r.message] == [
        "the device takes the calls of a step one by one, which is slower (no copies while recording)"
    ]


def test_a_batch_cut_into_pieces_gives_the_gradient_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    whole, cut = Line(), Line()
    trained(whole)
    monkeypatch.setattr(Line, "pieces", lambda self, batch: 3)
    trained(cut)
    assert cut.steps == 3 * whole.steps
    assert weights(whole) == pytest.approx(weights(cut), rel=1e-5)
