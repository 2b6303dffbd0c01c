"""Runs that fill a box, and the criterion that chooses among candidates."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surrogates.design.criteria import ExpectedReduction, Posterior
from surrogates.design.judgement import judge
from surrogates.design.space import fill
from surrogates.errors import SurrogateError

LOW, HIGH = np.array([5.0, -45.0]), np.array([35.0, 45.0])


@given(st.integers(2, 40), st.integers(0, 100), st.sampled_from(["halton", "sobol", "random"]))
def test_points_lie_in_the_box_and_reach_its_edges(count: int, seed: int, sequence: str) -> None:
    points = fill(LOW, HIGH, count, seed=seed, sequence=sequence, edges=True)  # type: ignore[arg-type]
    assert points.shape == (count, 2)
    assert np.allclose(points.min(axis=0), LOW)
    assert np.allclose(points.max(axis=0), HIGH)


def test_the_same_seed_gives_the_same_points_and_another_gives_others() -> None:
    assert np.array_equal(fill(LOW, HIGH, 8, seed=3), fill(LOW, HIGH, 8, seed=3))
    assert not np.array_equal(fill(LOW, HIGH, 8, seed=3), fill(LOW, HIGH, 8, seed=4))


def test_a_sequence_goes_on_where_it_was() -> None:
    assert np.array_equal(fill(LOW, HIGH, 12)[8:], fill(LOW, HIGH, 4, skip=8))


def test_constraints_hold_also_after_stretching() -> None:
    def allowed(points: np.ndarray) -> np.ndarray:
        return points[:, 1] <= 2 * points[:, 0] - 30

    assert allowed(fill(LOW, HIGH, 32, allowed=allowed, edges=True)).all()


def test_an_empty_box_is_refused() -> None:
    with pytest.raises(SurrogateError, match="constraints leave 0"):
        fill(LOW, HIGH, 4, allowed=lambda p: np.zeros(len(p), bool))


def _kernel(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * ((a[:, None] - b[None]) ** 2).sum(axis=2) / 0.3**2)


def _posterior(known: np.ndarray, images: bool = False) -> Posterior:
    def inputs(points: np.ndarray) -> list[np.ndarray]:
        return [points, points * np.array([1, -1])] if images else [points]

    return Posterior(_kernel, 1e-4, inputs, known)


def deviation(belief: Posterior) -> float:
    return float(np.sqrt(belief.variance(GRID) + belief.noise).mean())


GRID = np.stack(np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9)), axis=-1).reshape(-1, 2)


def test_the_reduction_is_what_the_deviation_falls_by() -> None:
    belief = _posterior(np.array([[0.0, 0.0], [0.5, 0.5]]))
    candidate = np.array([[-0.4, 0.2]])
    fall = deviation(belief) - deviation(belief.with_runs(candidate))
    assert belief.reductions(candidate, GRID, np.full(len(GRID), 1 / len(GRID)))[0] == pytest.approx(fall, rel=1e-6)


def test_an_image_counts_as_a_run() -> None:
    belief = _posterior(np.array([[0.0, 0.0]]), images=True)
    candidate = np.array([[0.3, 0.6]])
    fall = deviation(belief) - deviation(belief.with_runs(candidate))
    assert belief.reductions(candidate, GRID, np.full(len(GRID), 1 / len(GRID)))[0] == pytest.approx(fall, rel=1e-6)
    assert belief.with_runs(candidate).variance(candidate * [1, -1])[0] < 1e-3


def test_a_batch_does_not_cluster_and_keeps_away_from_what_is_known() -> None:
    chosen = ExpectedReduction(_posterior(np.array([[0.0, 0.0]])), GRID).ask(GRID, 4)
    everything = np.concatenate([[[0.0, 0.0]], chosen])
    apart = np.linalg.norm(everything[:, None] - everything[None], axis=2)[np.triu_indices(5, 1)]
    assert apart.min() > 0.5


def test_a_batch_is_what_is_asked_for_one_after_the_other() -> None:
    candidates = np.concatenate([GRID[::7], GRID[::7] + 0.01])  # two of everything: the second brings nothing any more
    alone = ExpectedReduction(_posterior(np.array([[0.1, 0.2]])), GRID)
    expected = []
    for _ in range(4):
        expected.append(alone.ask(candidates, 1)[0])
        alone.tell(expected[-1])
    batch = ExpectedReduction(_posterior(np.array([[0.1, 0.2]])), GRID).ask(candidates, 4)
    np.testing.assert_array_equal(batch, expected)


def test_a_weighted_corner_is_asked_for_first() -> None:
    weights = np.exp(-((GRID - [0.75, 0.75]) ** 2).sum(axis=1) / 0.1)
    chosen = ExpectedReduction(_posterior(np.array([[0.0, 0.0]])), GRID, weights).ask(GRID, 1)
    assert np.linalg.norm(chosen[0] - [0.75, 0.75]) < 0.36


def test_told_points_count_as_computed() -> None:
    method = ExpectedReduction(_posterior(np.array([[0.0, 0.0]])), GRID)
    first = method.ask(GRID, 1)
    method.tell(first)
    assert not np.array_equal(method.ask(GRID, 1), first)


def test_the_error_over_the_box_is_the_deviation_there_times_the_ratio_at_left_out_runs() -> None:
    errors, deviations = np.array([1.0, 3.0, 8.0, 3.0]), np.array([0.5, 1.0, 2.0, 1.0])
    found = judge(errors, deviations, np.array([1.0, 3.0]), 0.9)
    assert found.error == pytest.approx(2.0 * np.mean([2, 3, 4, 3]))
    assert found.low < found.error < found.high
    assert found.below(2 * found.high)
    assert not found.below(found.error)  # half of the resamples lie above it


def test_an_interval_of_few_runs_is_wider_by_t_against_normal_quantiles() -> None:
    """Two runs: a resample's mean is one of them, or, half of the time, the mean of both."""
    found = judge(np.array([1.0, 3.0]), np.ones(2), np.ones(3), 0.9)
    wider = 6.313752 / 1.644854  # 95 % quantiles of t with one degree of freedom, and of the normal distribution
    assert (found.low, found.high) == pytest.approx((2 * 0.5**wider, 2 * 1.5**wider), rel=1e-5)
    assert (found.runs, found.confidence) == (2, 0.9)


@given(st.integers(0, 30))
def test_an_interval_holds_a_known_mean_about_as_often_as_it_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    hits = []
    for k in range(60):
        errors = rng.lognormal(0.0, 0.5, 24)
        found = judge(errors, np.ones(24), np.ones(5), 0.9, seed=k)
        hits.append(found.low <= np.exp(0.125) <= found.high)
    assert np.mean(hits) >= 0.75
