"""Inputs derived from units."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surrogates.errors import SurrogateError
from surrogates.physics.derived import (
    LENGTH,
    SPEED,
    STRESS,
    DerivedInputs,
    candidates,
    is_free,
    logarithms,
    monomial,
    parse_monomial,
    places_for,
    with_matrix,
    with_monomial,
)

NAMES = ("speed", "offset", "beam", "box", "strength")
KINDS = (SPEED, LENGTH, LENGTH, LENGTH, STRESS)
RUNS = np.random.default_rng(0).uniform([4, -0.3, 1e-3, 1e-3, 2e8], [16, 0.3, 3e-3, 2e-3, 7e8], (20, 5))


@pytest.mark.parametrize(
    ("text", "powers"),
    [
        ("speed**2/strength", (2, 0, 0, 0, -1)),
        ("speed^2 / (strength * box**2)", (2, 0, 0, -2, -1)),
        ("(beam/box)**0.5", (0, 0, 0.5, -0.5, 0)),
        ("strength**(-1)*speed*speed", (2, 0, 0, 0, -1)),
    ],
)
def test_monomials_are_read(text: str, powers: tuple[float, ...]) -> None:
    assert parse_monomial(text, NAMES) == powers


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("speed**2/", "its end"),
        ("speed+strength", r"\+"),
        ("speed/weight", "no parameter; there are speed"),
        ("speed/speed", "is constant"),
        ("__import__('os').system('true')", "__import__"),
        ("speed**strength", "not understood"),
        ("(speed", "lacks a closing bracket"),
        ("speed)", "not understood"),
        ("2*speed", "not understood"),
    ],
)
def test_what_is_no_monomial_is_refused_and_nothing_evaluated(text: str, told: str) -> None:
    with pytest.raises(SurrogateError, match=told):
        parse_monomial(text, NAMES)


@given(st.lists(st.integers(-3, 3), min_size=5, max_size=5).filter(any))
def test_what_is_written_is_read_again(powers: list[int]) -> None:
    text = monomial(powers, NAMES).replace(" / ", "/").replace(" ", "*")
    assert parse_monomial(text.removeprefix("1/") if text.startswith("1/") else text, NAMES) == (
        tuple(-p for p in powers) if text.startswith("1/") else tuple(powers)
    )


def test_units_allow_damage_numbers_and_ratios_of_one_kind_alone() -> None:
    found = {monomial(powers, NAMES) for powers in candidates(NAMES, KINDS, RUNS)}
    assert found >= {"speed^2 / strength", "speed^2 / (box^2 strength)", "beam / box"}
    assert not any("offset" in text for text in found)  # it changes its sign
    assert all(is_free(parse_monomial(t.replace(" / ", "/").replace(" ", "*"), NAMES), KINDS) for t in found)
    assert not is_free((1, 0, 0, 0, -1), KINDS)
    assert not candidates(NAMES, (None,) * 5, RUNS)


def test_what_is_odd_is_warped_and_not_in_a_logarithm_whatever_its_sign() -> None:
    assert logarithms(NAMES, RUNS, warp=True, odd=["box"]).told()[3] == f"asinh(box / {RUNS[:, 3].max() / 3:.3g})"
    assert logarithms(NAMES, RUNS, warp=False, odd=["box"]).told()[3] == "box"
    assert logarithms(NAMES, RUNS, warp=True).told()[3] == "ln(box)"


def test_inputs_can_be_undone_and_stored() -> None:
    inputs = with_monomial(logarithms(NAMES, RUNS, warp=True), parse_monomial("speed**2/(strength*box**2)", NAMES), 4)
    inputs = with_matrix(inputs, ["offset"])
    assert inputs.mixed == (0, 2, 3, 4)
    assert DerivedInputs.from_dict(inputs.as_dict()) == inputs
    np.testing.assert_allclose(inputs.undo(inputs.apply(RUNS)), RUNS, rtol=1e-9)
    assert inputs.told()[-1] == "ln(speed^2 / (box^2 strength))"


def test_a_monomial_never_takes_the_place_of_what_it_cannot_replace() -> None:
    inputs = logarithms(NAMES, RUNS, warp=False)
    powers = parse_monomial("beam/box", NAMES)
    assert places_for(inputs, powers) == [2, 3]
    assert places_for(with_monomial(inputs, powers, 2), powers) == [2]


def test_a_parameter_below_zero_is_refused_by_a_logarithm() -> None:
    with pytest.raises(SurrogateError, match="strength = -1: the model takes its logarithm"):
        logarithms(NAMES, RUNS, warp=True).apply(np.array([[5, 0, 1e-3, 1e-3, -1.0]]))


def test_the_identity_leaves_parameters_as_they_are() -> None:
    identity = DerivedInputs.identity(NAMES)
    assert identity.is_identity
    np.testing.assert_array_equal(identity.apply(RUNS), RUNS)
