"""Names of result fields, the same for every solver, and what they measure."""

from __future__ import annotations

import re

# What a field measures, for the change to SI. A name that is not here keeps its own name as its quantity, so that
# asking for it in another unit system than SI ends in a clear message and never in a wrong unit.
_QUANTITIES = {
    "acceleration": "acceleration",
    "axial_force": "force",
    "contact_force": "force",
    "contact_forces": "force",
    "density": "density",
    "effective_strain": "one",
    "energy": "energy",
    "force": "force",
    "internal_energy": "energy",
    "internal_forces": "force",
    "external_forces": "force",
    "mass": "mass",
    "nodal_mass": "mass",
    "mass_change": "one",
    "plastic_strain": "one",
    "pressure": "stress",
    "shear_force": "force",
    "strain": "one",
    "strain_rate": "one/time",
    "stress": "stress",
    "thickness": "length",
    "time_step": "time",
    "velocity": "velocity",
    "von_mises": "stress",
}
_SAME = {
    "eps": "plastic_strain",
    "epsp": "plastic_strain",
    "eqps": "plastic_strain",
    "effective_plastic_strain": "plastic_strain",
    "equivalent_plastic_strain": "plastic_strain",
    "stress_von_mises": "von_mises",
    "stress_vm": "von_mises",
    "von_mises_stress": "von_mises",
    "mises_stress": "von_mises",
    "vel": "velocity",
    "acc": "acceleration",
    "velocities": "velocity",
    "accelerations": "acceleration",
}
# A part so called is a rigid wall drawn for the eye, where nothing better tells it.
WALL_NAME = re.compile(r"\brigid.?wall|\brwall", re.IGNORECASE)
DISPLACEMENT_NAMES = ("displacement", "displacements", "displ", "disp", "u")


def field_name(title: str) -> str:
    """`title` as a field is called here: lower case with underscores, e.g. "Plastic Strain" -> "plastic_strain"."""
    name = re.sub(r"[^0-9a-z]+", "_", title.strip().lower()).strip("_")
    return _SAME.get(name, name)


def quantity(name: str) -> str:
    """The quantity of the field `name`, by its longest known beginning or end ("stress_upper" is a stress).

    Solids, beams and the like carry their kind in front ("solid_plastic_strain"), surfaces and layers behind.
    """
    if name in _QUANTITIES:
        return _QUANTITIES[name]
    for known in sorted(_QUANTITIES, key=len, reverse=True):
        if name.startswith(known + "_") or name.endswith("_" + known):
            return _QUANTITIES[known]
    return name
