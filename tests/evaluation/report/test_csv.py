"""Tables as CSV: what a spreadsheet would compute stays text."""

from __future__ import annotations

import csv
import io

import pytest

from evaluation.figures.kind import to_csv


@pytest.mark.parametrize("name", ["=1+1", "+cmd", "-2", "@sum", "\tx"])
def test_names_that_spreadsheets_would_compute_stay_text(name: str) -> None:
    rows = list(csv.reader(io.StringIO(to_csv({"run": [name, "run_001"], name: [-1.5, 2.0]}))))
    assert rows == [["run", f"'{name}"], [f"'{name}", "-1.5"], ["run_001", "2"]]
