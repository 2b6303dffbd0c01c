"""Runs that a table asks for: units are those of the campaign, names must be its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from crashkit.api.run_campaign import points_of_table
from crashkit.errors import CrashkitError

NAMES, UNITS = ("impact_speed", "thickness"), ("km/h", "mm")


def test_units_are_converted(tmp_path: Path) -> None:
    path = tmp_path / "confirm.csv"
    path.write_text("run,thickness (m),impact_speed (m s-1)\noptimum,0.0012,10\nother,0.002,20\n")
    assert np.allclose(points_of_table(path, NAMES, UNITS), [[36, 1.2], [72, 2.0]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("thickness,speed\n1,2\n", "is in one of table and campaign alone"),
        ("thickness (kg),impact_speed\n1,2\n", "thickness is in kg"),
        ("thickness,impact_speed\n1,\n", "impact_speed is missing in row 2"),
    ],
)
def test_what_does_not_fit(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "runs.csv"
    path.write_text(text)
    with pytest.raises(CrashkitError, match=message):
        points_of_table(path, NAMES, UNITS)
