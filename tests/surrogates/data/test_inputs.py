"""From parameters and time to what a regression reads."""

from __future__ import annotations

import numpy as np
import plate
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from surrogates.data.inputs import InputScaling, Ranges

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
