"""Draws, field sums, probabilities, differences and folding modes, against answers that are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from evaluation.errors import EvaluationError
from evaluation.scatter.differences import differences
from evaluation.scatter.draws import Scatter, draw, sobol
from evaluation.scatter.fields import Exceedance, FieldTally
from evaluation.scatter.folding import folding_modes
from evaluation.scatter.probability import probability

SPEED = Scatter("speed", "m s-1", 20.0, 2.0)
ANGLE = Scatter("angle", "degree", 0.0, 3.0, "uniform")


def test_a_latin_hypercube_has_one_draw_in_each_layer() -> None:
    found = draw([SPEED, ANGLE], 200, seed=1)
    for column, one in zip(found.T, (SPEED, ANGLE), strict=True):
        layers = np.sort(np.floor(one.distribution.cdf(column) * 200)).astype(int)
        np.testing.assert_array_equal(layers, np.arange(200))
    np.testing.assert_array_equal(found, draw([SPEED, ANGLE], 200, seed=1))


@pytest.mark.parametrize("plan", ["latin", "sobol"])
def test_mean_and_deviation_are_those_of_the_scatter(plan: str) -> None:
    found = draw([SPEED, ANGLE], 1000, seed=0, plan=plan)  # type: ignore[arg-type]
    np.testing.assert_allclose(found.mean(axis=0), [20, 0], atol=0.02)
    np.testing.assert_allclose(found.std(axis=0), [2, 6 / np.sqrt(12)], rtol=0.01)
    assert np.abs(found[:, 1]).max() <= 3


def test_nothing_that_scatters_is_refused() -> None:
    with pytest.raises(EvaluationError, match="width above zero"):
        Scatter("speed", "m s-1", 20.0, 0.0)
    with pytest.raises(EvaluationError, match="nothing scatters"):
        draw([], 10, 0)


def test_indices_of_the_ishigami_function_are_those_of_the_book() -> None:
    three = [Scatter(f"x{k}", "1", 0.0, np.pi, "uniform") for k in range(3)]

    def numbers(x: np.ndarray) -> np.ndarray:
        a, b, c = x.T
        return np.stack([np.sin(a) + 7 * np.sin(b) ** 2 + 0.1 * c**4 * np.sin(a), np.full(len(x), 3.0)])

    found = sobol(three, numbers, 20_000, seed=0)
    np.testing.assert_allclose(found.first[0], [0.314, 0.442, 0.0], atol=0.05)  # Saltelli et al. 2008, section 4.8
    np.testing.assert_allclose(found.total[0], [0.558, 0.442, 0.244], atol=0.05)
    assert not found.total[1].any()  # what never changes owes nothing to anybody
    assert (found.total_interval[0, :, 0] <= found.total[0]).all()


def test_sums_over_draws_in_blocks_are_those_of_all_at_once() -> None:
    rng = np.random.default_rng(0)
    states = (5 + 1e-3 * rng.normal(size=(40, 3, 6, 3))).astype(np.float32)
    tally = FieldTally(states[0])
    for some in np.split(states, 5):
        tally.add(some)
    away = states.astype(np.float64) - states.mean(axis=0, dtype=np.float64)
    np.testing.assert_allclose(tally.mean, states.mean(axis=0, dtype=np.float64), rtol=1e-6)
    np.testing.assert_allclose(tally.deviation, np.sqrt((away**2).sum(axis=(0, 3)) / 39), rtol=1e-4)


def test_how_often_a_node_breaks_a_limit_by_state_and_at_any_time() -> None:
    found = Exceedance(2, 4, np.array([1, 3]))
    found.add(np.array([[[True, False], [False, False]], [[False, False], [True, False]]]))
    np.testing.assert_array_equal(found.probability, [[np.nan, 0.5, np.nan, 0], [np.nan, 0.5, np.nan, 0]])
    np.testing.assert_array_equal(found.ever, [np.nan, 1, np.nan, 0])


def test_the_interval_for_the_number_of_draws_is_that_of_clopper_and_pearson() -> None:
    broken = np.arange(200) < 10
    found = probability(broken, None, None, 0.9)
    low, high = stats.beta.ppf(0.05, 10, 191), stats.beta.ppf(0.95, 11, 190)
    assert found.sampling == pytest.approx((low, high))
    assert found.both == found.sampling
    assert found.model is None


def test_a_model_that_may_be_wrong_widens_the_interval_but_never_narrows_it() -> None:
    rng = np.random.default_rng(0)
    broken = rng.random(4000) < 0.1
    subset = broken[:400]
    wrong = np.stack([rng.random(400) < p for p in np.linspace(0.02, 0.2, 60)])
    found = probability(broken, wrong, subset, 0.9)
    assert found.model is not None
    assert found.model[1] - found.model[0] > 0.1
    assert found.both[0] <= found.sampling[0] < found.value < found.sampling[1] <= found.both[1]
    same = probability(broken, np.repeat(subset[None], 20, axis=0), subset, 0.9)
    assert same.model == pytest.approx((same.value, same.value))


def test_runs_begin_to_differ_where_and_when_something_new_happens() -> None:
    rng = np.random.default_rng(0)
    time = np.linspace(0, 0.03, 31)
    first, second = rng.normal(size=(2, 128, 1, 1, 1))
    states = 1e-3 * first * np.linspace(0, 1, 31)[None, :, None, None] * np.ones((1, 1, 8, 3))
    late = np.clip(np.arange(31) - 20, 0, None)[None, :, None, None] / 10
    states[:, :, 4:] += 1e-3 * second * late  # the second part does something of its own from state 20 on
    found = differences(["front", "rear"], time, states, [np.arange(4), np.arange(4, 8)])
    assert found.names[found.source[0]] == "rear"
    after = found.new[:, 15:]
    assert 20 < 15 + int(np.argmax(after[1])) < 26
    assert after[0].max() < 0.05 * after[1].max()
    np.testing.assert_allclose(found.scatter[0, -1], 1e-3 * first.std() * np.sqrt(3), rtol=1e-6)
    assert found.begin[0] == pytest.approx(found.begin[1])
    assert found.share[0] == pytest.approx(1)


def test_no_scatter_begins_nowhere() -> None:
    found = differences(["all"], np.linspace(0, 1, 4), np.ones((8, 4, 3, 3)), [np.arange(3)])
    assert np.isnan(found.begin).all()
    assert not found.new.any()


@pytest.mark.parametrize("split", [True, False])
def test_folding_modes_are_found_where_shapes_jump_and_only_there(split: bool) -> None:
    rng = np.random.default_rng(0)
    position = rng.normal(size=(12, 3))
    parameters = rng.normal(size=(300, 2))
    shape, other = rng.normal(size=(2, 12, 3))
    ends = 0.01 * parameters[:, :1, None] * shape + 0.02 * parameters[:, 1:, None] * other
    if split:
        ends = ends + 0.2 * (parameters[:, :1, None] > 0.5) * shape[::-1]
    found = folding_modes(position, ends, parameters)
    assert found.count == (2 if split else 1)
    if split:
        np.testing.assert_array_equal(found.group == 1, parameters[:, 0] > 0.5)
        assert found.group[found.typical[1]] == 1


def test_a_turn_of_the_whole_structure_is_no_folding_mode() -> None:
    rng = np.random.default_rng(0)
    position = rng.normal(size=(12, 3))
    angle = np.where(np.arange(100) % 2, 0.0, 0.5)
    turn = np.zeros((100, 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(angle)
    turn[:, 0, 1], turn[:, 1, 0], turn[:, 2, 2] = -np.sin(angle), np.sin(angle), 1
    ends = np.einsum("dij,nj->dni", turn, position) - position
    assert folding_modes(position, ends, angle[:, None]).count == 1
