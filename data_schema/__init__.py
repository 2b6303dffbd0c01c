"""What a crash dataset is.

Read `layout.py` to know every dimension, variable, unit and attribute; `validation.py` holds the rules a
dataset must pass; `checksum.py` how its content is identified; `units.py` the unit systems crash solvers are run in;
`levels.py`, `edges.py`, `pod.py` and `replace.py` what all packages share: the arrays of a coarse mesh, the streamed POD, and
the way results appear under their names. Nothing here reads or writes a dataset.
"""

from data_schema.checksum import dataset_checksum, digests_of_run, run_checksum
from data_schema.layout import (
    ATTRIBUTES,
    CONVENTIONS,
    DIMENSIONS,
    VARIABLES,
    Attribute,
    Variable,
    fields,
    parameters,
    table_unit,
)
from data_schema.units import UnitSystem, UnknownUnits, si_unit, to_si, unit_system
from data_schema.validation import Violation, validate

__all__ = [
    "ATTRIBUTES",
    "CONVENTIONS",
    "DIMENSIONS",
    "VARIABLES",
    "Attribute",
    "UnitSystem",
    "UnknownUnits",
    "Variable",
    "Violation",
    "dataset_checksum",
    "digests_of_run",
    "fields",
    "parameters",
    "run_checksum",
    "si_unit",
    "table_unit",
    "to_si",
    "unit_system",
    "validate",
]
