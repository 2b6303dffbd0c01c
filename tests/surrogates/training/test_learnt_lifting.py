"""Maps from a level to the full mesh that training runs give: what they keep, what they learn, and that runs left out are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plate
import pytest
from hypothesis import given
from hypothesis import settings as search
from hypothesis import strategies as st

from surrogates.data.graphs import Graphs
from surrogates.data.samples import LevelRuns, Notes
from surrogates.settings import settings
from surrogates.storage.folder import load, save
from surrogates.training import lifting
from surrogates.training.lifting import Lifts, learn_lifts
from surrogates.training.train import train_surrogate

RUNS = 12
QUICK = {"level": {"epochs": 1}, "transfer": {"epochs": 1.0}}


def learnt(field: np.ndarray, part: np.ndarray | None = None) -> Lifts:
    """From displacements (sim, state, node, 3) of the plate, three folds."""
    runs = len(field)
    campaign = plate.campaign(runs, displacement=lambda level: field)
    full = LevelRuns(campaign, 0, settings(), Notes())
    part = np.arange(runs) % 3 if part is None else part
    return learn_lifts(full, Graphs.of(campaign), (2, 1), part, np.arange(runs), plate.grid(plate.SIDES[0]))


def dent(seed: int = 0) -> np.ndarray:
    return plate.displacement(plate.parameters(RUNS, seed))


def missed(to_full: object, number: int, field: np.ndarray) -> float:
    """RMS distance of what the map makes of the level's nodes."""
    kept = plate.levels()[number - 1].kept
    off = np.stack([to_full @ state[kept] - state for run in field for state in run])  # type: ignore[operator]
    return float(np.sqrt(np.square(off).sum(axis=-1).mean()))


def test_a_smooth_dent_is_lifted_better_than_by_triangles_on_runs_nobody_learnt_from() -> None:
    found, fresh = learnt(dent()), dent(seed=9)
    for number in (1, 2):
        static = plate.levels()[number - 1].to_full
        assert missed(found.maps[number], number, fresh) < 0.5 * missed(static, number, fresh)


def test_the_errors_told_are_those_of_runs_left_out() -> None:
    field = dent()
    found = learnt(field)
    for number in (1, 2):
        each = [missed(found.without(run, number), number, field[run : run + 1]) for run in range(RUNS)]
        static = missed(plate.levels()[number - 1].to_full, number, field)
        assert found.errors[number] == pytest.approx((static, np.sqrt(np.mean(np.square(each)))), rel=1e-3)


@given(st.integers(0, 2**16))
@search(max_examples=15, deadline=None)
def test_rows_sum_to_one_and_kept_nodes_are_themselves(seed: int) -> None:
    draw = np.random.default_rng(seed)
    field = (dent() * (1 + 0.1 * draw.standard_normal((RUNS, 1, 81, 3)))).astype(np.float32)
    for number, to_full in learnt(field).maps.items():
        np.testing.assert_allclose(to_full.sum(axis=1), 1.0, atol=1e-9)
        kept = plate.levels()[number - 1].kept
        np.testing.assert_allclose(to_full[kept].toarray(), np.eye(len(kept)), atol=1e-6)


def test_a_translation_stays_one() -> None:
    moved = dent() + np.float32(0.1) * np.random.default_rng(0).standard_normal((RUNS, 7, 1, 3)).astype(np.float32)
    one = np.ones((len(plate.levels()[1].kept), 1))
    np.testing.assert_allclose(learnt(moved).maps[2] @ one, 1.0, atol=1e-9)


def test_what_does_not_move_teaches_nothing() -> None:
    found = learnt(np.zeros_like(dent()))
    assert set(found.errors) == {1, 2}
    assert found.maps == {}


def test_a_map_without_a_run_has_not_seen_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lifting, "PULLS", (1e-3,))
    field = dent()
    other = field.copy()
    other[4, :, ::3] *= 1.5
    first, second = learnt(field), learnt(other)
    assert set(first.maps) == set(second.maps) == {1, 2}
    for number in (1, 2):
        assert abs(first.without(4, number) - second.without(4, number)).max() < 1e-12
        assert abs(first.without(5, number) - second.without(5, number)).max() > 1e-4


def test_few_runs_and_large_meshes_keep_the_static_map(monkeypatch: pytest.MonkeyPatch) -> None:
    assert learnt(dent()[:3]).errors == {}
    monkeypatch.setattr(lifting, "_LARGEST_LEVEL", 9)
    assert set(learnt(dent()).errors) == {2}
    monkeypatch.setattr(lifting, "_LARGEST", 80)
    assert learnt(dent()).errors == {}


@pytest.fixture(scope="module")
def trained() -> object:
    return train_surrogate(plate.campaign(RUNS), settings("mh", overrides=QUICK))


def test_a_trained_model_lifts_by_the_learnt_map_and_says_so(trained, tmp_path: Path) -> None:
    static = plate.levels()[0].to_full
    assert abs(trained.graphs.to_full(1) - static).max() > 0.01
    assert "learnt map to the full mesh" in trained.record.choice["MH1"]
    said = trained.predict_full([20.0, 3.0, 3e8], level=1)
    on_level = trained.predict([20.0, 3.0, 3e8], level=1)
    by_hand = np.stack([trained.graphs.to_full(1) @ state for state in on_level])
    np.testing.assert_allclose(said, by_hand, atol=1e-6)
    save(trained, tmp_path / "model")
    np.testing.assert_array_equal(load(tmp_path / "model").predict_full([20.0, 3.0, 3e8], level=1), said)


@pytest.mark.parametrize("changes", [{"transfer": {"epochs": 1.0, "lifting": "static"}}, {"preset": "paper"}])
def test_the_static_map_stays_where_it_is_asked_for(changes: dict[str, object]) -> None:
    model = train_surrogate(plate.campaign(RUNS), settings("mh", overrides={**QUICK, **changes}))
    assert abs(model.graphs.to_full(1) - plate.levels()[0].to_full).max() == 0
    assert not any("map to the full mesh" in str(told) for told in model.record.choice.values())


def test_a_network_judged_on_validation_runs_has_learnt_from_the_others() -> None:
    own = settings("mh", overrides={"level": {"epochs": 1, "regression": "network"}, "transfer": {"epochs": 1.0}})
    model = train_surrogate(plate.campaign(RUNS), own)
    assert set(model.record.choice) == {"MH1", "MH2"}  # nothing but the maps is chosen
    field = dent()
    held = [int(name.removeprefix("run_")) for name in model.record.validation_runs]
    assert held
    assert missed(model.graphs.to_full(1), 1, field[held]) < missed(plate.levels()[0].to_full, 1, field[held])
