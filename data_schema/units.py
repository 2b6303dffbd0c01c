"""Unit systems of crash solvers, and factors to SI.

A solver's files carry no units; the deck's author chose a consistent system, named here by its length, time
and mass unit, such as `mm-ms-kg`. Every derived factor (stress, velocity, energy) follows from these three.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

_LENGTH = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254}
_TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
_MASS = {"kg": 1.0, "g": 1e-3, "t": 1e3, "ton": 1e3}

# Exponents of (length, time, mass) of the quantities that crash results carry, and their SI unit.
_QUANTITIES = MappingProxyType(
    {
        "length": ((1, 0, 0), "m"),
        "time": ((0, 1, 0), "s"),
        "mass": ((0, 0, 1), "kg"),
        "velocity": ((1, -1, 0), "m s-1"),
        "acceleration": ((1, -2, 0), "m s-2"),
        "force": ((1, -2, 1), "N"),
        "stress": ((-1, -2, 1), "Pa"),
        "energy": ((2, -2, 1), "J"),
        "momentum": ((1, -1, 1), "kg m s-1"),
        "specific energy": ((2, -2, 0), "J kg-1"),
        "power": ((2, -3, 1), "W"),
        "moment": ((2, -2, 1), "N m"),
        "area": ((2, 0, 0), "m2"),
        "volume": ((3, 0, 0), "m3"),
        "density": ((-3, 0, 1), "kg m-3"),
        "one/time": ((0, -1, 0), "s-1"),
        "one/time2": ((0, -2, 0), "s-2"),
        "one": ((0, 0, 0), "1"),
    }
)


class UnknownUnits(ValueError):
    """A unit system or quantity that is not known."""


@dataclass(frozen=True)
class UnitSystem:
    """A consistent system: the SI value of its length, time and mass unit."""

    name: str
    length: float
    time: float
    mass: float

    def factor(self, quantity: str) -> float:
        """SI value of one unit of `quantity` ("length", "velocity", "stress", ...) in this system."""
        length, time, mass = _quantity(quantity)[0]
        return self.length**length * self.time**time * self.mass**mass


def si_unit(quantity: str) -> str:
    """CF unit string of `quantity` in SI, such as "m s-1" for "velocity"."""
    return _quantity(quantity)[1]


def _quantity(name: str) -> tuple[tuple[int, int, int], str]:
    if name not in _QUANTITIES:
        raise UnknownUnits(f"quantity {name!r} is not known; known are {', '.join(_QUANTITIES)}")
    return _QUANTITIES[name]


def unit_system(name: str) -> UnitSystem:
    """The system called `name`: "SI", or length-time-mass such as "mm-ms-kg", "mm-s-t", "m-s-kg".

    Raises UnknownUnits with the known units of the part that was not understood.
    """
    if name.upper() == "SI":
        return UnitSystem("SI", 1.0, 1.0, 1.0)
    pieces = name.split("-")
    if len(pieces) != 3:
        raise UnknownUnits(f"units {name!r} not understood; expected length-time-mass, such as mm-ms-kg, or SI")
    values = []
    for piece, known, what in zip(pieces, (_LENGTH, _TIME, _MASS), ("length", "time", "mass"), strict=True):
        if piece not in known:
            raise UnknownUnits(f"{what} unit {piece!r} in {name!r} is not known; known are {', '.join(known)}")
        values.append(known[piece])
    return UnitSystem(name, *values)


def to_si(unit: str) -> tuple[float, str]:
    """Factor and SI unit for a parameter's unit, e.g. "MPa" -> (1e6, "Pa"), "km/h" -> (1/3.6, "m s-1").

    Angles stay in degree and unknown units stay as they are (factor 1): a parameter is an input of the
    surrogate, and its label must be the one its owner reads.
    """
    known = {
        "mm": (1e-3, "m"), "cm": (1e-2, "m"), "m": (1.0, "m"), "in": (0.0254, "m"),
        "us": (1e-6, "s"), "ms": (1e-3, "s"), "s": (1.0, "s"),
        "g": (1e-3, "kg"), "t": (1e3, "kg"), "kg": (1.0, "kg"),
        "MPa": (1e6, "Pa"), "GPa": (1e9, "Pa"), "kPa": (1e3, "Pa"), "Pa": (1.0, "Pa"),
        "N/mm2": (1e6, "Pa"), "N/mm^2": (1e6, "Pa"),
        "km/h": (1 / 3.6, "m s-1"), "mph": (0.44704, "m s-1"), "mm/s": (1e-3, "m s-1"), "mm/ms": (1.0, "m s-1"),
        "m/s": (1.0, "m s-1"), "m s-1": (1.0, "m s-1"),
        "N": (1.0, "N"), "kN": (1e3, "N"), "J": (1.0, "J"), "kJ": (1e3, "J"),
        "kg/m3": (1.0, "kg m-3"), "kg m-3": (1.0, "kg m-3"), "g/cm3": (1e3, "kg m-3"), "t/mm3": (1e12, "kg m-3"),
        "deg": (1.0, "degree"), "°": (1.0, "degree"), "degree": (1.0, "degree"),
        "": (1.0, "1"), "-": (1.0, "1"), "1": (1.0, "1"),
    }  # fmt: skip
    return known.get(unit.strip(), (1.0, unit.strip()))
