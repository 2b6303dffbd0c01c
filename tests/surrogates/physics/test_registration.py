"""Clock, size and images: a registered campaign, and the way back."""

from __future__ import annotations

import numpy as np
import plate
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surrogates.data.campaign import Campaign
from surrogates.data.samples import Notes, ValidationSplit
from surrogates.physics.clock import Clock
from surrogates.physics.derived import SPEED, STRESS, DerivedInputs, logarithms
from surrogates.physics.registration import Registration
from surrogates.physics.symmetry import Symmetry, may_be_odd
from surrogates.settings import settings
from surrogates.storage.folder import load, save
from surrogates.training.train import train_surrogate

DIMENSIONS = (SPEED, None, STRESS)


def campaign(runs: int = 24, **changes: object) -> Campaign:
    return plate.campaign(runs, dimensions=DIMENSIONS, mirrors=(plate.MIRROR,), **changes)


def registration(of: Campaign, a: float = 0.25) -> Registration:
    clock = Clock.of(of.parameters, 0, {0: a, 2: 0.25})
    inputs = logarithms(of.parameter_names, of.parameters, warp=True)
    grid = clock.grid(of.parameters, of.time)
    return Registration(inputs, clock, Symmetry(plate.MIRROR, ("impact_angle",), flagged=True), grid)


@given(st.floats(5, 35), st.floats(1e8, 8e8), st.sampled_from([0.125, 0.25, 0.5]))
def test_free_flight_stays_exact_on_any_clock(speed: float, stress: float, a: float) -> None:
    clock = Clock.of(plate.parameters(9), 0, {0: a, 2: 0.25})
    run = np.array([speed, 0.0, stress])
    time = np.linspace(0, 0.03, 31)
    grid = np.linspace(0, 0.05, 51)
    flight = speed * time[:, None]
    np.testing.assert_allclose(clock.apply(flight, run, time, grid)[:, 0], clock.reference[0] * grid, rtol=1e-9)
    assert clock.size(run[None])[0] * clock.rate(run[None])[0] == pytest.approx(speed / clock.reference[0])


def test_a_registered_campaign_holds_runs_and_images_and_says_how_far_they_were_computed() -> None:
    original = campaign(6)
    found = registration(original).apply(original, settings("mh"), Notes())
    assert found.parameters.shape == (12, 4)
    assert found.parameter_names[-1] == "mirrored"
    np.testing.assert_array_equal(found.parameters[:, 3], np.repeat([0.0, 1.0], 6))
    np.testing.assert_allclose(found.parameters[6:, 1], -found.parameters[:6, 1])
    assert found.displacement(0).shape == (12, len(found.time), 81, 3)
    assert found.displacement(0)[0].shape == (len(found.time), 81, 3)
    assert found.known is not None
    assert found.known[:, 0].all()
    corner = original.parameters.max(axis=0)  # of the box: faster than any run, but not than any query
    fastest = registration(original).clock.rate(corner[None])[0]
    assert found.time[-1] == pytest.approx(fastest * original.time[-1])
    assert not found.known.all(axis=1).any()
    np.testing.assert_array_equal(found.known[:6], found.known[6:])


@pytest.mark.parametrize("level", [0, 1, 2])
def test_images_of_a_level_are_the_image_of_the_full_mesh_there(level: int) -> None:
    original = campaign(3)
    whole = registration(original).apply(original, settings("mh"), Notes()).displacement(0)[4]
    kept = np.arange(81) if level == 0 else original.levels[level - 1].kept
    found = registration(original).apply(original, settings("mh"), Notes()).displacement(level)[4]
    np.testing.assert_allclose(found, whole[:, kept], atol=1e-7)


def test_undo_brings_a_registered_run_back_to_its_own_clock() -> None:
    original = campaign(5)
    known = registration(original)
    field = known.apply(original, settings("mh"), Notes()).displacement(0)
    for run in range(5):

        def model(inputs: np.ndarray, time: np.ndarray, run: int = run) -> np.ndarray:
            states = field[run].reshape(len(known.grid), -1)
            return np.stack([np.interp(time, known.grid, column) for column in states.T], axis=1)[None]

        back = known.undo(model, original.parameters[run : run + 1], original.time)[0]
        truth = original.displacement(0)[run].reshape(7, -1)
        np.testing.assert_allclose(back[0], truth[0], atol=1e-7)
        assert np.abs(back - truth).max() < 0.06 * np.abs(truth).max()  # two interpolations between seven states


def test_a_run_and_its_image_stand_on_the_same_side_of_a_split() -> None:
    original = campaign(6)
    parts = registration(original).split(ValidationSplit(np.array([0, 2, 5]), np.array([1, 4])), 6)
    np.testing.assert_array_equal(parts.training, [0, 2, 5, 6, 8, 11])
    np.testing.assert_array_equal(parts.validation, [1, 4])


def test_the_image_of_an_image_is_the_run() -> None:
    states = plate.displacement(plate.parameters(1))[0]
    symmetry = Symmetry(plate.MIRROR)
    np.testing.assert_allclose(symmetry.apply(symmetry.apply(states)), states, atol=1e-7)


def test_it_is_stored_and_read_again() -> None:
    known = registration(campaign(6))
    again = Registration.from_dict(known.as_dict())
    assert again.inputs == known.inputs
    assert again.clock == known.clock
    assert again.told() == known.told()
    np.testing.assert_array_equal(again.grid, known.grid)


def test_parameters_on_one_side_of_zero_are_not_odd() -> None:
    runs = np.array([[1.0, -3.0, -2.0], [2.0, 4.0, 0.1]])
    assert may_be_odd(("a", "b", "c"), runs) == [("b",)]


def test_the_identity_changes_nothing() -> None:
    original = campaign(4)
    identity = Registration.identity(original.parameter_names, original.time)
    assert identity.is_identity
    assert identity.apply(original, settings("mh"), Notes()) is original
    assert identity.inputs == DerivedInputs.identity(original.parameter_names)


def test_pod_regression_stands_behind_it_and_starts_at_zero(tmp_path) -> None:  # type: ignore[no-untyped-def]
    surrogate = train_surrogate(campaign(12), settings("pod-gpr", overrides=["inputs.derived=off"]))
    physics = surrogate.record.physics
    assert {"inputs", "clock", "symmetry"} <= physics.keys()
    asked = plate.parameters(3, seed=9)
    found = surrogate.predict(asked)
    assert not found[:, 0].any()
    np.testing.assert_array_equal(load(save(surrogate, tmp_path / "model")).predict(asked), found)


def test_where_nothing_is_known_nothing_is_derived_from_units() -> None:
    surrogate = train_surrogate(plate.campaign(12, parameter_units=("1", "1", "1")), settings("pod-gpr"))
    assert surrogate.registration.clock.is_identity
    assert surrogate.registration.symmetry.is_identity
    assert not any(
        "^" in told or "/" in told.replace("asinh(", "") for told in surrogate.registration.inputs.told()[2:]
    )


def test_all_can_be_switched_off() -> None:
    off = ["inputs.derived=off", "physics.clock=off", "physics.symmetry=off"]
    assert train_surrogate(campaign(12), settings("pod-gpr", overrides=off)).registration.is_identity
