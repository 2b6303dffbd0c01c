"""Unit systems: factors that are known from elsewhere, and clear words for what is not known."""

from __future__ import annotations

import pytest

from data_schema import UnknownUnits, si_unit, to_si, unit_system


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
        ("bananas", 3.0, (3.0, "bananas")),
    ],
)
def test_parameter_units(unit: str, value: float, si: tuple[float, str]) -> None:
    factor, name = to_si(unit)
    assert (value * factor, name) == (pytest.approx(si[0]), si[1])


def test_si_units_by_quantity() -> None:
    assert (si_unit("stress"), si_unit("velocity"), si_unit("one")) == ("Pa", "m s-1", "1")
