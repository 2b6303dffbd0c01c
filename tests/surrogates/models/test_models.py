"""Every kind of model, trained on a plate that is hit: right, frozen where it must be, stored and loaded bit by bit."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import plate
import pytest
import torch

from surrogates.errors import SurrogateError
from surrogates.models.cascade import Cascade
from surrogates.settings import settings
from surrogates.storage.folder import load, save
from surrogates.surrogate import Surrogate
from surrogates.training.checkpoints import Checkpoints
from surrogates.training.loop import Diverged, Epoch
from surrogates.training.train import train_surrogate

SHORT = ("level.epochs=4", "transfer.epochs=1", "level.batch=16")


def trained(model: str, *overrides: str, runs: int = 10, **more: object) -> Surrogate:
    return train_surrogate(plate.campaign(runs), settings(model, overrides=[*SHORT, *overrides]), **more)  # type: ignore[arg-type]


@functools.cache
def short() -> Surrogate:
    """The default cascade after a few epochs; not to be changed."""
    return trained("mh")


def e2(surrogate: Surrogate, level: int, mu: np.ndarray) -> float:
    """Mean node error on the full mesh."""
    return float(np.linalg.norm(surrogate.predict_full(mu, level=level) - plate.displacement(mu), axis=-1).mean())


@pytest.mark.parametrize(
    ("model", "overrides"),
    [
        ("mh", ()),
        ("mh", ("levels=[2, 1, 0]",)),
        ("mh", ("levels=[2, 0]",)),
        ("mh", ("transfer.upsampling=static", "transfer.mlp=input")),
        ("mh", ("transfer.upsampling=sparse",)),
        ("mh", ("transfer.encoder=concat",)),
        ("mh", ("level.convolution=gcn",)),
        ("mh", ("level.convolution=gcn2", "level.start=plain")),
        ("mh", ("level.reduction=ae", "level.hidden=[20]")),
        ("mh", ("level.reduction=pod", "level.start=plain")),
        ("mh", ("inputs.initial_state=true",)),
        ("mh", ("inputs.products=true", "inputs.angles=true")),
        ("mh", ("refinement.adaptive=true",)),
        ("mh", ("unified=true",)),
        ("mh", ("at.2.channels=[4, 5]", "at.1.epochs=2")),
        ("podnn", ()),
        ("aenn", ("level.hidden=[20]",)),
        ("gaenn", ()),
    ],
    ids=lambda value: value if isinstance(value, str) else " ".join(value) or "default",
)
def test_every_model_learns_and_survives_storage(model: str, overrides: Sequence[str], tmp_path: Path) -> None:
    off = ("inputs.derived=off",) if overrides else ()  # searching inputs once is enough
    surrogate = trained(model, "level.epochs=12", *off, *overrides)
    mu = plate.parameters(2, seed=7)
    for name, level in surrogate.level_names.items():
        history = surrogate.history(level)
        if len(history) and level == max(surrogate.level_names.values()):  # a finer level starts where it may stay
            assert history["total"][-1] < history["total"][0]
        predicted = surrogate.predict(mu, level=level)
        assert predicted.shape == (2, 7, surrogate.graphs.n_nodes(level), 3)
        assert np.isfinite(predicted).all()
        assert surrogate.record.errors[name] > 0
    again = load(save(surrogate, tmp_path / "model"))
    assert again.level_names == surrogate.level_names
    for level in surrogate.level_names.values():
        np.testing.assert_array_equal(again.predict(mu, level=level), surrogate.predict(mu, level=level))
        states = plate.displacement(mu)[0][:, surrogate.graphs.kept(level)]
        np.testing.assert_array_equal(again.reconstruct(states, level), surrogate.reconstruct(states, level))


def test_the_cascade_learns_the_plate() -> None:
    surrogate = trained("mh", "level.epochs=40", "level.latent=6", "level.mlp.widths=[32, 32]", runs=20)
    mu = plate.parameters(6, seed=11)
    nothing = float(np.linalg.norm(plate.displacement(mu), axis=-1).mean())
    assert e2(surrogate, 1, mu) < 0.15 * nothing
    assert e2(surrogate, 1, mu) < e2(surrogate, 2, mu)


def test_a_finer_level_does_not_change_the_coarser_ones_by_one_bit() -> None:
    coarse_alone = trained("mh", "levels=[2]")
    both = short()
    assert isinstance(coarse_alone.core, Cascade)
    assert isinstance(both.core, Cascade)
    before = coarse_alone.core.levels[2].own_state()
    after = both.core.levels[2].own_state()
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)
    mu = plate.parameters(1, seed=3)[0]
    np.testing.assert_array_equal(coarse_alone.predict(mu, level=2), both.predict(mu, level=2))


def test_the_same_seed_gives_the_same_model_and_another_one_another() -> None:
    mu = plate.parameters(1, seed=3)[0]
    first, second, third = short(), trained("mh"), trained("mh", "seed=1")
    np.testing.assert_array_equal(first.predict(mu), second.predict(mu))
    assert not np.array_equal(first.predict(mu), third.predict(mu))


class Killed(Exception):
    """The process is gone."""


def test_a_killed_training_resumed_gives_the_same_cascade(tmp_path: Path) -> None:
    campaign, chosen = plate.campaign(10), settings("mh", overrides=SHORT)

    def kill(epoch: Epoch) -> None:
        if epoch.name == "MH1" and epoch.epoch == 3:
            raise Killed

    with pytest.raises(Killed):
        train_surrogate(campaign, chosen, report=kill, keeper=Checkpoints(tmp_path / "s", chosen, campaign, every=2))
    told: list[str] = []
    resumed = train_surrogate(
        campaign, chosen, report=lambda epoch: told.append(f"{epoch.name} {epoch.epoch}"),
        keeper=Checkpoints(tmp_path / "s", chosen, campaign, every=2, resume=True),
    )  # fmt: skip
    assert told == ["MH1 3", "MH1 4"]
    mu = plate.parameters(2, seed=3)
    whole = short()
    for level in (2, 1):
        np.testing.assert_array_equal(resumed.predict(mu, level=level), whole.predict(mu, level=level))


def test_ctrl_c_leaves_a_usable_model(tmp_path: Path) -> None:
    def press(epoch: Epoch) -> None:
        if epoch.name == "MH1" and epoch.epoch == 2:
            raise KeyboardInterrupt

    surrogate = trained("mh", report=press)
    assert surrogate.level_names == {"MH2": 2, "MH1": 1}
    assert surrogate.record.fits[1].status == "interrupted"
    again = load(save(surrogate, tmp_path / "model"))
    assert np.isfinite(again.predict(plate.parameters(1)[0])).all()


def test_divergence_names_the_level_and_hands_over_what_is_good() -> None:
    with pytest.raises(Diverged, match="MH2: the loss is not finite in epoch") as caught:
        trained("mh", "level.regression=network", "at.2.learning_rate=1e30", "at.2.schedule=constant", "at.2.clip=0")
    assert caught.value.surrogate is None  # no level is finished, and no epoch ended well


def test_where_a_network_diverges_beside_a_process_the_process_is_used() -> None:
    surrogate = trained("mh", "levels=[2]", "at.2.learning_rate=1e30", "at.2.schedule=constant", "at.2.clip=0")
    assert any("MH2: the loss is not finite" in note and "process alone" in note for note in surrogate.record.notes)
    assert surrogate.record.choice["MH2"].startswith("process (process ")
    assert np.isfinite(surrogate.predict(plate.parameters(1)[0])).all()


@pytest.mark.parametrize("regression", ["network", "mean"])
def test_a_finer_level_that_diverges_leaves_the_coarser_ones(regression: str) -> None:
    with pytest.raises(Diverged, match="MH1") as caught:
        trained(
            "mh", f"level.regression={regression}", "at.1.learning_rate=1e30", "at.1.schedule=constant", "at.1.clip=0"
        )
    left = caught.value.surrogate
    assert left is not None
    assert 2 in left.level_names.values()
    assert np.isfinite(left.predict(plate.parameters(1)[0], level=2)).all()


def test_any_number_of_levels_and_states_can_be_asked_at_once() -> None:
    surrogate = short()
    mu = plate.parameters(3, seed=5)
    together = surrogate.predict(mu, plate.TIME[2:4])
    alone = surrogate.predict(mu[1], plate.TIME[3])
    assert together.shape == (3, 2, 25, 3)
    np.testing.assert_allclose(together[1, 1], alone[0], atol=1e-6)


@pytest.mark.filterwarnings("error")
def test_states_that_may_not_be_written_to_are_reduced_without_a_warning() -> None:
    states = plate.displacement(plate.parameters(1))[0][:, plate.levels()[0].kept]
    states.flags.writeable = False
    np.testing.assert_array_equal(short().reconstruct(states), short().reconstruct(states.copy()))
    np.testing.assert_array_equal(short().encode(states), short().encode(states.copy()))


def test_lifting_is_by_the_map_of_the_model() -> None:
    surrogate = short()
    mu = plate.parameters(1, seed=5)[0]
    up = surrogate.graphs.to_full(2).toarray()
    expected = np.einsum("fc,tcx->tfx", up, surrogate.predict(mu, level=2))
    np.testing.assert_allclose(surrogate.predict_full(mu, level=2), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (
            lambda s: s.predict([1.0, 2.0, 3.0], level=5),
            r"level 5 was asked for; this surrogate predicts on MH2 \(2\), MH1 \(1\)",
        ),
        (lambda s: s.predict([1.0, 2.0]), r"expected \(3,\).*impact_speed, impact_angle, yield_stress"),
        (lambda s: s.predict([1.0, np.nan, 2.0]), "must be finite"),
        (lambda s: s.predict([1.0, 1.0, 2.0], []), "0 times were asked for"),
        (lambda s: s.reconstruct(np.zeros((2, 7, 3))), "expected .state, 25 nodes, 3"),
    ],
)
def test_bad_questions_are_answered_in_words(ask, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(SurrogateError, match=message):
        ask(short())


@pytest.mark.parametrize("model", ["mh", "podnn"])
def test_one_training_run_is_a_noted_constant(model: str) -> None:
    surrogate = trained(model, runs=1)
    assert any("one training run" in note for note in surrogate.record.notes)
    far = plate.parameters(2, seed=8)
    answers = surrogate.predict(far)
    np.testing.assert_allclose(answers[0], answers[1], atol=1e-6 * np.abs(answers).max())


def test_a_run_that_does_not_move_is_noted_and_learnt() -> None:
    u = plate.displacement(plate.parameters(6))
    u[2] = 0.0
    coarse = plate.levels()
    campaign = plate.campaign(6, displacement=lambda k: u if k == 0 else u[:, :, coarse[k - 1].kept])
    surrogate = train_surrogate(campaign, settings("mh", overrides=SHORT))
    assert "run run_002 does not move in any state; it is learnt as it is" in surrogate.record.notes
    assert np.isfinite(surrogate.predict(plate.parameters(1)[0])).all()
