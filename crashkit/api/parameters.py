"""The parameters a model is asked with: by name, with units if one likes, checked.

There is one rule, for Python, the command line and tables alike: a number is in the unit of the dataset (SI), as every
number in Python is; a text is read as a cell of the parameter table would be, in the unit that it carries, else in the
unit of the table.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from surrogates.data.inputs import Ranges


def parameter_table(given: Mapping[str, Any], ranges: Ranges) -> tuple[NDArray[np.float64], bool]:
    """Values (run, parameter), and whether several runs were asked for: one where no parameter has a list of values."""
    import numpy as np

    from crashkit.errors import DataError

    lists = {name: list(v) for name, v in given.items() if not isinstance(v, str) and np.ndim(v) == 1}
    lengths = {name: len(values) for name, values in lists.items()}
    if len(set(lengths.values())) > 1 or 0 in lengths.values():
        told = ", ".join(f"{count} of {name}" for name, count in lengths.items())
        raise DataError(f"there are {told}; expected as many values of each parameter, at least one")
    runs = next(iter(lengths.values()), 1)
    rows = [{name: lists[name][k] if name in lists else value for name, value in given.items()} for k in range(runs)]
    return np.stack([parameter_values(row, ranges) for row in rows]), bool(lists)


def parameter_values(given: Mapping[str, float | str], ranges: Ranges) -> NDArray[np.float64]:
    """Values (parameter,) in the order of `ranges.names`, in its units; raises DataError listing them where one is amiss."""
    import numpy as np

    from crashkit.errors import DataError

    spans = zip(ranges.names, ranges.low, ranges.high, ranges.written, strict=True)
    known = "; the model takes " + ", ".join(f"{n} ({a / f:g} to {b / f:g} {unit})" for n, a, b, (unit, f) in spans)
    unknown = [n for n in given if n not in ranges.names]
    if unknown:
        raise DataError(f"parameter {unknown[0]!r} is not known{known}")
    missing = [n for n in ranges.names if n not in given]
    if missing:
        raise DataError(f"parameter {', '.join(missing)} is missing{known}")
    return np.array(
        [
            _value(n, given[n], unit, written)
            for n, unit, written in zip(ranges.names, ranges.units, ranges.written, strict=True)
        ]
    )


def mistaken_unit(given: Mapping[str, Any], name: str, ranges: Ranges) -> str:
    """What to write where a value would lie in the trained range in the other unit, that of the table or SI; else empty."""
    k = ranges.names.index(name)
    low, high, unit, (written, factor) = ranges.low[k], ranges.high[k], ranges.units[k], ranges.written[k]
    value = given[name]
    try:
        number = float(value)  # of a text, one without a unit
    except (TypeError, ValueError):
        return ""
    other, what = (
        (unit, f"without a unit {name} is in {written}")
        if isinstance(value, str)
        else (written, f"as a number {name} is in {unit}")
    )
    if factor == 1 or not low <= (number if isinstance(value, str) else number * factor) <= high:
        return ""
    return f"{what}, so for {number:g} {other} write '{number:g} {other}'"


def _value(name: str, given: float | str, unit: str, written: tuple[str, float]) -> float:
    """A number in `unit`: text carries another unit of the same kind, or is in the `written` one (unit, its value)."""
    import math

    from crashkit.errors import DataError
    from data_schema import to_si
    from data_schema.units import UnknownUnits, number_and_unit

    if not isinstance(given, str):
        value = float(given)
    else:
        found = number_and_unit(given)
        if found is None or re.match(r",\s*\d", found[1]):
            comma = "; the decimal sign is a point" if "," in given else ""
            raise DataError(
                f"{name}={given}: expected a number, with a unit if you like, such as {name}=1{written[0]}{comma}"
            )
        value, own = found
        if own:
            try:
                factor, si = to_si(own)
            except UnknownUnits as error:
                raise DataError(f"{name}={given}: {error}") from error
            if si != to_si(unit)[1]:
                raise DataError(
                    f"{name}={given}: the unit {own!r} is not one of {name}, which is in {written[0] or 'no unit'}"
                )
            value *= factor / to_si(unit)[0]
        else:
            value *= written[1]
    if not math.isfinite(value):
        raise DataError(f"{name}={given}: expected a finite number")
    return value
