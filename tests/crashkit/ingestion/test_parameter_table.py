"""Parameter tables in their three forms, and everything that can be wrong with them."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest

from crashkit.errors import DataError, ReadError
from crashkit.ingestion.parameter_table import read_parameter_table

ROWS = [
    {"run": "001", "impact speed [km/h]": 36.0, "angle": 15},
    {"run": "a", "impact speed [km/h]": 72.0, "angle": -3.5},
]
EXPECTED = {
    "001": {"impact_speed": (36.0, "km/h"), "angle": (15.0, "")},
    "a": {"impact_speed": (72.0, "km/h"), "angle": (-3.5, "")},
}


def write(path: Path) -> Path:
    frame = pd.DataFrame(ROWS)
    if path.suffix == ".csv":
        frame.to_csv(path, index=False)
    elif path.suffix == ".xlsx":
        frame.to_excel(path, index=False)
    else:
        path.write_text(json.dumps(ROWS))
    return path


@pytest.mark.parametrize("suffix", [".csv", ".json", ".xlsx"])
def test_all_forms_say_the_same(tmp_path: Path, suffix: str) -> None:
    assert read_parameter_table(write(tmp_path / f"runs{suffix}")).rows == EXPECTED


def test_json_by_run_name(tmp_path: Path) -> None:
    rows = {row["run"]: {k: v for k, v in row.items() if k != "run"} for row in ROWS}
    (tmp_path / "runs.json").write_text(json.dumps(rows))
    assert read_parameter_table(tmp_path / "runs.json").rows == EXPECTED


def test_semicolons_byte_order_mark_and_blank_lines(tmp_path: Path) -> None:
    (tmp_path / "runs.csv").write_text("run; impact speed [km/h]; angle\n001; 36; 15\n;;\na; 72; -3.5\n", "utf-8-sig")
    assert read_parameter_table(tmp_path / "runs.csv").rows == EXPECTED


def test_numbers_as_run_names_in_a_spreadsheet(tmp_path: Path) -> None:
    pd.DataFrame({"run": [3, 4], "angle": [1.0, 2.0]}).to_excel(tmp_path / "runs.xlsx", index=False)
    assert set(read_parameter_table(tmp_path / "runs.xlsx").rows) == {"3", "4"}


def test_units_in_a_file_beside(tmp_path: Path) -> None:
    (tmp_path / "runs.yaml").write_text("angle: degree\n")
    table = read_parameter_table(write(tmp_path / "runs.csv"))
    assert table.rows["a"]["angle"] == (-3.5, "degree")
    assert table.rows["a"]["impact_speed"] == (72.0, "km/h"), "the header goes before the file beside"


def test_run_without_row_is_told_by_name(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="has no row for run b; its rows are for 001, a"):
        read_parameter_table(write(tmp_path / "runs.csv")).row("b")


@pytest.mark.parametrize(
    ("name", "content", "kind", "told"),
    [
        ("runs.csv", "run,a\nx,1\ny,2\nx,3\n", DataError, "more than one row for run x; keep one"),
        ("runs.csv", "speed,a\n1,2\n", ReadError, "no column called run; its columns are speed, a"),
        ("runs.csv", "run,a\nx,fast\n", ReadError, r"row 2 \(run x\), column 'a': found 'fast', expected a number"),
        ("runs.csv", "run,a\nx,\n", ReadError, "found 'nothing', expected a number"),
        ("runs.csv", "run,a\n,3\n", ReadError, "row 2 names no run"),
        ("runs.csv", "run,a\n", ReadError, "the table has no row"),
        ("runs.csv", "", ReadError, "cannot be read as a table"),
        ("runs.csv", "run,a,a\nx,1,2\n", ReadError, "column 'a' stands there twice"),
        ("runs.json", '{"x": 3}', ReadError, "expected a list of rows"),
        ("runs.json", "[{", ReadError, "cannot be read as a table"),
        ("runs.xlsx", "no workbook", ReadError, "cannot be read as a table"),
        ("runs.txt", "run a", ReadError, r"a parameter table is .csv, .json, .xlsx, not .txt"),
    ],
)
def test_faults_are_told_with_their_place(tmp_path: Path, name: str, content: str, kind: type, told: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(kind, match=told) as caught:
        read_parameter_table(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value)


def test_missing_table_and_broken_units(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match="no such parameter table"):
        read_parameter_table(tmp_path / "runs.csv")
    write(tmp_path / "runs.csv")
    (tmp_path / "runs.yaml").write_text("- angle\n")
    with pytest.raises(ReadError, match="expected lines such as impact_speed: m/s"):
        read_parameter_table(tmp_path / "runs.csv")
