"""What kind of quantity a unit measures, as exponents of kilogram, metre and second."""

from __future__ import annotations

import re

from data_schema.units import UnknownUnits, to_si

Dimension = tuple[float, float, float]

# Exponents of (kg, m, s) of the units that SI strings are made of.
_KNOWN: dict[str, Dimension] = {
    "kg": (1, 0, 0), "m": (0, 1, 0), "s": (0, 0, 1),
    "N": (1, 1, -2), "Pa": (1, -1, -2), "J": (1, 2, -2), "W": (1, 2, -3), "Hz": (0, 0, -1),
}  # fmt: skip
_FACTOR = re.compile(r"([A-Za-z]+)(?:(?:\^|\*\*)?([-+]?\d+))?")


def dimension(unit: str) -> Dimension | None:
    """Exponents of (kg, m, s) of a unit such as "m s-1" or "MPa"; None for angles, "1" and units that are not known."""
    try:
        label = to_si(unit)[1]
    except UnknownUnits:
        return None
    total = [0.0, 0.0, 0.0]
    sign = 1
    for part in re.split(r"(/)", label):
        if part == "/":
            sign = -1
            continue
        for factor in part.replace("*", " ").replace("·", " ").split():
            found = _FACTOR.fullmatch(factor)
            if found is None or found[1] not in _KNOWN:
                return None
            power = sign * float(found[2] or 1)
            total = [t + power * e for t, e in zip(total, _KNOWN[found[1]], strict=True)]
        sign = 1
    return (total[0], total[1], total[2]) if any(total) else None
