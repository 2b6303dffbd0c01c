"""What a unit measures."""

from __future__ import annotations

import pytest

from data_schema.dimensions import dimension


@pytest.mark.parametrize(
    ("unit", "expected"),
    [
        ("m s-1", (0, 1, -1)), ("km/h", (0, 1, -1)), ("Pa", (1, -1, -2)), ("MPa", (1, -1, -2)), ("mm", (0, 1, 0)),
        ("kg m-3", (1, -3, 0)), ("kg/m^3", (1, -3, 0)), ("J kg-1", (0, 2, -2)), ("s-1", (0, 0, -1)),
        ("1", None), ("", None), ("degree", None), ("furlong", None),
    ],
)  # fmt: skip
def test_dimensions_of_units(unit: str, expected: tuple[float, float, float] | None) -> None:
    assert dimension(unit) == expected
