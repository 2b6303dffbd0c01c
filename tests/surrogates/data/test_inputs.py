"""From parameters and time to what a regression reads."""

from __future__ import annotations

import numpy as np
import plate
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from surrogates.data.inputs import Ranges, far_outside, over_range
from surrogates.data.scaling import InputScaling

NAMES, UNITS = ("impact_speed", "impact_angle", "yield_stress"), ("m s-1", "degree", "Pa")


def ranges(parameters: np.ndarray) -> Ranges:
    return Ranges.of(NAMES, UNITS, parameters, plate.TIME)


def scaled(scaling: InputScaling, parameters: np.ndarray, time: np.ndarray) -> torch.Tensor:
    return scaling(torch.from_numpy(parameters), torch.from_numpy(time))


def test_the_trained_ranges_become_minus_one_to_one() -> None:
    r = ranges(plate.parameters(20))
    corners = scaled(InputScaling(r), np.stack([r.low, r.high]), np.array(r.time))
    np.testing.assert_array_equal(corners, [[-1] * 4, [1] * 4])


@given(hnp.arrays(np.float64, (6, 3), elements=st.floats(-1e3, 1e3)), st.booleans(), st.booleans())
def test_every_input_of_a_training_run_lies_in_minus_one_to_one(mu: np.ndarray, products: bool, angles: bool) -> None:
    scaling = InputScaling(ranges(mu), products=products, angles=angles)
    time = np.linspace(*ranges(mu).time, 6)
    out = scaled(scaling, mu, time)
    assert out.shape == (6, scaling.size)
    # Sines and cosines over several turns have extremes that a few points along the range may miss.
    assert out[:, : 4 + 3 * products].abs().max() <= 1 + 1e-5
    assert torch.isfinite(out).all()


def test_a_constant_parameter_becomes_zero() -> None:
    mu = plate.parameters(5)
    mu[:, 2] = 3e8
    assert ranges(mu).constant == ("yield_stress",)
    other = mu.copy()
    other[:, 2] = 5e8
    assert (scaled(InputScaling(ranges(mu)), other, np.zeros(5))[:, 2] == 0).all()


def test_products_and_angles_are_what_they_say() -> None:
    r = Ranges(NAMES, UNITS, np.array([0.0, -90.0, 0.0]), np.array([10.0, 90.0, 1.0]), (0.0, 2.0))
    out = scaled(InputScaling(r, products=True, angles=True), np.array([[5.0, 30.0, 1.0]]), np.array([1.0]))[0]
    assert len(out) == 4 + 3 + 2
    np.testing.assert_allclose(out[4], 2 * 5.0 / 20.0 - 1)  # speed * time over 0 .. 20
    np.testing.assert_allclose(out[7], np.sin(np.radians(30.0)), rtol=1e-6)  # over -1 .. 1


def test_inputs_can_be_differentiated_by_the_parameters() -> None:
    scaling = InputScaling(ranges(plate.parameters(6)), products=True, angles=True)
    mu = torch.from_numpy(plate.parameters(3)).requires_grad_()
    scaling(mu, torch.full((3,), 0.01, dtype=torch.float64)).sum().backward()
    assert (mu.grad != 0).all()


def test_values_outside_are_told_with_name_unit_and_range() -> None:
    r = Ranges(NAMES, UNITS, np.array([10.0, -10.0, 3e8]), np.array([30.0, 10.0, 3e8]), (0.0, 0.03))
    said = r.outside(np.array([35.0, 0.0, 4e8]), np.array([0.0, 0.05]))
    assert said == [
        "impact_speed = 35 m s-1 is outside the trained range 10 to 30 m s-1",
        "yield_stress = 4e+08 Pa is outside the trained range only 3e+08 Pa",
        "time = 0.05 s is outside the trained range 0 to 0.03 s",
    ]
    assert r.outside(np.array([30.0, -10.0, 3e8]), np.array([0.0, 0.03])) == []


def box(
    *bounds: tuple[float, float], units: tuple[str, ...] | None = None, time: tuple[float, float] = (0.0, 1.0)
) -> Ranges:
    low, high = np.array(bounds, float).T
    return Ranges(tuple("abc"[: len(bounds)]), units or ("m",) * len(bounds), low, high, time)


def test_ranges_are_lowest_and_highest_of_the_training_runs() -> None:
    found = Ranges.of(
        ["a", "b"], ["m", "s"], np.array([[1.0, 5.0], [3.0, -2.0], [2.0, 0.0]]), np.array([0.5, 0.7, 2.0])
    )
    assert (found.names, found.units) == (("a", "b"), ("m", "s"))
    assert (found.low.tolist(), found.high.tolist(), found.time) == ([1.0, -2.0], [3.0, 5.0], (0.5, 2.0))
    assert found.constant == ()


def test_what_lies_below_is_told_as_what_lies_above() -> None:
    r = box((1.0, 2.0), (-3.0, 3.0), (0.0, 1.0), units=("m", "", "1"), time=(0.1, 0.2))
    assert r.outside(np.array([0.5, 4.0, 2.0]), np.array([0.05, 0.15])) == [
        "a = 0.5 m is outside the trained range 1 to 2 m",
        "b = 4 is outside the trained range -3 to 3",
        "c = 2 is outside the trained range 0 to 1",
        "time = 0.05 s is outside the trained range 0.1 to 0.2 s",
    ]


def test_of_several_runs_the_one_furthest_outside_is_told() -> None:
    r = box((1.0, 2.0))
    many = np.array([[2.5], [-3.0], [1.5], [4.0]])
    assert r.outside(many, np.array([0.0])) == ["a = -3 m is outside the trained range 1 to 2 m"]
    assert r.outside(many[[0, 2]], np.array([0.0])) == ["a = 2.5 m is outside the trained range 1 to 2 m"]


def test_rounding_is_not_outside() -> None:
    r = box((1e8, 2e8), (-2.0, -1.0), time=(0.0, 0.03))
    just = np.array([2e8 * (1 + 1e-10), -2.0 * (1 + 1e-10)])
    assert r.outside(just, np.array([-1e-13, 0.03 * (1 + 1e-10)])) == []
    assert len(r.outside(np.array([2e8 * (1 + 1e-8), -2.0 * (1 + 1e-8)]), np.array([0.03 * (1 + 1e-8)]))) == 3
    assert len(r.outside(np.array([1.5e8, -1.0]), np.array([-1e-11]))) == 1


@pytest.mark.parametrize("bounds", [(-1.0, 2.0), (-2.0, -1.0), (1.0, 2.0)])
@pytest.mark.parametrize("time", [(0.0, 2.0), (1.0, 3.0)])
def test_products_fill_their_range(bounds: tuple[float, float], time: tuple[float, float]) -> None:
    scaling = InputScaling(box(bounds, (0.0, 1.0), time=time), products=True)
    a, t = (m.ravel() for m in np.meshgrid(np.linspace(*bounds, 21), np.linspace(*time, 21)))
    out = scaled(scaling, np.stack([a, np.full_like(a, 0.5)], axis=1), t)
    product = a * t
    np.testing.assert_allclose(out[:, 3], 2 * (product - product.min()) / np.ptp(product) - 1, atol=1e-6)


def test_sine_and_cosine_of_a_symmetric_range_fill_theirs() -> None:
    out = scaled(
        InputScaling(box((-60.0, 60.0), units=("deg",)), angles=True), np.array([[-60.0], [0.0], [60.0]]), np.zeros(3)
    )
    np.testing.assert_allclose(out[:, 2], [-1, 0, 1], atol=1e-6)
    np.testing.assert_allclose(out[:, 3], [-1, 1, -1], atol=1e-6)


@pytest.mark.parametrize(("unit", "more"), [("degree", 2), ("deg", 2), ("°", 2), ("m", 0), ("rad", 0)])
def test_only_parameters_in_degree_have_sine_and_cosine(unit: str, more: int) -> None:
    r = box((0.0, 1.0), (0.0, 30.0), units=("m", unit))
    assert InputScaling(r, angles=True).size == 3 + more
    assert InputScaling(r).size == 3


def test_columns_are_parameters_time_products_then_sines_and_cosines() -> None:
    r = box((-1.0, 1.0), (-90.0, 90.0), (-180.0, 180.0), units=("m", "deg", "deg"), time=(-1.0, 1.0))
    out = scaled(InputScaling(r, products=True, angles=True), np.array([[0.5, 30.0, -90.0]]), np.array([0.5]))[0]
    np.testing.assert_allclose(out[:4], [0.5, 1 / 3, -0.5, 0.5], atol=1e-6)
    np.testing.assert_allclose(out[4:7], [0.25, 1 / 6, -0.25], atol=1e-6)
    assert len(out) == 11
    assert out[7] == pytest.approx(0.5, abs=1e-6)  # sin 30, over -1 .. 1
    assert out[9] == pytest.approx(2 * np.cos(np.radians(30)) - 1, abs=1e-6)  # cos 30, over 0 .. 1


def test_a_small_change_of_a_large_parameter_is_seen() -> None:
    """In single precision 3e8 and 3e8 + 10 are the same."""
    scaling = InputScaling(box((3e8, 3e8 + 100)))
    out = scaled(scaling, np.array([[3e8 + 10], [3e8 + 20]]), np.zeros(2))
    np.testing.assert_allclose(out[:, 0], [-0.8, -0.6], atol=1e-6)
    assert out.dtype == torch.float32


def test_the_ranges_are_not_among_the_weights() -> None:
    assert InputScaling(box((0.0, 1.0))).state_dict() == {}


def test_values_outside_are_told_in_the_unit_people_write() -> None:
    r = Ranges(("yield",), ("Pa",), np.array([2e8]), np.array([3e8]), (0.0, 1.0), (("MPa", 1e6),))
    assert r.outside(np.array([4e8]), np.zeros(1)) == ["yield = 400 MPa is outside the trained range 200 to 300 MPa"]
    constant = Ranges(("yield",), ("Pa",), np.array([2e8]), np.array([2e8]), (0.0, 1.0), (("MPa", 1e6),))
    assert constant.outside(np.array([4e8]), np.zeros(1)) == [
        "yield = 400 MPa is outside the trained range only 200 MPa"
    ]


@pytest.mark.parametrize(
    ("parameters", "time", "far"),
    [
        ([3.0, 5.0], [0.1, 0.3], []),
        ([4.4, 5.0], [0.06, 0.34], []),
        ([4.6, 5.0], [0.1], ["a"]),
        ([0.2, 5.0], [0.1], ["a"]),
        ([0.4, 5.0], [0.1], []),
        ([2.0, 5.1], [0.1], ["b"]),
        ([2.0, 4.9], [0.1], ["b"]),
        ([2.0, 5.0], [0.04, 0.2], ["time"]),
        ([2.0, 5.0], [0.2, 0.36], ["time"]),
        ([[2.0, 5.0], [9.0, 6.0]], [0.36], ["a", "b", "time"]),
    ],
)
def test_far_outside_is_more_than_a_quarter_of_the_range(parameters: list, time: list[float], far: list[str]) -> None:
    r = box((1.0, 3.8), (5.0, 5.0), time=(0.1, 0.3))
    assert far_outside(r, np.array(parameters), np.array(time)) == far


def test_inputs_over_the_range_of_others_and_without_what_is_constant_there() -> None:
    over = np.array([[0.0, 7.0, 10.0], [4.0, 7.0, 20.0]])
    np.testing.assert_allclose(over_range(np.array([[1.0, 7.0, 25.0]]), over), [[-0.5, 2.0]])
    np.testing.assert_allclose(over_range(np.array([4.0, 0.0, 15.0]), over), [[1.0, 0.0]])
