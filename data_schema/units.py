"""Unit systems of crash solvers, and factors to SI.

A solver's files carry no units; the deck's author chose a consistent system, named here by its length, time
and mass unit, such as `mm-ms-kg`. Every derived factor (stress, velocity, energy) follows from these three.
"""

from __future__ import annotations

import re
import tokenize
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Any

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


def quantity_in(unit: str) -> str:
    """The first quantity that `unit`, a label of SI as `to_si` gives it, measures; "unknown" where none does."""
    return next((name for name, (_, label) in _QUANTITIES.items() if label == unit), "unknown")


def _quantity(name: str) -> tuple[tuple[int, int, int], str]:
    if name not in _QUANTITIES:
        raise UnknownUnits(f"quantity {name!r} is not known; known are {', '.join(_QUANTITIES)}")
    return _QUANTITIES[name]


def unit_system(name: str) -> UnitSystem:
    """The system called `name`: "SI", or length-time-mass such as "mm-ms-kg", "mm-s-t", "m-s-kg".

    Raises
    ------
    UnknownUnits
        With the known units of the part that was not understood.
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


# Labels that `to_si` gives, which need no look into a library.
_SI_LABELS = frozenset(
    ("", "1", "m", "s", "kg", "m s-1", "m s-2", "N", "Pa", "J", "W", "N m", "N m-1", "m2", "m3", "kg m-3", "kg m-2",
     "kg m2", "s-1", "s-2", "rad", "rad s-1", "degree", "K", "degC", "degF", "%")
)  # fmt: skip
# What `_understood` finds for the usual ones, without half a second for pint; a test compares.
_USUAL = MappingProxyType(
    {
        "mm": (0.001, "m"), "cm": (0.01, "m"), "km": (1000.0, "m"), "ms": (0.001, "s"), "g": (0.001, "kg"), "t": (1000.0, "kg"),
        "m/s": (1.0, "m s-1"), "mm/ms": (1.0, "m s-1"), "mm/s": (0.001, "m s-1"), "km/h": (0.2777777777777778, "m s-1"),
        "m/s2": (1.0, "m s-2"), "kPa": (1000.0, "Pa"), "MPa": (1000000.0, "Pa"), "GPa": (1000000000.0, "Pa"),
        "N/mm2": (1000000.0, "Pa"), "kN": (1000.0, "N"), "kJ": (1000.0, "J"), "kg/m3": (1.0, "kg m-3"), "deg": (1.0, "degree"),
    }
)  # fmt: skip
# (mass, length, time) -> label, where it is not made of kg, m and s alone.
_DERIVED = MappingProxyType(
    {(1, 1, -2): "N", (1, -1, -2): "Pa", (1, 2, -2): "J", (1, 2, -3): "W", (1, 0, -2): "N m-1", (0, 0, 0): "1"}
)
# Kept in the unit they are written in: an angle or a temperature is read in that unit by those who know the campaign.
_KEPT = MappingProxyType({"degree": "degree", "degree_Celsius": "degC", "degree_Fahrenheit": "degF", "percent": "%"})
# The units of mechanics, by pint's names without prefix. Others (a barn, an are, a henry) are taken for words: a column
# "t (a)" is no thickness in years.
_MECHANICS = frozenset(
    ("meter", "inch", "foot", "yard", "mile", "micron", "thou", "second", "minute", "hour", "gram", "metric_ton", "pound",
     "slug", "ounce", "newton", "force_pound", "kip", "force_kilogram", "dyne", "pascal", "bar", "atmosphere",
     "standard_atmosphere", "pound_force_per_square_inch", "kip_per_square_inch", "joule", "calorie", "watt_hour",
     "foot_pound", "watt", "horsepower", "hertz", "revolutions_per_minute", "radian", "degree", "kelvin",
     "degree_Celsius", "degree_Fahrenheit", "mile_per_hour", "kilometer_per_hour", "kilometer_per_second",
     "meter_per_second", "foot_per_second", "knot", "standard_gravity", "percent")
)  # fmt: skip
# What engineers write and pint calls otherwise or takes for something else (its ton has 2000 pounds, its kn is a knot).
_WORDS = MappingProxyType(
    {
        "ton": "t", "tons": "t", "to": "t", "grad": "degree", "°": "degree", "degs": "degree", "°c": "degC", "°f": "degF",
        "celsius": "degC", "lbm": "lb", "kp": "kgf", "sek": "s", "std": "h", "kmh": "kph", "kmph": "kph", "m/sec": "m/s",
        "mus": "us", "mps": "m/s", "'": "ft", "''": "in", '"': "in", "zoll": "in", "g0": "g_n", "gee": "g_n", "nm": "N*m",
        "knm": "kN*m", "nmm": "N*mm", "kn": "kN", "rev": "turn", "cal": "calorie",
        "ips": "in/s", "g's": "G", "gs": "G", "kgs": "kg", "u/min": "rpm",
    }
)  # fmt: skip
# How units are spelled properly, for those written in capitals or small letters throughout.
_SPELLED = frozenset(
    ("m", "mm", "cm", "dm", "km", "um", "in", "ft", "yd", "s", "ms", "us", "h", "g", "kg", "mg", "t", "lb", "N", "kN", "MN",
     "Pa", "kPa", "MPa", "GPa", "psi", "ksi", "bar", "J", "kJ", "mJ", "W", "kW", "rad", "mrad", "deg", "K", "mph", "kph",
     "Hz", "kHz", "lbf", "kip", "rpm")
)  # fmt: skip
_TOKEN = re.compile(r"(?P<word>[^\W\d_]+|°[CF]?|%|\"|'{1,2})(?:\^|\*\*)?(?P<power>[-+]?\d{1,2}(?!\d))?")
# What may stand between the words of a unit; numbers may not, but for the 1 of 1/s.
_BETWEEN = re.compile(r"[ */().1]*")
# Feet and inches stand alone; two signs of division are none.
_ODD = re.compile(r"\w['\"]|//")
_LONGEST = 60
_POWERS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻−·⋅×µ∕⁄", "0123456789--***μ//")
# A point between two words is a product ("kg.m-3"), as CF has it.
_PRODUCT = re.compile(r"(?<=[^\W_])\.(?=[^\W\d_])")
# Nothing but space between what ends a unit and what begins the next one.
_BESIDE = re.compile(r"(?<=[\w)])\s*(?=\()|(?<=\))\s*(?=\w)|(?<=[\w)])\s+(?=[\w(])")
# Written without a space, a metre per second and one per millisecond look alike.
_TWO_MEANINGS = re.compile(r"ms\s?(?:\^|\*\*)?\s?\(?-[12]\)?")


def to_si(unit: str) -> tuple[float, str]:
    """Factor and SI unit for a parameter's unit, e.g. "MPa" -> (1e6, "Pa"), "km/h" -> (1/3.6, "m s-1").

    Degrees, temperatures and percent stay as they are (factor 1): a parameter is an input of the surrogate, and its
    label must be the one its owner reads. Units are understood by pint, in the spellings of CF ("m s-1"), of solvers
    ("N/mm2") and in capitals ("KM/H").

    Raises
    ------
    UnknownUnits
        Saying what to write instead.
    """
    text = " ".join(unit.split())
    if text in ("-", "1", ""):
        return 1.0, "1"
    if text in _SI_LABELS:
        return 1.0, text
    if _TWO_MEANINGS.fullmatch(text.translate(_POWERS)):
        raise UnknownUnits(f"unit {text!r} may be metres per second or one per millisecond; write m/s, m/s^2 or 1/ms")
    found = _USUAL.get(text) or _understood(text)
    if found is None:
        raise UnknownUnits(
            f"unit {text!r} is not known; write one such as m/s, km/h, mm, MPa, kg, degree, or none for a plain number"
        )
    return found


_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")


def number_and_unit(text: str) -> tuple[float, str] | None:
    """The number that `text` begins with and what stands behind it, "52km/h" -> (52.0, "km/h"); None without a number."""
    found = _NUMBER.fullmatch(text)
    return None if found is None else (float(found[1]), found[2])


def length(text: str) -> float:
    """A length above zero with its unit, such as "8 mm", in m.

    Raises
    ------
    UnknownUnits
        Where it is none; an empty unit is none.
    """
    found = number_and_unit(text)
    factor, label = to_si(found[1]) if found else (0.0, "")
    value = found[0] * factor if found else 0.0
    if label != "m" or not 0 < value < float("inf"):
        raise UnknownUnits(f"{text!r} is no length above zero; expected a number with a unit, such as 8 mm")
    return value


def duration(text: str) -> float:
    """A time with its unit, such as "15 ms", in s; without a unit it is in s.

    Raises
    ------
    UnknownUnits
        Where it is none.
    """
    found = number_and_unit(text)
    factor, label = to_si(found[1] or "s") if found else (0.0, "")
    if found is None or label != "s":
        raise UnknownUnits(f"{text.strip()!r} is no time")
    return found[0] * factor


def is_unit(text: str) -> bool:
    """Whether `text` is a unit of mechanics; a lone "min" is not: it says minimum more often than minute."""
    text = " ".join(text.split())
    return text.lower() != "min" and (
        text in _SI_LABELS or text in _USUAL or text == "-" or _understood(text) is not None
    )


@cache
def _understood(text: str) -> tuple[float, str] | None:
    """Factor and label of a unit, None where it is none of mechanics."""
    import pint

    plain = _PRODUCT.sub("*", text.translate(_POWERS)).replace("°C", "degC").replace("°F", "degF")
    if plain.lower() in _WORDS:
        plain = _WORDS[plain.lower()]
    if len(plain) > _LONGEST or not _BETWEEN.fullmatch(_TOKEN.sub(" ", plain)) or _ODD.search(plain):
        return None
    registry = _registry()
    try:
        # A lone prefix is no unit, though pint reads over it.
        if not all(registry.parse_unit_name(_spelled(m).split(")")[0][1:]) for m in _TOKEN.finditer(plain)):
            return None
        # What stands side by side is a product, said so: pint 0.26 reads "m (s)**-1" as 1/(m s), earlier ones as m/s.
        spelled = _BESIDE.sub("*", _TOKEN.sub(_spelled, plain).strip())
        units = registry.parse_units(spelled)
        if not units._units or any(name not in _MECHANICS for name in _names(units)):
            return None
        names = _names(units)
        if len(names) == 1 and names[0] in _KEPT and dict(units._units).popitem()[1] == 1:
            return 1.0, _KEPT[names[0]]
        if set(names) & {"degree_Celsius", "degree_Fahrenheit"}:
            return None
        value = registry.Quantity(1.0, units).to_base_units()
    except (
        pint.PintError,
        tokenize.TokenError,
        ArithmeticError,
        AssertionError,
        AttributeError,
        LookupError,
        SyntaxError,
        TypeError,
        ValueError,
    ):
        return None  # whatever pint's parser meets, it is no unit
    dimensions = {str(name).strip("[]"): power for name, power in value.dimensionality.items()}
    powers = tuple(dimensions.pop(name, 0) for name in ("mass", "length", "time"))
    kelvin = dimensions.pop("temperature", 0)
    if dimensions or any(power != int(power) for power in (*powers, kelvin)):
        return None
    if kelvin:
        return (1.0, "K") if powers == (0, 0, 0) and kelvin == 1 else None
    angle = bool(set(names) & {"radian", "degree", "revolutions_per_minute"})
    return float(value.magnitude), _label((int(powers[0]), int(powers[1]), int(powers[2])), names, angle)


def _label(powers: tuple[int, int, int], names: list[str], angle: bool) -> str:
    """CF label of a unit with these powers of mass, length and time."""
    if powers == (1, 2, -2) and not set(names) & {"joule", "calorie", "watt_hour", "foot_pound"}:
        return "N m"
    if angle and powers in ((0, 0, 0), (0, 0, -1)):
        return "rad" if powers[2] == 0 else "rad s-1"
    if powers in _DERIVED:
        return _DERIVED[powers]
    return " ".join(
        f"{unit}{power}" if power != 1 else unit for unit, power in zip(("kg", "m", "s"), powers, strict=True) if power
    )


def _spelled(match: re.Match[str]) -> str:
    """A word of a unit as pint has it, with its power."""
    word, power = match["word"], match["power"]
    if word == "G":
        word = "g_n"
    elif word.lower() in _WORDS and word not in _SPELLED:
        word = _WORDS[word.lower()]
    elif word not in _SPELLED:
        alike = [s for s in _SPELLED if s.lower() == word.lower()]
        word = alike[0] if len(alike) == 1 and not _known(word) else word
    return f"({word})" + (f"**({power})" if power else "")


def _known(word: str) -> bool:
    """Whether pint has a unit of mechanics of this spelling."""
    return any(name in _MECHANICS for _, name, _ in _registry().parse_unit_name(word))


def _names(units: Any) -> list[str]:
    """pint's names of the units in a product, without their prefixes."""
    return [_registry().parse_unit_name(name)[0][1] for name in units._units]


@cache
def _registry() -> Any:
    """pint's units; imported only where a unit has to be understood, since that takes half a second."""
    import pint

    return pint.UnitRegistry()
