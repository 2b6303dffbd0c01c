"""A cascade over coarse runs: each level's process learns on top of them what they say, and nothing of what they do not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import plate
import pytest
import torch

from surrogates.errors import SurrogateError
from surrogates.models.cascade import Cascade
from surrogates.physics.choice import Worth
from surrogates.physics.clock import Clock
from surrogates.physics.derived import DerivedInputs
from surrogates.physics.registration import Registration
from surrogates.physics.symmetry import Symmetry
from surrogates.regression.beneath import ALONE, OF_QUERY, FineRuns, RunsBelow, _Search
from surrogates.settings import settings
from surrogates.storage.card import card
from surrogates.storage.export import export
from surrogates.storage.folder import load, save
from surrogates.surrogate import Surrogate
from surrogates.training import train
from surrogates.training.by_folds import FoldTrainer
from surrogates.training.checkpoints import Checkpoints
from surrogates.training.loop import Diverged
from surrogates.training.train import train_surrogate

OFF = [
    "physics.clock=off", "physics.symmetry=off", "inputs.derived=off", "level.epochs=2", "level.latent=6",
    "level.mlp.widths=[8]", "level.regression=process", "removal=off",
]  # fmt: skip
AT = plate.parameters(20, seed=9)


def trained(coarse: Any = plate.seen_coarsely, *more: str, runs: int = 10, **given: Any) -> Surrogate:
    return train_surrogate(plate.waving_campaign(runs, coarse), settings("mh", overrides=[*OFF, *more]), **given)


def error(surrogate: Surrogate, level: int) -> float:
    truth = plate.waving(AT)[:, :, plate.levels()[level - 1].kept]
    return float(np.linalg.norm(surrogate.predict(AT, level=level) - truth, axis=-1).mean())


def from_coarse(surrogate: Surrogate, **how: Any) -> np.ndarray:
    """Every query from its own coarse run."""
    seen = plate.seen_coarsely(AT)
    return np.stack([surrogate.predict_from_coarse(p, s, plate.TIME, **how) for p, s in zip(AT, seen, strict=True)])


@pytest.fixture(scope="module")
def alone() -> Surrogate:
    return trained(None)


@pytest.fixture(scope="module")
def helped() -> Surrogate:
    return trained()


@pytest.mark.parametrize("level", [2, 1])
def test_coarse_runs_that_know_more_lower_the_error_of_each_level(
    alone: Surrogate, helped: Surrogate, level: int
) -> None:
    assert error(helped, level) < 0.5 * error(alone, level)
    errors = helped.record.coarse["levels"][f"MH{level}"]["errors"]
    assert errors[helped.record.coarse["levels"][f"MH{level}"]["way"]] < 0.5 * errors[ALONE]
    assert helped.record.errors[f"MH{level}"] < 0.5 * alone.record.errors[f"MH{level}"]


def test_coarse_runs_that_say_nothing_change_nothing(alone: Surrogate) -> None:
    useless = trained(plate.noise)
    assert useless.record.coarse["way"] == ALONE
    assert useless.coarse_mesh is None
    np.testing.assert_array_equal(useless.predict(AT), alone.predict(AT))
    with pytest.raises(SurrogateError, match="did not pay"):
        useless.predict_from_coarse(AT[0], plate.noise(AT)[0], plate.TIME)
    assert "not used" in useless.record.physics["coarse runs on MH1"]


def test_a_coarse_run_of_the_query_is_taken_over(helped: Surrogate) -> None:
    found = from_coarse(helped, full=True)
    assert np.linalg.norm(found - plate.waving(AT), axis=-1).mean() < 0.02
    own = from_coarse(helped, level=2)
    assert own.shape[2:] == (9, 3)
    truth = plate.waving(AT)[:, :, plate.levels()[1].kept]
    assert np.linalg.norm(own - truth, axis=-1).mean() < error(helped, 2)


def test_in_folds_and_afterwards_a_coarse_run_is_taken_over_the_same_way(helped: Surrogate) -> None:
    """The band of such predictions was measured in folds; at training runs, what it holds is about the size of the error."""
    band = helped.band(0.9, full=True, from_coarse=True)
    off = np.linalg.norm(from_coarse(helped, full=True) - plate.waving(AT), axis=-1)
    assert 0.5 < (off <= band).mean() <= 1.0
    assert helped.band(0.9, full=True).mean() > 0


def test_the_folder_needs_no_coarse_runs_and_predicts_the_same(helped: Surrogate, tmp_path: Path) -> None:
    again = load(save(helped, tmp_path / "m"))
    np.testing.assert_allclose(again.predict(AT), helped.predict(AT), atol=1e-7)
    np.testing.assert_allclose(from_coarse(again), from_coarse(helped), atol=1e-7)
    for level in (2, 1):
        for full in (False, True):
            asked = {"level": level, "full": full, "parameters": AT[0], "from_coarse": True}
            np.testing.assert_array_equal(again.band(0.9, **asked), helped.band(0.9, **asked))  # type: ignore[arg-type]
    assert again.record.coarse == helped.record.coarse


def test_record_and_card_say_what_they_are_worth_on_each_level(helped: Surrogate) -> None:
    about = helped.record.coarse
    assert (about["runs"], about["twins"], about["checksum"], list(about["levels"])) == (
        60,
        10,
        "facade",
        ["MH2", "MH1"],
    )
    assert OF_QUERY in about["errors"]
    text = card(helped)
    for said in ("60 runs of", "checksum facade", "coarse runs on MH2: process", "coarse runs on MH1: process"):
        assert said in text
    assert "over coarse runs" in helped.record.choice["MH1"]


def test_an_exported_program_holds_the_coarse_runs(helped: Surrogate, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    pytest.importorskip("onnxruntime")
    assert export(helped, tmp_path / "m.onnx", 2) <= 1e-4


def test_several_seeds_each_take_coarse_runs(helped: Surrogate, tmp_path: Path) -> None:
    both = trained(plate.seen_coarsely, "seeds=2")
    assert list(both.record.coarse["levels"]) == ["MH2, seed 0", "MH1, seed 0", "MH2, seed 1", "MH1, seed 1"]
    np.testing.assert_allclose(from_coarse(both), from_coarse(helped), atol=0.02)
    np.testing.assert_allclose(from_coarse(load(save(both, tmp_path / "m"))), from_coarse(both), atol=1e-7)


def test_a_mixture_with_the_network_takes_over_its_share(alone: Surrogate) -> None:
    mixed = trained(plate.seen_coarsely, "level.regression=mean")
    assert isinstance(mixed.core, Cascade)
    level = mixed.core.levels[1]
    inputs = mixed.core.inputs(torch.from_numpy(AT), torch.full((len(AT),), plate.TIME[-1]))
    seen = torch.ones(len(AT), level.latent)
    assert level.process is not None
    assert level.process.over is not None
    with torch.no_grad():
        changed = level.from_query(inputs, seen)
        whole = level.process.over.from_query(inputs, seen)
    torch.testing.assert_close(changed, 0.5 * whole)
    assert error(mixed, 1) < error(alone, 1)


def test_mirrored_and_on_another_clock_coarse_runs_help_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    campaign = plate.waving_campaign(10)
    clock = Clock.of(campaign.parameters, 0, {0: 0.25})
    symmetry = Symmetry(plate.MIRROR, ("impact_angle",), flagged=False)
    names = DerivedInputs.identity(campaign.parameter_names)
    of = Registration(names, clock, symmetry, clock.grid(campaign.parameters, campaign.time))
    monkeypatch.setattr(train, "of_campaign", lambda *_: (of, Worth()))
    helped, alone = trained(), trained(None)
    assert error(helped, 1) < 0.5 * error(alone, 1)
    truth = plate.waving(AT)[:, :, plate.levels()[0].kept]
    assert np.linalg.norm(from_coarse(helped) - truth, axis=-1).mean() < 1.2 * error(helped, 1)


def test_interrupted_it_keeps_the_levels_over_coarse_runs_and_goes_on(tmp_path: Path) -> None:
    def stop(epoch: Any) -> None:
        if epoch.name.startswith("MH1"):
            raise KeyboardInterrupt

    campaign = plate.waving_campaign(8)
    chosen = settings("mh", overrides=[*OFF, "level.regression=mean"])
    some = train_surrogate(campaign, chosen, report=stop, keeper=Checkpoints(tmp_path / "s", chosen, campaign))
    assert some.takes_coarse(2)
    again = load(save(some, tmp_path / "m"))
    assert again.record.coarse["checksum"] == "facade"
    whole = train_surrogate(campaign, chosen, keeper=Checkpoints(tmp_path / "s", chosen, campaign, resume=True))
    assert whole.takes_coarse(1)
    Checkpoints(tmp_path / "other", chosen, campaign)
    assert campaign.coarse is not None
    other = replace(campaign.coarse, campaign=replace(campaign.coarse.campaign, checksum="beef"))
    with pytest.raises(SurrogateError, match="other coarse runs"):
        Checkpoints(tmp_path / "other", chosen, replace(campaign, coarse=other), resume=True)


def test_where_a_finer_level_diverges_what_is_kept_says_its_coarse_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    real = FoldTrainer.fit

    def fit(self: FoldTrainer, objective: Any, of_level: Any, name: str, seed: int) -> Any:
        if name == "MH1":
            raise Diverged("MH1: the loss is not finite")
        return real(self, objective, of_level, name, seed)

    monkeypatch.setattr(FoldTrainer, "fit", fit)
    with pytest.raises(Diverged) as stopped:
        trained(plate.seen_coarsely, "level.regression=mean", runs=8)
    kept = stopped.value.surrogate
    assert kept is not None
    assert kept.takes_coarse()
    assert list(kept.record.coarse["levels"]) == ["MH2"]


@pytest.mark.parametrize(
    ("model", "more", "said"),
    [
        ("podnn", [], "go beneath mh and pod-gpr"),
        ("mh", ["level.regression=network"], "level.regression=network has none"),
        ("mh", ["validation.runs=[run_001]"], "which validation.runs rules out"),
        ("mh", ["unified=true"], "which unified rules out"),
    ],
)  # fmt: skip
def test_what_does_not_go_with_coarse_runs_is_refused_in_one_line(model: str, more: list[str], said: str) -> None:
    with pytest.raises(SurrogateError, match=said) as refused:
        train_surrogate(plate.waving_campaign(8), settings(model, overrides=more))
    assert "\n" not in str(refused.value)


def test_too_few_fine_runs_are_refused() -> None:
    with pytest.raises(SurrogateError, match="fine runs; found 2"):
        trained(runs=2)


def test_what_a_fold_says_does_not_know_the_coarse_runs_of_what_it_leaves_out() -> None:
    draw = np.random.default_rng(0)
    x, more = draw.uniform(-1, 1, (6, 2)), draw.uniform(-1, 1, (20, 2))
    fine, below = (draw.standard_normal((n, 4, 3)).astype(np.float32) for n in (6, 26))
    folds = [(np.array([k for k in range(6) if k % 3 != f]), np.array([f, f + 3])) for f in range(3)]

    def said(coarse: np.ndarray) -> np.ndarray:
        runs = FineRuns(
            x, fine, 6, folds, (), 0,
            lambda courses: np.ones((len(courses), 1)) * np.arange(len(courses))[:, None],  # kernels that no course changes
            lambda places: np.ones((len(places), 4)), lambda places, courses: np.zeros(len(places)),
        )  # fmt: skip
        search = _Search(runs, RunsBelow(np.concatenate([x, more]), coarse, 26, np.arange(6)))
        own = runs.fitted(x, fine).kernel
        return next(iter(search._parts(own, own))).said.far

    other = below.copy()
    other[[0, 3]] += 7.0
    np.testing.assert_array_equal(said(other), said(below))
    other[8] += 7.0
    assert np.abs(said(other) - said(below)).max() > 0.01
