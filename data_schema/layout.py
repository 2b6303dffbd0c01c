"""The crash dataset, name by name.

A crash dataset is one `xarray.Dataset`: runs of one structure (`sim`), output states (`time`), nodes and the
faces between them. Displacements are measured from the reference position, so `position = reference_position
+ displacement`, and the two never share a name. Lengths are metres and times seconds, whatever the solver used.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

from data_schema.units import UnknownUnits, to_si

if TYPE_CHECKING:
    import xarray as xr

CONVENTIONS = "CF-1.11 UGRID-1.0"

DIMENSIONS: Mapping[str, str] = MappingProxyType(
    {
        "sim": "one solver run",
        "time": "one output state, common to all runs",
        "node": "one node of the structure (rigid walls and unused nodes are left out)",
        "xyz": "the three Cartesian directions",
        "face": "one shell, or one outer face of a solid",
        "corner": "corner of a face; 3 where the whole mesh is triangles, else 4",
        "part": "one part of the solver's model",
        "cell": "one solid or beam, kept beside the faces",
        "cell_corner": "corner of a cell",
        "source_state": "one output state of a run before the runs were brought to a common time",
        "tensor": "the components xx, yy, zz, xy, yz, zx of a symmetric tensor",
        "sample": "one sample of a run's time histories, at a time of the run's own",
        "channel": "one curve of the time histories, such as internal_energy",
    }
)


@dataclass(frozen=True)
class Variable:
    """One variable of the dataset.

    `dims` lists the accepted dimension tuples, the usual one first. `kind` is the numpy dtype kind accepted
    ("f" float, "i" integer, "b" bool, "U" text). `unit` is a CF unit string, "" where a unit has no meaning.
    """

    name: str
    dims: tuple[tuple[str, ...], ...]
    kind: str
    unit: str
    meaning: str
    required: bool = False


def _variable(name: str, *dims: str, kind: str, unit: str, meaning: str, required: bool = False) -> Variable:
    return Variable(name, tuple(tuple(d.split()) for d in dims), kind, unit, meaning, required)


VARIABLES: Mapping[str, Variable] = MappingProxyType(
    {
        v.name: v
        for v in (
            _variable(
                "displacement",
                "sim time node xyz",
                kind="f",
                unit="m",
                required=True,
                meaning="current minus reference position; zero in the first state; NaN once a node is gone",
            ),
            _variable(
                "reference_position",
                "node xyz",
                "sim node xyz",
                kind="f",
                unit="m",
                required=True,
                meaning="undeformed position; with sim where the runs differ in shape",
            ),
            _variable("sim", "sim", kind="U", unit="", required=True, meaning="name of the run, unique"),
            _variable("time", "time", kind="f", unit="s", required=True, meaning="strictly increasing"),
            _variable("node_id", "node", kind="i", unit="1", required=True, meaning="the solver's node number, unique"),
            _variable(
                "face_nodes",
                "face corner",
                kind="i",
                unit="1",
                required=True,
                meaning="0-based nodes of a face, -1 in the last corner of a triangle among quadrilaterals",
            ),
            _variable(
                "face_part", "face", kind="i", unit="1", required=True, meaning="index of the face's part in `part`"
            ),
            _variable(
                "face_id", "face", kind="i", unit="1", meaning="the solver's number of the element behind the face"
            ),
            _variable("part_id", "part", kind="i", unit="1", required=True, meaning="the solver's part number, unique"),
            _variable("part_name", "part", kind="U", unit="", required=True, meaning="the solver's part title"),
            _variable(
                "cell_nodes",
                "cell cell_corner",
                kind="i",
                unit="1",
                meaning="0-based nodes of a solid or beam, -1 behind its last corner",
            ),
            _variable("cell_type", "cell", kind="i", unit="1", meaning="VTK cell type"),
            _variable("cell_part", "cell", kind="i", unit="1", meaning="index of the cell's part in `part`"),
            _variable("cell_id", "cell", kind="i", unit="1", meaning="the solver's element number"),
            _variable("alive", "sim time face", kind="b", unit="", meaning="False once the element has eroded"),
            _variable("cell_alive", "sim time cell", kind="b", unit="", meaning="the same for solids and beams"),
            _variable(
                "mesh", "", kind="i", unit="", meaning="no value; its attributes tell UGRID readers where the mesh is"
            ),
            *(
                _variable(
                    f"node_{axis}",
                    "node",
                    kind="f",
                    unit="m",
                    meaning=f"{axis} of reference_position (of the first run where runs differ), for UGRID readers",
                )
                for axis in "xyz"
            ),
            _variable(
                "source_time",
                "sim source_state",
                kind="f",
                unit="s",
                meaning="the run's own output times before alignment, NaN behind its last",
            ),
            _variable(
                "alignment_error",
                "sim",
                kind="f",
                unit="m",
                meaning="estimated largest node displacement error that the change to the common time made",
            ),
            _variable(
                "run_checksum",
                "sim",
                kind="U",
                unit="",
                meaning="SHA-256 of the run's results, as `data_schema.checksum` takes it",
            ),
            _variable(
                "history",
                "sim sample channel",
                kind="f",
                unit="",
                meaning="time histories; each channel in its own unit (`channel_unit`), NaN where a run lacks it",
            ),
            _variable(
                "history_time",
                "sim sample",
                kind="f",
                unit="s",
                meaning="times of the samples, NaN behind a run's last",
            ),
            _variable("channel", "channel", kind="U", unit="", meaning="name of the curve, unique"),
            _variable("channel_unit", "channel", kind="U", unit="", meaning="unit of the curve, such as J or N"),
            _variable(
                "channel_note", "channel", kind="U", unit="", meaning="what was done to the solver's own numbers"
            ),
            *(
                _variable(name, "sim", kind="f", unit="%", meaning=f"{meaning}; NaN where nothing says")
                for name, meaning in (
                    ("energy_error", "largest error of the energy balance, of the largest total energy"),
                    ("hourglass_share", "largest hourglass energy, of the largest internal energy"),
                    ("mass_added", "mass added by mass scaling"),
                )
            ),
            _variable(
                "quality_note",
                "sim",
                kind="U",
                unit="",
                meaning="what of the run is beyond its limit; empty where it is fine",
            ),
            _variable("complete", "sim", kind="b", unit="", meaning="every state was found and the end time reached"),
        )
    }
)


@dataclass(frozen=True)
class Attribute:
    """One attribute of the dataset."""

    name: str
    meaning: str
    required: bool = True


ATTRIBUTES: Mapping[str, Attribute] = MappingProxyType(
    {
        a.name: a
        for a in (
            Attribute("Conventions", f'"{CONVENTIONS}"'),
            Attribute("solver", "the program that computed the runs, as far as its files say"),
            Attribute("source_files", "JSON list: run, file name, bytes and SHA-256 of every file read"),
            Attribute("units_read", "the unit system of the source, such as mm-ms-kg"),
            Attribute("units_written", '"SI"'),
            Attribute("crashkit_version", "the version that wrote the dataset"),
            Attribute("history", "one line for every change: the version and what it did"),
            Attribute("checksum", "SHA-256 of the content, as `data_schema.checksum` takes it", required=False),
            Attribute("parameters", "JSON list: names of the design parameters in their order", required=False),
            Attribute("title", "a name for people", required=False),
        )
    }
)


def parameters(dataset: xr.Dataset) -> list[str]:
    """Names of the design parameters: the variables on `sim` with attribute `role: parameter`.

    They come in the order of the attribute `parameters`, and of the file where that says nothing.
    """
    found = [str(n) for n, v in dataset.data_vars.items() if v.attrs.get("role") == "parameter"]
    try:
        order = [str(n) for n in json.loads(dataset.attrs.get("parameters", "[]"))]
    except (TypeError, ValueError):
        order = []
    return sorted(found, key=lambda name: order.index(name) if name in order else len(order))


def table_unit(dataset: xr.Dataset, name: str) -> tuple[str, float]:
    """The unit in which the table of parameters gave `name`, and its value in the dataset's unit: ("MPa", 1e6).

    People speak of a parameter in this unit, so it is the one of numbers without a unit. It is the attribute
    `table_units`; without one, or with one of another kind, it is the dataset's own unit.
    """
    attributes = dataset[name].attrs
    own, written = str(attributes.get("units", "")), str(attributes.get("table_units", ""))
    try:
        factor, si = to_si(written)
    except UnknownUnits:
        return own, 1.0
    return (written, factor) if written and si == own else (own, 1.0)


def fields(dataset: xr.Dataset) -> list[str]:
    """Names of the further result fields (attribute `role: field`), such as plastic_strain."""
    return [str(n) for n, v in dataset.data_vars.items() if v.attrs.get("role") == "field"]
