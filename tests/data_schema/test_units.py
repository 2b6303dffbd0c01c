"""Unit systems: factors that are known from elsewhere, and clear words for what is not known."""

from __future__ import annotations

import pytest

from data_schema import UnknownUnits, si_unit, to_si, unit_system
from data_schema.units import _USUAL, _understood, duration, is_unit, length, number_and_unit


@pytest.mark.parametrize(
    ("system", "quantity", "factor"),
    [
        ("mm-ms-kg", "stress", 1e9),  # GPa
        ("mm-ms-kg", "velocity", 1.0),
        ("mm-ms-kg", "force", 1e3),  # kN
        ("mm-s-t", "stress", 1e6),  # MPa
        ("mm-s-t", "force", 1.0),
        ("mm-s-t", "density", 1e12),
        ("m-s-kg", "energy", 1.0),
        ("SI", "acceleration", 1.0),
        ("mm-ms-kg", "one/time", 1e3),
        ("mm-ms-kg", "one/time2", 1e6),
        ("mm-s-t", "specific energy", 1e-6),
        ("mm-s-t", "moment", 1e-3),
        ("mm-ms-kg", "power", 1e3),
        ("in-s-kg", "length", 0.0254),
    ],
)
def test_factors_to_si(system: str, quantity: str, factor: float) -> None:
    assert unit_system(system).factor(quantity) == pytest.approx(factor)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("mm-ms", "expected length-time-mass"),
        ("furlong-s-kg", "length unit 'furlong' in 'furlong-s-kg' is not known"),
        ("mm-h-kg", "time unit 'h'"),
        ("mm-s-oz", "mass unit 'oz'"),
    ],
)
def test_unknown_system_is_told(name: str, told: str) -> None:
    with pytest.raises(UnknownUnits, match=told):
        unit_system(name)


def test_unknown_quantity_is_told() -> None:
    with pytest.raises(UnknownUnits, match="quantity 'colour' is not known"):
        unit_system("SI").factor("colour")


@pytest.mark.parametrize(
    ("unit", "value", "si"),
    [
        ("km/h", 36.0, (10.0, "m s-1")),
        ("MPa", 2.0, (2e6, "Pa")),
        ("mm", 5.0, (0.005, "m")),
        ("mph", 35.0, (15.6464, "m s-1")),
        ("kN", 2.0, (2e3, "N")),
        ("t/mm3", 7.85e-9, (7850.0, "kg m-3")),
        ("deg", 30.0, (30.0, "degree")),
        ("", 3.0, (3.0, "1")),
        ("-", 3.0, (3.0, "1")),
        ("psi", 1000.0, (6894757.293, "Pa")),
        ("ksi", 1.0, (6894757.293, "Pa")),
        ("ft/s", 10.0, (3.048, "m s-1")),
        ("m/s^2", 2.0, (2.0, "m s-2")),
        ("G", 2.0, (19.6133, "m s-2")),
        ("KM/H", 36.0, (10.0, "m s-1")),
        ("kph", 36.0, (10.0, "m s-1")),
        ("inch", 2.0, (0.0508, "m")),
        ("N/mm²", 210.0, (2.1e8, "Pa")),
        ("N/mm^2", 210.0, (2.1e8, "Pa")),
        ("MPA", 2.0, (2e6, "Pa")),
        ("ton", 2.0, (2e3, "kg")),
        ("g/cm^3", 7.85, (7850.0, "kg m-3")),
        ("kN/mm", 1.0, (1e6, "N m-1")),
        ("kNm", 2.0, (2e3, "N m")),
        ("kJ", 2.0, (2e3, "J")),
        ("kg*m²", 2.0, (2.0, "kg m2")),
        ("1/s", 3.0, (3.0, "s-1")),
        ("m·s⁻¹", 3.0, (3.0, "m s-1")),
        ("°", 30.0, (30.0, "degree")),
        ("°C", 20.0, (20.0, "degC")),
        ("rad", 0.5, (0.5, "rad")),
        ("%", 5.0, (5.0, "%")),
    ],
)
def test_parameter_units(unit: str, value: float, si: tuple[float, str]) -> None:
    factor, name = to_si(unit)
    assert (value * factor, name) == (pytest.approx(si[0]), si[1])


def test_si_units_by_quantity() -> None:
    assert (si_unit("stress"), si_unit("velocity"), si_unit("one")) == ("Pa", "m s-1", "1")


@pytest.mark.parametrize("unit", ["bananas", "m/ss", "9**9**9", "m**999", "(", "10^3 N", "__import__('os')"])
def test_a_unit_that_is_not_known_is_refused_with_the_cure(unit: str) -> None:
    with pytest.raises(UnknownUnits, match=r"is not known; write one such as m/s, km/h, mm"):
        to_si(unit)


@pytest.mark.parametrize("label", ["m s-1", "Pa", "kg m-3", "degree", "degC", "rad", "N m", "1", "kg m2", "%"])
def test_labels_stay_what_they_are(label: str) -> None:
    assert to_si(label) == (1.0, label)


@pytest.mark.parametrize("word", ["front", "rear", "left", "a", "b", "min", "max", "lhs", "mil", "no. 3"])
def test_words_are_no_units(word: str) -> None:
    assert not is_unit(word)


def test_units_of_the_usual_kinds_are_known() -> None:
    assert all(is_unit(unit) for unit in ("mm", "km/h", "MPa", "°", "psi", "-", "kN", "m s-1", "t/mm3"))


@pytest.mark.parametrize("name", ["mm-ms-kg", "m-s-kg", "in-us-t", "SI"])
def test_a_system_keeps_its_name_and_the_si_values_of_its_units(name: str) -> None:
    system = unit_system(name)
    assert system.name == name
    if name != "SI":
        known = {"mm": 1e-3, "m": 1.0, "in": 0.0254, "ms": 1e-3, "s": 1.0, "us": 1e-6, "kg": 1.0, "t": 1e3}
        assert [system.length, system.time, system.mass] == [known[piece] for piece in name.split("-")]
    assert unit_system(name.lower()).factor("length") == system.factor("length")


@pytest.mark.parametrize(
    ("unit", "factor", "label"),
    [
        ("J", 1.0, "J"), ("kJ", 1e3, "J"), ("cal", 4.184, "J"), ("Wh", 3600.0, "J"), ("N*m", 1.0, "N m"), ("Nm", 1.0, "N m"),
        ("kN*mm", 1.0, "N m"), ("rad", 1.0, "rad"), ("mrad", 1e-3, "rad"), ("rad/s", 1.0, "rad s-1"), ("rad/ms", 1e3, "rad s-1"),
        ("rpm", 2 * 3.14159265358979 / 60, "rad s-1"), ("1/ms", 1e3, "s-1"), ("kHz", 1e3, "s-1"),
        ("ton", 1e3, "kg"), ("lbm", 0.45359237, "kg"), ("kp", 9.80665, "N"), ("kmh", 1 / 3.6, "m s-1"), ("KM/H", 1 / 3.6, "m s-1"),
        ("G", 9.80665, "m s-2"), ("g", 1e-3, "kg"), ("ft", 0.3048, "m"), ("sek", 1.0, "s"), ("GRAD", 1.0, "degree"),
        ("MM", 1e-3, "m"), ("gpa", 1e9, "Pa"), ("N/mm", 1e3, "N m-1"), ("kg/m^3", 1.0, "kg m-3"), ("percent", 1.0, "%"),
        ("ton/mm^3", 1e12, "kg m-3"), ("km/std", 1 / 3.6, "m s-1"),
    ],
)  # fmt: skip
def test_units_of_mechanics_as_engineers_write_them(unit: str, factor: float, label: str) -> None:
    found, name = to_si(unit)
    assert (found, name) == (pytest.approx(factor, rel=1e-9), label)


@pytest.mark.parametrize("unit", _USUAL)
def test_usual_units_are_what_pint_makes_of_them(unit: str) -> None:
    assert to_si(unit) == _understood(unit)


@pytest.mark.parametrize(
    ("unit", "factor", "label"),
    [
        ("m.s-1", 1.0, "m s-1"), ("kg.m-3", 1.0, "kg m-3"), ("m s−1", 1.0, "m s-1"), ("km∕h", 1 / 3.6, "m s-1"),
        ("g's", 9.80665, "m s-2"), ("ips", 0.0254, "m s-1"), ("U/min", 2 * 3.14159265358979 / 60, "rad s-1"),
    ],
)  # fmt: skip
def test_other_signs_for_products_quotients_and_powers(unit: str, factor: float, label: str) -> None:
    found, name = to_si(unit)
    assert (found, name) == (pytest.approx(factor, rel=1e-9), label)


@pytest.mark.parametrize("unit", ["E+03 Pa", "m//s", "m'", 'N"', "k Pa"])
def test_what_pint_reads_over_is_no_unit(unit: str) -> None:
    with pytest.raises(UnknownUnits, match="is not known"):
        to_si(unit)


@pytest.mark.parametrize("unit", ["ms-1", "ms^-1", "ms⁻²", "ms -1"])
def test_a_unit_of_two_meanings_is_refused_with_both(unit: str) -> None:
    with pytest.raises(UnknownUnits, match="may be metres per second or one per millisecond; write m/s"):
        to_si(unit)


@pytest.mark.parametrize(("text", "metres"), [("8 mm", 8e-3), ("8mm", 8e-3), ("1e-3 m", 1e-3), (" .5 in ", 0.0127)])
def test_a_length_is_in_metres(text: str, metres: float) -> None:
    assert length(text) == pytest.approx(metres)


@pytest.mark.parametrize("text", ["8", "0 mm", "-1 mm", "8 s", "mm", "8 furlets", "nan mm"])
def test_what_is_no_length_is_refused(text: str) -> None:
    with pytest.raises(UnknownUnits):
        length(text)


@pytest.mark.parametrize(("text", "seconds"), [("15ms", 0.015), ("0.015", 0.015), (" 2 s", 2.0), ("0", 0.0)])
def test_a_duration_is_in_seconds(text: str, seconds: float) -> None:
    assert duration(text) == pytest.approx(seconds)


@pytest.mark.parametrize("text", ["", "soon", "15 mm", "15 furlets"])
def test_what_is_no_duration_is_refused(text: str) -> None:
    with pytest.raises(UnknownUnits):
        duration(text)


def test_a_number_and_what_stands_behind_it() -> None:
    assert number_and_unit("-5.e1km/h") == (-50.0, "km/h")
    assert number_and_unit("3") == (3.0, "")
    assert number_and_unit("fast") is None
