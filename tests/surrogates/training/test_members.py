"""Several trainings of one model, which differ by their seed alone, as one model that is their mean."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import plate
import pytest

from surrogates.errors import SurrogateError
from surrogates.models.average import Average
from surrogates.settings import settings
from surrogates.storage.card import card
from surrogates.storage.folder import load, save
from surrogates.surrogate import Surrogate
from surrogates.training import train
from surrogates.training.checkpoints import Checkpoints
from surrogates.training.train import train_surrogate

# Networks whose weights differ by the seed, and quickly trained.
SMALL = {
    "level": {"epochs": 3, "latent": 2, "regression": "network", "reduction": "pod", "mlp": {"widths": [8], "members": 1}},
    "levels": [2, 1], "physics": {"clock": "off", "symmetry": "off"}, "inputs": {"derived": "off"},
    "removal": "off", "validation": {"folds": 3},
}  # fmt: skip
AT = plate.parameters(3, seed=9)


def trained(seeds: int, seed: int = 0, model: str = "mh", runs: int = 9, **more: Any) -> Surrogate:
    chosen = settings(model, overrides=[SMALL if model == "mh" else {}, {"seeds": seeds, "seed": seed}])
    return train_surrogate(plate.campaign(runs), chosen, **more)


@pytest.fixture(scope="module")
def mean() -> Surrogate:
    return trained(3)


def members(surrogate: Surrogate) -> list[np.ndarray]:
    """What each member alone says of AT on the finest level."""
    assert isinstance(surrogate.core, Average)
    out = []
    for network in surrogate.core.networks:
        alone = Surrogate(
            surrogate.settings, surrogate.record, surrogate.graphs, network, registration=surrogate.registration
        )
        out.append(alone.predict(AT))
    return out


def test_a_prediction_is_the_mean_of_the_members(mean: Surrogate) -> None:
    each = members(mean)
    assert np.abs(each[0] - each[1]).max() > 1e-4
    np.testing.assert_allclose(mean.predict(AT), np.mean(each, axis=0), atol=1e-6)


def test_the_first_member_is_what_one_training_gives(mean: Surrogate) -> None:
    np.testing.assert_allclose(members(mean)[0], trained(1).predict(AT), atol=1e-6)


def test_errors_of_each_training_and_of_the_mean_are_noted(mean: Surrogate) -> None:
    record = mean.record
    assert list(record.members) == ["0", "1", "2"]
    alone = [errors["MH1"] for errors in record.members.values()]
    assert len(set(alone)) == 3
    assert record.errors["MH1"] <= np.mean(alone)  # a norm is convex
    assert "| seed 2 |" in card(mean)


def test_folds_and_physics_are_those_of_one_training(mean: Surrogate) -> None:
    one = trained(1)
    assert mean.registration.as_dict() == one.registration.as_dict()
    assert mean.record.members["0"] == pytest.approx({k: one.record.errors[k] for k in one.level_names})


def test_a_band_may_follow_how_far_the_members_lie_apart(mean: Surrogate) -> None:
    told = mean.beliefs(AT).deviation
    assert len(np.unique(told)) == 3
    left = [deviation for _, deviation in mean.record.left_out.values()]
    assert len(set(left)) > 1
    assert min(left) > 0.2 * float(np.mean(left))  # nowhere zero


def test_it_is_stored_whole(mean: Surrogate, tmp_path: Path) -> None:
    back = load(save(mean, tmp_path / "model"))
    assert back.seeds == (0, 1, 2)
    assert back.record.members == mean.record.members
    np.testing.assert_array_equal(back.predict(AT), mean.predict(AT))
    np.testing.assert_array_equal(back.beliefs(AT).deviation, mean.beliefs(AT).deviation)
    assert back.band(0.9, parameters=AT[0]) == pytest.approx(mean.band(0.9, parameters=AT[0]))


def test_latent_vectors_stand_side_by_side(mean: Surrogate) -> None:
    states = mean.predict(AT[0])
    assert mean.encode(states).shape[1] == mean.n_latent() == 3 * trained(1).n_latent()
    assert mean.reconstruct(states).shape == states.shape


def test_equal_trainings_are_told() -> None:
    """A process on modes does not depend on the seed."""
    chosen = settings("mh", overrides=[SMALL, {"level.regression": "process", "seeds": 2}])
    found = train_surrogate(plate.campaign(9), chosen)
    assert any("the seed changes next to nothing" in note for note in found.record.notes)
    assert np.ptp(found.beliefs(AT).deviation) < 1e-3 * found.beliefs(AT).deviation.max()


def test_processes_are_trained_once_and_say_so() -> None:
    found = trained(3, model="pod-gpr")
    assert found.seeds == (0,)
    assert any("trained once and not 3 times" in note for note in found.record.notes)


def test_validation_runs_are_the_same_for_all() -> None:
    chosen = settings("mh", overrides=[SMALL, {"unified": True, "seeds": 2, "levels": [2, 1]}])
    found = train_surrogate(plate.campaign(9), chosen)
    assert found.record.validation_runs
    assert list(found.record.members) == ["0", "1"]
    assert isinstance(found.core, Average)


def test_adaptive_meshes_are_refused() -> None:
    with pytest.raises(SurrogateError, match=r"seeds.*averaged on one"):
        settings("mh", overrides=["seeds=2", "refinement.adaptive=true"])


class Stop:
    """Interrupts once a training of the given number reports."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.heard: list[str] = []

    def __call__(self, epoch: Any) -> None:
        self.heard.append(epoch.name)
        if epoch.name.startswith(f"{self.number} of "):
            raise KeyboardInterrupt


def test_interrupted_it_keeps_whole_trainings_and_goes_on_with_the_next(mean: Surrogate, tmp_path: Path) -> None:
    campaign, chosen = plate.campaign(9), settings("mh", overrides=[SMALL, {"seeds": 3}])
    keeper = Checkpoints(tmp_path / "state", chosen, campaign)
    some = train_surrogate(campaign, chosen, report=Stop(3), keeper=keeper)
    assert some.seeds == (0, 1)
    assert {fit.status for fit in some.record.fits.values()} == {"interrupted"}
    assert any("2 of 3 trainings" in note for note in some.record.notes)
    later = Stop(0)
    keeper = Checkpoints(tmp_path / "state", chosen, campaign, resume=True)
    whole = train_surrogate(campaign, chosen, report=later, keeper=keeper)
    assert {name.split(",")[0] for name in later.heard} == {"3 of 3"}
    np.testing.assert_allclose(whole.predict(AT), mean.predict(AT), atol=1e-6)


def test_interrupted_in_the_first_it_keeps_what_there_is(tmp_path: Path) -> None:
    campaign, chosen = plate.campaign(9), settings("mh", overrides=[SMALL, {"seeds": 3}])
    some = train_surrogate(campaign, chosen, report=Stop(1))
    assert some.seeds == (0,)
    assert "interrupted" in {fit.status for fit in some.record.fits.values()}


def test_a_later_training_that_diverges_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    real = train._fit_cascade

    def fit(surrogate: Surrogate, trainer: Any) -> None:
        if trainer.settings.seed == 1:
            raise train.Diverged("the loss is not finite")
        real(surrogate, trainer)

    monkeypatch.setattr(train, "_fit_cascade", fit)
    found = trained(3)
    assert found.seeds == (0, 2)
    assert any("seed 1" in note and "left out" in note for note in found.record.notes)
