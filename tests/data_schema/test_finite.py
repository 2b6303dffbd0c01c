"""Finite numbers are told from others by their sum, and by each where the sum says nothing."""

from __future__ import annotations

import numpy as np
import pytest

from data_schema.finite import all_finite


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_one_bad_number_among_many_is_found(bad: float) -> None:
    values = np.ones((4, 500, 3), np.float32)
    assert all_finite(values)
    values[2, 17, 1] = bad
    assert not all_finite(values)


def test_infinities_of_both_signs_do_not_hide_each_other() -> None:
    assert not all_finite(np.array([np.inf, -np.inf], np.float32))


def test_finite_numbers_whose_sum_overflows_are_finite() -> None:
    assert all_finite(np.full(8, 3e38, np.float32))


def test_nothing_is_finite() -> None:
    assert all_finite(np.empty(0, np.float32))
