"""The search for the best point within bounds, on problems with known answers."""

from __future__ import annotations

import numpy as np
import pytest

from surrogates.queries.optimum import LocalAnswer, Problem, sampled, search

LOW, HIGH = np.array([0.0, 0.0]), np.array([2.0, 4.0])


def found(values, low=LOW, high=HIGH, shift=(0.0,), starts: int = 4) -> list[LocalAnswer]:  # type: ignore[no-untyped-def]
    problem = Problem(values, low, high)
    box = sampled(problem, 64, 0, lambda done: None)
    return search(problem, box, np.array(shift), starts, [])


def product(x: np.ndarray) -> np.ndarray:
    """x + y is made small while x y >= 1."""
    return np.stack([x.sum(axis=1), 1 - x[:, 0] * x[:, 1]], axis=1)


def test_a_bound_is_reached() -> None:
    best = found(product)[0]
    assert best.kept
    assert np.allclose(best.parameters, [1, 1], atol=0.02)
    assert best.value == pytest.approx(2.0, abs=0.02)


def test_a_tightened_bound_is_kept_with_its_margin() -> None:
    best = found(product, shift=(0.44,))[0]
    assert np.allclose(best.parameters, [1.2, 1.2], atol=0.03)
    assert best.excess[0] == pytest.approx(-0.44, abs=0.01)


def test_given_parameters_stay() -> None:
    best = found(product, np.array([0.5, 0.0]), np.array([0.5, 4.0]))[0]
    assert np.allclose(best.parameters, [0.5, 2.0], atol=0.02)


def test_where_nothing_is_kept_the_least_is_broken() -> None:
    best = found(lambda x: np.stack([x.sum(axis=1), 20 - x[:, 0] * x[:, 1]], axis=1))[0]
    assert not best.kept
    assert np.allclose(best.parameters, HIGH, atol=0.02)
    assert best.excess[0] == pytest.approx(12, abs=0.2)


def test_several_valleys_are_found_the_deepest_first() -> None:
    def values(x: np.ndarray) -> np.ndarray:
        left = np.exp(-np.square((x - [0.4, 1.0]) / [0.2, 0.5]).sum(axis=1))
        right = np.exp(-np.square((x - [1.6, 3.0]) / [0.2, 0.5]).sum(axis=1))
        return -(left + 1.5 * right)[:, None]

    ends = found(values, shift=(), starts=8)
    assert np.allclose(ends[0].parameters, [1.6, 3.0], atol=0.05)
    assert any(np.allclose(e.parameters, [0.4, 1.0], atol=0.05) for e in ends[1:])
