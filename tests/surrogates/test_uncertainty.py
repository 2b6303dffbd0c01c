"""The band around predictions holds what it says."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surrogates.errors import SurrogateError
from surrogates.uncertainty import SHARES, Band, Beliefs, calibrate, coverage

TIME = np.linspace(0.0, 0.02, 11)


def distances(runs: int, seed: int, nodes: int = 40) -> list[np.ndarray]:
    """Errors that grow with time, differ between nodes, and vary from run to run."""
    random = np.random.default_rng(seed)
    pattern = (0.1 + TIME / TIME[-1])[:, None] * np.random.default_rng(0).uniform(0.2, 2.0, nodes)
    return [(pattern * random.gamma(4.0, 0.25, pattern.shape)).astype(np.float32) for _ in range(runs)]


@pytest.mark.parametrize("share", [0.5, 0.8, 0.9, 0.95])
def test_the_share_asked_for_lies_within_the_band_in_new_runs(share: float) -> None:
    band = calibrate(distances(12, seed=1), TIME)
    found = coverage(np.stack(distances(40, seed=2)), band.half_width(share, TIME))
    assert found == pytest.approx(share, abs=0.03)


def test_the_band_is_wide_where_and_when_errors_were_large() -> None:
    width = calibrate(distances(12, seed=1), TIME).half_width(0.9, TIME)
    expected = np.mean(distances(500, seed=3), axis=0)
    assert np.corrcoef(width.ravel(), expected.ravel())[0, 1] > 0.98


@settings(max_examples=20, deadline=None)
@given(factor=st.floats(1e-3, 1e3))
def test_the_band_scales_with_the_errors(factor: float) -> None:
    given_ = distances(3, seed=4)
    one = calibrate(given_, TIME).half_width(0.8, TIME)
    other = calibrate([d * np.float32(factor) for d in given_], TIME).half_width(0.8, TIME)
    np.testing.assert_allclose(other, factor * one, rtol=1e-3)


def test_a_larger_share_needs_a_wider_band() -> None:
    band = calibrate(distances(3, seed=5), TIME)
    widths = [band.half_width(share, TIME) for share in (0.5, 0.75, 0.99)]
    assert (widths[0] < widths[1]).all()
    assert (widths[1] < widths[2]).all()


def test_errors_of_zero_give_a_band_that_is_no_division_by_zero() -> None:
    width = calibrate([np.zeros((11, 5), np.float32)] * 3, TIME).half_width(0.9, TIME)
    assert np.isfinite(width).all()


def test_one_validation_run_is_not_enough() -> None:
    with pytest.raises(SurrogateError, match="at least 2 validation runs; found 1"):
        calibrate(distances(1, seed=0), TIME)


@pytest.mark.parametrize("share", [0.2, 1.0])
def test_shares_it_has_no_quantile_for_are_refused(share: float) -> None:
    with pytest.raises(SurrogateError, match=r"expected 0.5 to 0.99"):
        calibrate(distances(3, seed=0), TIME).half_width(share, TIME)


def test_each_validation_run_is_judged_by_the_others() -> None:
    """A run that is k times as wrong as the only other one lies k times as far out as that one would have said."""
    small, large = 0.002, 0.006
    band = calibrate([np.full((11, 4), small, np.float32), np.full((11, 4), large, np.float32)], TIME)
    typical = (small + large) / 2
    np.testing.assert_allclose(band.half_width(0.9, TIME), large / small * typical, rtol=1e-5)
    np.testing.assert_allclose(band.half_width(0.5, TIME), (large / small + small / large) / 2 * typical, rtol=1e-2)


def test_two_validation_runs_already_hold_nine_tenths_of_a_new_run() -> None:
    """Runs that differ as a whole: a scale taken from the judged runs themselves would hold 77 % only."""
    random = np.random.default_rng(11)
    pattern = (0.1 + TIME / TIME[-1])[:, None] * random.uniform(0.2, 2.0, 30)

    def run() -> np.ndarray:
        return (random.lognormal(0.0, 0.5) * pattern * random.gamma(4.0, 0.25, pattern.shape)).astype(np.float32)

    held = [coverage(np.stack([run()]), calibrate([run(), run()], TIME).half_width(0.9, TIME)) for _ in range(200)]
    assert 0.84 < np.mean(held) < 0.93


def test_the_band_is_the_quantile_of_pooled_ratios_times_the_scale() -> None:
    """The definition, in loops (Dunn, Wasserman, Ramdas 2022, pooling CDFs)."""
    given_ = distances(3, seed=8, nodes=6)

    def scale(runs: list[np.ndarray]) -> np.ndarray:
        node = np.mean([r.mean(axis=0) for r in runs], axis=0)
        state = np.mean([r.mean(axis=1) for r in runs], axis=0)
        return state[:, None] / state.mean() * node

    ratios = [given_[k] / scale([r for j, r in enumerate(given_) if j != k]) for k in range(3)]
    band = calibrate(given_, TIME)
    assert band.runs == 3
    for share in (0.5, 0.77, 0.99):
        expected = np.quantile(np.concatenate([r.ravel() for r in ratios]), share) * scale(given_)
        np.testing.assert_allclose(band.half_width(share, TIME), expected, rtol=1e-5)


def test_between_states_and_shares_the_width_is_interpolated() -> None:
    factor = np.linspace(1.0, 2.0, len(SHARES))
    band = Band(np.array([1.0, 3.0], np.float32), np.array([0.0, 2.0, 4.0]), np.array([0.0, 1.0, 3.0]), factor, 2)
    found = band.half_width(0.5, np.array([0.0, 0.5, 2.0, 9.0]))
    np.testing.assert_allclose(found, [[0, 0], [1, 3], [3, 9], [4, 12]])
    assert found.dtype == np.float32
    middle = band.half_width((SHARES[3] + SHARES[4]) / 2, np.array([1.0]))
    np.testing.assert_allclose(middle[0], 2.0 * (factor[3] + factor[4]) / 2 * np.array([1, 3]), rtol=1e-6)


def test_shares_go_in_hundredths_from_a_half_to_99_in_100() -> None:
    np.testing.assert_allclose(SHARES, np.arange(50, 100) / 100)
    band = calibrate(distances(3, seed=0), TIME)
    assert (band.half_width(0.5, TIME) <= band.half_width(0.99, TIME)).all()


def test_a_node_or_state_that_was_exact_keeps_a_thousandth_of_the_mean() -> None:
    given_ = distances(3, seed=6)
    for d in given_:
        d[:, 7] = 0
        d[0] = 0
    band = calibrate(given_, TIME)
    mean = np.mean(given_)
    assert band.node[7] == pytest.approx(1e-3 * mean, rel=1e-5)
    assert band.state[0] == pytest.approx(1e-3)
    assert np.isfinite(band.half_width(0.99, TIME)).all()


def test_of_many_nodes_some_spread_over_all_are_pooled_and_change_nothing() -> None:
    """A third of the nodes errs differently in kind; were only the first nodes pooled, the band would miss it."""
    random = np.random.default_rng(3)
    spread = np.repeat([0.1, 0.1, 1.0], 3000)
    runs = [np.exp(spread * random.normal(size=(3, 9000))).astype(np.float32) for _ in range(2)]
    band = calibrate(runs, TIME[:3])
    new = np.exp(spread * random.normal(size=(3, 9000))).astype(np.float32)
    assert coverage(new, band.half_width(0.9, TIME[:3])) == pytest.approx(0.9, abs=0.02)
    assert len(band.node) == 9000


def test_coverage_counts_what_lies_on_the_edge_of_the_band_as_inside() -> None:
    width = np.array([[1.0, 2.0]], np.float32)
    assert coverage(np.array([[[1.0, 2.1]], [[0.5, 2.0]]], np.float32), width) == 0.75


def test_runs_that_the_model_knows_to_be_harder_get_wider_bands_and_the_promise_holds_for_each_kind() -> None:
    random = np.random.default_rng(12)

    def runs(count: int) -> tuple[list[np.ndarray], Beliefs]:
        size, deviation = random.uniform(0.3, 3.0, count), random.uniform(0.5, 2.0, count)
        scale = size * np.sqrt(deviation)
        return [s * d for s, d in zip(scale, distances(count, seed=13), strict=True)], Beliefs(size, deviation)

    band = calibrate(*(lambda pair: (pair[0], TIME, pair[1]))(runs(30)))
    assert band.spread == "deviation"
    others, beliefs = runs(60)
    held = [
        coverage(d[None], band.half_width(0.9, TIME, Beliefs(beliefs.size[[k]], beliefs.deviation[[k]])))
        for k, d in enumerate(others)
    ]
    order = np.argsort(beliefs.size)
    assert np.mean(held) == pytest.approx(0.9, abs=0.03)
    assert min(np.mean(np.array(held)[third]) for third in np.array_split(order, 3)) > 0.85


def test_beliefs_that_say_nothing_leave_the_band_as_it_is() -> None:
    random = np.random.default_rng(14)
    nothing = Beliefs(np.exp(random.normal(0, 1, 12)), np.exp(random.normal(0, 1, 12)))
    band = calibrate(distances(12, seed=1), TIME, nothing)
    assert band.spread == "constant"
    np.testing.assert_allclose(band.half_width(0.9, TIME), calibrate(distances(12, seed=1), TIME).half_width(0.9, TIME))


def test_a_run_that_comes_several_times_never_judges_itself() -> None:
    once = distances(4, seed=1)
    twice = calibrate([*once, *once], TIME, runs=np.array([0, 1, 2, 3, 0, 1, 2, 3]))
    np.testing.assert_allclose(twice.half_width(0.9, TIME), calibrate(once, TIME).half_width(0.9, TIME), rtol=1e-5)
    assert twice.runs == 4


def test_nodes_that_are_gone_are_in_no_band() -> None:
    draw = np.random.default_rng(0)
    runs = [draw.rayleigh(0.01, (6, 40)).astype(np.float32) for _ in range(8)]
    gone = [run.copy() for run in runs]
    for run in gone:
        run[4:, :5] = np.nan
    time = np.arange(6.0)
    whole, some = calibrate(runs, time).half_width(0.9, time), calibrate(gone, time).half_width(0.9, time)
    assert np.isfinite(some).all()
    there = np.isfinite(np.stack(gone))
    assert (np.stack(runs) <= some)[there].mean() == pytest.approx(0.9, abs=0.03)
    np.testing.assert_allclose(some.mean(), whole.mean(), rtol=0.05)


def test_runs_that_are_harder_say_no_more_about_which_nodes_are_hard() -> None:
    """Easy runs are half as bad again on node 1, hard ones on node 0: measured by the size of each run, nodes are alike."""
    size = np.array([1.0, 100.0] * 4)
    profile = {1.0: [2.0, 3.0], 100.0: [3.0, 2.0]}
    told = [np.full((3, 1), s, np.float32) * np.float32(profile[s]) for s in size]
    band = calibrate(told, np.arange(3.0), Beliefs(size, np.ones(8)))
    assert band.node[0] == pytest.approx(band.node[1], rel=1e-6)
