"""The training loop on a problem small enough to know: best weights, resuming, divergence, Ctrl-C."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import plate
import pytest
import torch
from torch import Tensor, nn

from surrogates.errors import SurrogateError
from surrogates.record import Fit
from surrogates.settings import LevelSettings, settings
from surrogates.training.checkpoints import Checkpoints
from surrogates.training.loop import Diverged, Epoch, Objective, device_of, fit, learning_rates
from surrogates.training.train import train

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


@pytest.mark.parametrize("model", ["mh", "podnn"])
def test_the_error_told_is_the_distance_of_validation_nodes_in_metres(model: str) -> None:
    told: list[Epoch] = []
    campaign = plate.campaign(10)
    surrogate = train(
        campaign, settings(model, overrides=["level.epochs=1", "level.regression=network"]), report=told.append
    )
    validation = [campaign.runs.index(name) for name in surrogate.record.validation_runs]
    for epoch, number in zip(told, surrogate.level_names.values(), strict=True):
        truth = campaign.displacement(number)[validation]
        wrong = surrogate.predict(campaign.parameters[validation], campaign.time, number) - truth
        expected = np.sqrt(np.square(wrong).sum(axis=-1).mean())
        assert epoch.validation_error == pytest.approx(expected, rel=1e-3)
        assert epoch.best_error == epoch.validation_error
