"""What a result field measures, told by its name alone."""

from __future__ import annotations

import pytest

from crashkit.readers._names import field_name, quantity


@pytest.mark.parametrize(
    ("title", "name", "measures"),
    [
        ("Plastic Strain", "plastic_strain", "one"),
        ("EPSP", "plastic_strain", "one"),
        ("Plastic Strain Rate", "plastic_strain_rate", "one/time"),
        ("Strain Rate", "strain_rate", "one/time"),
        ("Von Mises", "von_mises", "stress"),
        ("Stress (upper)", "stress_upper", "stress"),
        ("Stress Triaxiality", "stress_triaxiality", "one"),
        ("Thickness strain", "thickness_strain", "one"),
        ("solid_thickness", "solid_thickness", "length"),
        ("Specific Energy", "specific_energy", "specific energy"),
        ("Internal Energy", "internal_energy", "energy"),
        ("Internal energy density", "internal_energy_density", "stress"),
        ("Rotational velocity", "rotational_velocity", "one/time"),
        ("Velocities", "velocity", "velocity"),
        ("Contact Force X", "contact_force_x", "force"),
    ],
)
def test_last_known_words_say_what_a_field_measures(title: str, name: str, measures: str) -> None:
    assert field_name(title) == name
    assert quantity(name) == measures


@pytest.mark.parametrize("name", ["temperature", "stress_gradient", "energy_per_mass", "colour"])
def test_a_name_that_is_not_known_is_its_own_quantity(name: str) -> None:
    assert quantity(name) == name
