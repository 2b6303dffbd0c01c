"""Sensors of a simulated run: differentiation, CFC filters, intrusion and ratings."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import butter
from scipy.spatial.transform import Rotation

from evaluation.errors import EvaluationError
from evaluation.measures.probes import (
    CFC_CLASSES,
    cfc_coefficients,
    cfc_filter,
    intrusion,
    possible_classes,
    probe_histories,
    rate,
)

KART = np.linspace(0, 0.03, 101)  # 0.3 ms
DENSE = np.arange(0, 0.1, 5e-5)  # 20 kHz


# --- histories


@given(v=st.floats(-40, 40), a=st.floats(-3000, 3000), uneven=st.booleans())
def test_constant_acceleration_is_differentiated_exactly(v, a, uneven):
    t = np.linspace(0, 0.03, 21) ** (1.5 if uneven else 1.0) / 0.03 ** (0.5 if uneven else 0.0)
    u = np.zeros((21, 4, 3))
    u[:, 2, 0] = v * t + a * t**2 / 2
    found = probe_histories(t, u, [2])
    np.testing.assert_allclose(found.velocity[:, 0, 0], v + a * t, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(found.acceleration[:, 0, 0], a, rtol=1e-6, atol=1e-4)


def test_acceleration_of_a_vibration_is_weaker_by_the_factor_that_is_documented():
    frequency, step = 200.0, 3e-4
    t = np.arange(0, 0.1, step)
    u = np.zeros((len(t), 1, 3))
    u[:, 0, 1] = np.sin(2 * np.pi * frequency * t)
    a = 2 * np.pi * frequency * step
    expected = -((2 * np.pi * frequency) ** 2) * (np.sin(a) / a) ** 2 * u[:, 0, 1]
    np.testing.assert_allclose(probe_histories(t, u, 0).acceleration[3:-3, 0, 1], expected[3:-3], rtol=1e-6, atol=1e-3)


def test_a_node_that_is_gone_has_no_history_from_then_on():
    u = np.zeros((101, 2, 3))
    u[60:, 1] = np.nan
    found = probe_histories(KART, u, [0, 1])
    assert np.isfinite(found.acceleration[:, 0]).all()
    assert np.isfinite(found.displacement[:60, 1]).all()
    assert np.isnan(found.velocity[60:, 1]).all()


# --- SAE J211


@pytest.mark.parametrize("cfc", CFC_CLASSES)
def test_one_pass_is_the_butterworth_filter_of_scipy(cfc):
    numerator, denominator = cfc_coefficients(cfc, 5e-5)
    expected = butter(2, 2.0775 * cfc, fs=20_000)
    np.testing.assert_allclose(numerator, expected[0], rtol=1e-9)
    np.testing.assert_allclose(denominator, expected[1], rtol=1e-9)


@pytest.mark.parametrize(("cfc", "corner"), [(60, 100), (180, 300), (600, 1000), (1000, 1650)])
def test_the_filter_has_lost_3_db_at_the_standards_corner_and_shifts_nothing(cfc, corner):
    t = np.arange(0, 0.4, 2e-5)
    wave = np.sin(2 * np.pi * corner * t)
    middle = slice(5000, -5000)
    passed = cfc_filter(t, wave, cfc)[middle]
    gain = passed @ wave[middle] / (wave[middle] @ wave[middle])
    assert 20 * np.log10(gain) == pytest.approx(-3.0, abs=0.25)
    np.testing.assert_allclose(passed, gain * wave[middle], atol=2e-3)


@given(level=st.floats(-1e3, 1e3), slope=st.floats(-1e3, 1e3), cfc=st.sampled_from([60, 180]))
@settings(deadline=None)
def test_constants_and_ramps_pass_unchanged(level, slope, cfc):
    # The smallest numbers a float can hold have few digits left; no displacement is that small.
    np.testing.assert_allclose(cfc_filter(KART, np.full(101, level), cfc), level, rtol=1e-12, atol=1e-300)
    ramp = slope * KART
    np.testing.assert_allclose(cfc_filter(KART, ramp, cfc), ramp, atol=1e-300 + 1e-5 * abs(ramp[-1]))


@given(seed=st.integers(0, 20))
@settings(deadline=None)
def test_filtering_backwards_in_time_is_the_same(seed):
    curve = np.random.default_rng(seed).normal(size=101)
    forward, backward = cfc_filter(KART, curve, 60), cfc_filter(KART, curve[::-1], 60)[::-1]
    np.testing.assert_allclose(forward[10:-10], backward[10:-10], atol=2e-2)


def test_states_every_0_3_ms_allow_two_classes():
    assert possible_classes(KART) == (60, 180)
    assert possible_classes(DENSE) == CFC_CLASSES
    assert possible_classes(np.linspace(0, 0.03, 11)) == ()


def test_every_direction_of_every_probe_is_filtered_up_to_its_end():
    curves = np.random.default_rng(0).normal(size=(101, 2, 3))
    curves[50:, 1] = np.nan
    out = cfc_filter(KART, curves, 60)
    np.testing.assert_array_equal(np.isnan(out), np.isnan(curves))
    np.testing.assert_array_equal(out[:, 0, 2], cfc_filter(KART, curves[:, 0, 2], 60))
    np.testing.assert_array_equal(out[:50, 1, 0], cfc_filter(KART[:50], curves[:50, 1, 0], 60))


@pytest.mark.parametrize(
    ("time", "cfc", "message"),
    [
        (KART, 600, "CFC 600 needs 6 kHz, states every 0.167 ms; found every 0.3 ms; these states allow CFC 60, 180"),
        (np.linspace(0, 0.03, 11), 60, "found every 3 ms; they allow no class; let the solver write more states"),
        (DENSE, 100, "CFC 100 asked for: expected one of 60, 180, 600, 1000"),
        (np.r_[KART[:50], KART[51:]], 60, "states 0.3 to 0.6 ms apart: expected even times"),
        (KART[::-1], 60, "expected at least 4 increasing times"),
    ],
)
def test_impossible_filters_are_refused(time, cfc, message):
    with pytest.raises(EvaluationError, match=message):
        cfc_filter(time, np.zeros(len(time)), cfc)


def test_a_gap_is_no_curve():
    with pytest.raises(EvaluationError, match=r"curve 0 has a gap at 0\.003 s"):
        cfc_filter(KART, np.where(np.arange(101) == 10, np.nan, 1.0), 60)


# --- intrusion


def crash(angle: float) -> tuple[np.ndarray, np.ndarray]:
    """A box that flies and turns; its nodes 4 to 7 come in by 5, 10, 15, 20 cm towards -x in the last state."""
    x = np.array([[0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 1], [1, 0, 0], [1, 1, 0], [1, 0, 1], [1, 1, 1]], float)
    dented = np.repeat(x[None], 3, axis=0)
    dented[2, 4:, 0] -= [0.05, 0.10, 0.15, 0.20]
    rotation = Rotation.from_euler("xyz", [0, 0.3 * angle, angle], degrees=True).as_matrix()
    return x, dented @ rotation.T + [3.0, 0, 0] - x


@pytest.mark.parametrize("angle", [0.0, 40.0])
def test_intrusion_is_measured_from_the_reference_nodes_however_they_turn(angle):
    x, u = crash(angle)
    found = intrusion(x, u, nodes=[4, 5, 6, 7], direction=(-2, 0, 0), reference=[0, 1, 2, 3])
    assert found.largest == pytest.approx(0.20)
    assert (found.state, found.node) == (2, 7)
    np.testing.assert_allclose(found.history, [0, 0, 0.20], atol=1e-9)


def test_without_a_reference_intrusion_is_measured_from_the_ground():
    x, u = crash(0.0)
    assert intrusion(x, u, [5], (1, 0, 0)).history == pytest.approx([3, 3, 2.9])


def test_nodes_that_are_gone_do_not_intrude():
    x, u = crash(0.0)
    u[2, 7] = np.nan
    found = intrusion(x, u, [6, 7], (-1, 0, 0), [0, 1, 2, 3])
    assert (found.node, found.largest) == (6, pytest.approx(0.15))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"direction": (0, 0, 0)}, "expected three numbers that are not all zero"),
        ({"nodes": [8]}, "nodes of an intrusion: expected numbers from 0 to 7"),
        ({"nodes": []}, "at least one"),
        ({"reference": [0, 1]}, "2 reference nodes on one line"),
        ({"reference": [0, 1, 9]}, "reference of an intrusion: expected numbers from 0 to 7"),
    ],
)
def test_intrusions_that_cannot_be_measured_are_refused(change, message):
    x, u = crash(0.0)
    arguments = {"nodes": [4], "direction": (-1, 0, 0), "reference": [0, 1, 2, 3]} | change
    with pytest.raises(EvaluationError, match=message):
        intrusion(x, u, **arguments)


# --- ISO/TS 18571


def pulse(t: np.ndarray, late: float = 0.0, scale: float = 1.0) -> np.ndarray:
    return scale * np.exp(-(((t - 0.012 - late) / 0.004) ** 2))


@given(seed=st.integers(0, 1000))
@settings(deadline=None, max_examples=15)
def test_identical_curves_are_rated_one(seed):
    curve = np.random.default_rng(seed).normal(size=101).cumsum()
    rating = rate(KART, curve, curve)
    assert (rating.overall, rating.grade) == (pytest.approx(1.0), "excellent")


def test_a_later_curve_loses_phase_alone_and_a_smaller_one_magnitude():
    late = rate(KART, pulse(KART), pulse(KART, late=0.0015))
    small = rate(KART, pulse(KART), pulse(KART, scale=0.7))
    assert late.phase < 0.8
    assert small.phase == 1.0
    assert small.magnitude < 0.8 < late.magnitude
    assert small.overall == pytest.approx(
        0.4 * small.corridor + 0.2 * (small.phase + small.magnitude + small.slope), abs=1e-9
    )


def test_a_prediction_that_does_nothing_is_poor():
    assert rate(KART, pulse(KART), np.zeros(101)).grade == "poor"


@given(shift=st.floats(0.01, 0.5))
@settings(deadline=None, max_examples=15)
def test_a_worse_curve_is_not_rated_higher(shift):
    near, far = (rate(KART, pulse(KART), pulse(KART) + s).overall for s in (shift, shift + 0.1))
    assert far <= near


def test_curves_are_rated_up_to_where_either_ends():
    cut = pulse(KART)
    cut[80:] = np.nan
    assert rate(KART, cut, pulse(KART)).overall == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("time", "truth", "message"),
    [
        (KART, np.full(101, 3.0), "the true curve never changes"),
        (KART[:6], pulse(KART[:6]), "curves of 16 samples at 10 kHz: expected at least 20"),
        (KART, np.where(np.arange(101) == 30, np.nan, 1.0), "a curve has a gap at 0.009 s"),
        (KART, np.zeros(7), r"curves of shapes \(7,\) and \(101,\) at 101 times"),
    ],
)
def test_curves_that_cannot_be_rated_are_refused(time, truth, message):
    with pytest.raises(EvaluationError, match=message):
        rate(time, truth, pulse(time))
