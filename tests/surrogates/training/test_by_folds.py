"""Training where choices are made by folds: what trains on which runs, and that a run and its image are never parted."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import plate
import pytest
import torch
from numpy.typing import NDArray

from surrogates.data.campaign import Campaign
from surrogates.models.cascade import Cascade
from surrogates.models.level import LevelNetwork
from surrogates.physics.choice import Worth
from surrogates.physics.clock import Clock
from surrogates.physics.derived import DerivedInputs
from surrogates.physics.registration import Registration
from surrogates.physics.symmetry import Symmetry
from surrogates.record import Fit
from surrogates.settings import settings
from surrogates.surrogate import Surrogate
from surrogates.training import by_folds, train
from surrogates.training.by_folds import FoldTrainer, chooses_by_folds
from surrogates.training.loop import Objective
from surrogates.training.objectives import LevelObjective
from surrogates.uncertainty import FEWEST_BY_FOLDS

RUNS = 7


def registered(campaign: Campaign, *, clock: bool = False, mirror: bool = True) -> Registration:
    names, at = campaign.parameter_names, campaign.parameters
    own = Clock.of(at, 0, {0: 0.25}) if clock else Clock.identity(len(names))
    symmetry = Symmetry(plate.MIRROR, ("impact_angle",), flagged=True) if mirror else Symmetry()
    return Registration(DerivedInputs.identity(names), own, symmetry, own.grid(at, campaign.time))


class Watched(FoldTrainer):
    """Notes on which runs a reduction is trained and judged, and what the training loop is asked for."""

    last: Watched

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        Watched.last = self
        self.parted: list[tuple[set[int], set[int]]] = []
        self.asked: list[tuple[str, int, float]] = []
        self.began: list[float] = []

    def on_states(  # type: ignore[no-untyped-def]
        self, level, runs, scaling, training: NDArray[np.int64], validation: NDArray[np.int64], **more: Any
    ):
        self.parted.append((set(training.tolist()), set(validation.tolist())))
        self.began.append(float(next(level.reduction.parameters()).detach().sum()))
        return super().on_states(level, runs, scaling, training, validation, **more)

    def fit(self, objective: Objective, of_level, name: str, seed: int) -> Fit:  # type: ignore[no-untyped-def]
        self.asked.append((name, of_level.epochs, of_level.patience))
        return super().fit(objective, of_level, name, seed)


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch):  # type: ignore[no-untyped-def]
    """Train on a campaign that is registered as asked for."""

    def make(
        *overrides: str, model: str = "mh", runs: int = RUNS, trainer: type[Watched] = Watched, **how: bool
    ) -> tuple[Surrogate, Watched]:
        campaign = plate.campaign(runs)
        monkeypatch.setattr(train, "of_campaign", lambda *_: (registered(campaign, **how), Worth()))
        monkeypatch.setattr(train, "FoldTrainer", trainer)
        return train.train_surrogate(campaign, settings(model, overrides=["level.epochs=2", *overrides])), Watched.last

    return make


PLAIN = ("levels=[2]", "level.reduction=ae", "level.start=plain", "level.hidden=[5]", "level.latent=2")
OF_POD = ("levels=[2]", "level.reduction=pod", "level.latent=3", "level.regression=process")


@pytest.mark.parametrize(
    ("runs", "overrides", "folds"),
    [
        (4, (), True),
        (3, (), False),
        (8, ("validation.runs=[run_001]",), False),
        (8, ("validation.measure=paper",), False),
        (8, ("unified=true",), False),
        (8, ("inputs.initial_state=true",), False),
        (8, ("level.regression=network",), False),
        (8, ("level.regression=network", "level.reduction=pod"), True),
        (8, ("at.1.regression=network",), False),
    ],
)
def test_folds_choose_where_the_regression_is_apart_from_the_reduction(
    runs: int, overrides: tuple[str, ...], folds: bool
) -> None:
    assert chooses_by_folds(settings("mh", overrides=overrides), plate.campaign(runs)) is folds


def test_pod_regression_has_folds_of_its_own() -> None:
    assert not chooses_by_folds(settings("pod-gpr"), plate.campaign(8))


@pytest.mark.parametrize("runs", [RUNS, 16])
def test_a_run_and_its_image_are_left_out_by_the_same_fold_and_every_run_by_one(trained, runs: int) -> None:  # type: ignore[no-untyped-def]
    _, trainer = trained(*OF_POD, "validation.folds=4", runs=runs)
    part = trainer.part
    assert trainer.own == runs
    assert len(part) == 2 * runs
    np.testing.assert_array_equal(part[:runs], part[runs:])
    assert sorted(set(part.tolist())) == list(range(RUNS if runs == RUNS else 4))
    latents = trainer.latents[2]
    np.testing.assert_array_equal(latents.part, part)
    assert latents.own == runs
    assert trainer.judged_campaign is not trainer.campaign
    assert len(trainer.judged_campaign.parameters) == runs


def test_the_inputs_of_images_are_those_of_mirrored_runs(trained) -> None:  # type: ignore[no-untyped-def]
    _, trainer = trained(*OF_POD)
    speed, angle, _, side = trainer.latents[2].inputs[:, 0, :4].T
    torch.testing.assert_close(angle[RUNS:], -angle[:RUNS])
    torch.testing.assert_close(speed[RUNS:], speed[:RUNS])
    assert side.tolist() == [-1.0] * RUNS + [1.0] * RUNS


def test_a_reduction_is_judged_on_runs_whose_images_it_has_not_seen(trained) -> None:  # type: ignore[no-untyped-def]
    _, trainer = trained(*PLAIN)
    everyone = set(range(2 * RUNS))
    first = set(np.flatnonzero(trainer.part == 0).tolist())
    judged = [(training, held) for training, held in trainer.parted if held]
    assert judged == [(everyone - first, {run for run in first if run < RUNS})]
    assert all(training == everyone for training, held in trainer.parted if not held)


class Shared(Watched):
    """Notes on which share of the states each training goes through."""

    def fit(self, objective: Objective, of_level, name: str, seed: int) -> Fit:  # type: ignore[no-untyped-def]
        self.shares = {**getattr(self, "shares", {}), name: of_level.states}
        return super().fit(objective, of_level, name, seed)


BOTH_AE = ("level.reduction=ae", "level.start=plain", "level.hidden=[5]", "level.latent=2", "level.patience=0")


@pytest.mark.parametrize(("no_worse", "share"), [(100.0, 0.25), (0.0, 1.0)])
def test_a_level_of_many_nodes_takes_fewer_states_where_the_one_below_was_no_worse_so(
    trained, monkeypatch: pytest.MonkeyPatch, no_worse: float, share: float
) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr(by_folds, "_MANY_NODES", 10)
    monkeypatch.setattr(by_folds, "_NO_WORSE", no_worse)
    surrogate, trainer = trained(*BOTH_AE, trainer=Shared)
    assert trainer.shares["MH2 reduction"] == 1.0
    assert trainer.shares["MH2 reduction, fewer states"] == 0.25
    assert trainer.shares["MH1 reduction"] == share
    assert trainer.shares["MH1"] == 1.0  # the regression's
    assert any("25 % of the states" in note for note in surrogate.record.notes) is (share < 1)


@pytest.mark.parametrize(
    ("overrides", "many"), [((), 100), ((), 5), (("level.states=1",), 10)], ids=["none large", "all large", "asked for"]
)
def test_fewer_states_are_tried_only_below_the_first_level_of_many_nodes(
    trained, monkeypatch: pytest.MonkeyPatch, overrides: tuple[str, ...], many: int
) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr(by_folds, "_MANY_NODES", many)
    _, trainer = trained(*BOTH_AE, *overrides, trainer=Shared)
    assert "MH2 reduction, fewer states" not in trainer.shares
    assert set(trainer.shares.values()) == {1.0}


def test_a_level_that_need_not_be_trained_is_asked_all_the_same(trained, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr(by_folds, "_MANY_NODES", 10)
    monkeypatch.setattr(by_folds, "_GAINED", 0.0)
    _, trainer = trained(*BOTH_AE, "level.start=pod", trainer=Shared)
    assert "MH2 reduction, fewer states" in trainer.shares
    assert "MH1 reduction" not in trainer.shares
    assert trainer.chosen[2].reduction_epochs == 0


class Told(Watched):
    """The loop says which epoch was best and how good it was; nothing is trained."""

    said: Fit

    def fit(self, objective: Objective, of_level, name: str, seed: int) -> Fit:  # type: ignore[no-untyped-def]
        self.asked.append((name, of_level.epochs, of_level.patience))
        return replace(self.said) if name.endswith("reduction") else Fit(best_epoch=1)


@pytest.mark.parametrize(
    ("best", "again"),
    [(0.0, [("MH2 reduction, all runs", 7, 0.0)]), (2e9, [])],
)
def test_a_reduction_is_trained_anew_on_all_runs_for_the_epochs_that_were_good_for_left_out_ones(  # type: ignore[no-untyped-def]
    trained, best: float, again: list[tuple[str, int, float]]
) -> None:
    """`start=pod`: it begins with modes, and is left as computed where training is not better by what matters."""
    Told.said = Fit(best_epoch=7, best=best)
    overrides = [o.replace("start=plain", "start=pod") for o in PLAIN]
    surrogate, trainer = trained(*overrides, "level.epochs=9", "level.patience=0.5", trainer=Told)
    assert trainer.asked == [("MH2 reduction", 9, 0.5), *again, ("MH2", 9, 0.5)]
    assert trainer.chosen[2].reduction_epochs == (7 if again else 0)
    assert ("reduction 7 epochs" if again else "reduction as computed") in surrogate.record.choice["MH2"]


@pytest.mark.parametrize(("lost", "tried"), [(1.9, False), (2.1, True)])
def test_a_reduction_is_not_tried_where_half_of_what_its_start_loses_does_not_matter(  # type: ignore[no-untyped-def]
    trained, monkeypatch: pytest.MonkeyPatch, lost: float, tried: bool
) -> None:
    """`lost`: what the start at POD loses on left-out runs, in units of what matters."""

    class Slight(Told):
        def _wrong(self, level: LevelNetwork, *_: Any) -> float:
            return level.scale**2 / by_folds._MATTERS

    Slight.said = Fit(best_epoch=7, best=0.0)
    monkeypatch.setattr(LevelObjective, "validation", lambda self: torch.tensor([lost, lost]))
    _, trainer = trained(*(o.replace("start=plain", "start=pod") for o in PLAIN), trainer=Slight)
    assert ("MH2 reduction" in [name for name, *_ in trainer.asked]) is tried


def test_a_reduction_whose_training_is_interrupted_gets_a_process_and_no_network(trained) -> None:  # type: ignore[no-untyped-def]
    Told.said = Fit({"total": [1.0, 0.5]}, best_epoch=2, status="interrupted")
    surrogate, trainer = trained(*PLAIN, "level.regression=auto", trainer=Told)
    assert [name for name, *_ in trainer.asked] == ["MH2 reduction"]
    assert trainer.chosen[2].told == "process"
    assert surrogate.record.fits[2].status == "interrupted"
    assert np.isfinite(surrogate.predict(plate.parameters(1, seed=9)[0])).all()


@pytest.mark.parametrize("clock", [False, True])
def test_what_is_said_of_a_left_out_run_is_decoded_on_its_own_clock(trained, clock: bool) -> None:  # type: ignore[no-untyped-def]
    surrogate, trainer = trained(*OF_POD, clock=clock)
    level, original = surrogate.core.levels[2], trainer.original
    found = list(trainer.left_out(2, level))
    assert len(found) == RUNS
    rate, size = (f(original.parameters) for f in (trainer.registration.clock.rate, trainer.registration.clock.size))
    assert clock == (not np.allclose(rate, 1.0))
    for run in range(RUNS):
        course = trainer.chosen[2].said[int(trainer.part[run]), run].numpy()
        z = np.stack([np.interp(original.time * rate[run], trainer.campaign.time, c) for c in course.T], axis=1)
        with torch.no_grad():
            expected = size[run] * level.scale * level.decode(torch.from_numpy(z.astype(np.float32))).transpose(0, 1)
        np.testing.assert_allclose(found[run], expected, atol=1e-6)


def test_errors_and_band_come_from_left_out_runs_and_not_from_what_was_fitted(trained) -> None:  # type: ignore[no-untyped-def]
    surrogate, trainer = trained(*OF_POD, runs=9)
    truth = trainer.original.displacement(2)
    left = [
        float(np.linalg.norm(said - truth[run], axis=-1).mean())
        for run, said in enumerate(trainer.left_out(2, surrogate.core.levels[2]))
    ]
    assert surrogate.record.errors["MH2"] == pytest.approx(np.mean(left), rel=1e-5)
    kept = surrogate.record.left_out
    assert [kept[f"run_{run:03d}"][0] for run in range(9)] == pytest.approx(left, rel=1e-5)
    fitted = surrogate.predict(trainer.original.parameters)
    assert np.linalg.norm(fitted - truth, axis=-1).mean() < 0.7 * np.mean(left)
    assert surrogate.bands[2, False].runs == 9


@pytest.mark.parametrize("runs", [FEWEST_BY_FOLDS - 1, FEWEST_BY_FOLDS])
def test_too_few_runs_give_errors_and_no_band_and_say_so(trained, runs: int) -> None:  # type: ignore[no-untyped-def]
    surrogate, _ = trained(*OF_POD, runs=runs)
    said = f"there is no band: it takes {FEWEST_BY_FOLDS} training runs, and there are {runs}"
    assert (said in surrogate.record.notes) == (runs < FEWEST_BY_FOLDS)
    assert bool(surrogate.bands) == (runs >= FEWEST_BY_FOLDS)
    assert surrogate.record.errors["MH2"] > 0


def test_encoded_runs_carry_what_decoding_loses_and_how_far_latent_numbers_move_nodes(trained) -> None:  # type: ignore[no-untyped-def]
    """POD: sizes are the RMS of the decoder's columns, and what is lost is what the modes leave of known states."""
    surrogate, trainer = trained(*OF_POD, clock=True)
    level, latents = surrogate.core.levels[2], trainer.latents[2]
    torch.testing.assert_close(
        latents.sizes, level.reduction.decode_matrix.square().mean(dim=0).sqrt(), rtol=1e-4, atol=1e-6
    )
    field, known = trainer.campaign.displacement(2), trainer.campaign.known
    assert not known.all()
    lost = []
    for run in range(2 * RUNS):
        x = torch.from_numpy(field[run]).transpose(0, 1) / level.scale
        z = level.encode(x)
        torch.testing.assert_close(latents.values[run], z)
        lost.append((x - level.decode(z)).square().mean(dim=(0, 2))[known[run]])
    assert latents.lost == pytest.approx(float(torch.cat(lost).mean()), rel=1e-4)


def test_a_finer_level_reads_what_the_regressions_of_each_fold_say_on_the_coarser_one(trained) -> None:  # type: ignore[no-untyped-def]
    surrogate, trainer = trained(*OF_POD[1:], "levels=[2, 1]", mirror=False)
    assert isinstance(surrogate.core, Cascade)
    assert trainer.latents[2].below is None
    torch.testing.assert_close(trainer.latents[1].below, trainer.chosen[2].said)


def test_the_same_seed_gives_the_same_model_whatever_was_drawn_before(trained) -> None:  # type: ignore[no-untyped-def]
    at = plate.parameters(1, seed=9)[0]
    torch.manual_seed(1)
    first, trainer = trained(*PLAIN)
    assert len(set(trainer.began)) == 1  # the reduction without a fold, and that of all runs, start alike
    torch.manual_seed(2)
    second, again = trained(*PLAIN)
    assert again.began == trainer.began
    np.testing.assert_array_equal(second.predict(at), first.predict(at))
    other, _ = trained(*PLAIN, "seed=1")
    assert not np.array_equal(other.predict(at), first.predict(at))
