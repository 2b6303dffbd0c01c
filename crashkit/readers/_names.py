"""Names of result fields, the same for every solver, and what they measure."""

from __future__ import annotations

import re
from collections.abc import Sequence

# What a field measures, for the change to SI. A name that is not here keeps its own name as its quantity, so that its
# values stay as they are, labelled "unknown". Temperature is left out on purpose: no source says whether it is in
# kelvin or in degrees.
_QUANTITIES = {
    "acceleration": "acceleration",
    "angular_acceleration": "one/time2",
    "angular_velocity": "one/time",
    "area": "area",
    "contact_forces": "force",
    "damage": "one",
    "density": "density",
    "energy": "energy",
    "energy_density": "stress",
    "external_forces": "force",
    "force": "force",
    "internal_forces": "force",
    "mass": "mass",
    "mass_change": "one",
    "moment": "moment",
    "power": "power",
    "pressure": "stress",
    "rotational_acceleration": "one/time2",
    "rotational_velocity": "one/time",
    "sound_speed": "velocity",
    "specific_energy": "specific energy",
    "strain": "one",
    "strain_rate": "one/time",
    "stress": "stress",
    "thickness": "length",
    "time_step": "time",
    "triaxiality": "one",
    "velocity": "velocity",
    "volume": "volume",
    "von_mises": "stress",
}
# Behind a known word these make something else of it: the gradient of a stress is no stress.
_CHANGING = {"density", "factor", "flux", "gradient", "index", "rate", "ratio"}
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
# LS-DYNA's own name for the shells it draws a wall with; they are of a null material, not of a rigid one.
DRAWN_WALL = re.compile(r"\bnull shells? for visuali[sz]ation", re.IGNORECASE)
# Numbers of nodes and elements, in lower case, as solvers, their converters and VTK call them.
NODE_IDS = (
    "node_id", "node_ids", "globalnodeid", "globalnodeids", "globalpointid", "globalpointids", "globalids",
    "global_ids", "vtkglobalids",
)  # fmt: skip
ELEMENT_IDS = (
    "element_id", "element_ids", "globalelementid", "globalelementids", "globalcellid", "globalcellids", "globalids",
    "global_ids", "vtkglobalids", "face_id",
)  # fmt: skip
# A name that ends in x, y or z: UX, displ_x, "velocity:z".
_AXIS = re.compile(r"(?P<name>.+?)[ _.:-]?(?P<axis>[xyz])", re.IGNORECASE)
# Displacements are also numbered by their axes: U1, U2, U3, or "displacement:0" and so on.
_NUMBERED_AXIS = re.compile(r"(?P<name>.+?)[ _.:-]?(?P<axis>[0123])")
DISPLACEMENT_NAMES = ("displacement", "displacements", "displ", "disp", "u")


def field_name(title: str) -> str:
    """`title` as a field is called here: lower case with underscores, e.g. "Plastic Strain" -> "plastic_strain"."""
    name = re.sub(r"[^0-9a-z]+", "_", title.strip().lower()).strip("_")
    return _SAME.get(name, name)


def quantity(name: str) -> str:
    """The quantity of the field `name`, recognised by the last of its words that are known; `name` itself where none is.

    Solids, beams and the like carry their kind in front ("solid_plastic_strain"), surfaces and layers behind
    ("stress_upper"), and what comes last says what it is: a "plastic_strain_rate" is a rate.
    """
    words = name.split("_")
    if "per" in words:
        return name
    for end in range(len(words), 0, -1):
        for begin in range(end):
            known = _QUANTITIES.get("_".join(words[begin:end]))
            if known is not None:
                return known
        if words[end - 1] in _CHANGING:
            break
    return name


def vectors_among(titles: Sequence[str]) -> dict[str, tuple[str, str, str]]:
    """Vectors that are kept as three scalars: name -> titles of x, y and z."""
    out = {}
    for pattern, axes in ((_AXIS, ("xyz",)), (_NUMBERED_AXIS, ("123", "012"))):
        found: dict[str, dict[str, str]] = {}
        for title in titles:
            if match := pattern.fullmatch(title):
                found.setdefault(match["name"], {})[match["axis"].lower()] = title
        for name, by_axis in found.items():
            whole = next((order for order in axes if set(by_axis) == set(order)), None)
            if whole and (pattern is _AXIS or field_name(name) in DISPLACEMENT_NAMES):
                out[name] = (by_axis[whole[0]], by_axis[whole[1]], by_axis[whole[2]])
    return out
