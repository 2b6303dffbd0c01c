"""Design parameters from a table beside the runs: CSV, JSON or XLSX, one row a run.

The column `run` names the run as the dataset does; every other column is a parameter, with its unit in brackets
behind the name (`impact_speed [m/s]`) or in a YAML file of the same name beside the table (`impact_speed: m/s`).
JSON is a list of such rows, or an object of them by run name.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from crashkit.errors import DataError, ReadError
from crashkit.extras import need

_HEADER = re.compile(r"\s*(?P<name>[^\[(]+?)\s*(?:[\[(](?P<unit>[^\])]*)[\])])?\s*")
_KEYS = ("run", "sim", "name")
SUFFIXES = (".csv", ".json", ".xlsx")


@dataclass(frozen=True)
class ParameterTable:
    """Rows by run name: parameter name -> (value, unit as written, "" where none is)."""

    path: Path
    rows: Mapping[str, Mapping[str, tuple[float, str]]]

    def row(self, run: str) -> Mapping[str, tuple[float, str]]:
        """The parameters of `run`.

        Raises
        ------
        DataError
            If it has no row.
        """
        if run not in self.rows:
            names = list(self.rows)
            known = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
            raise DataError(f"{self.path}: has no row for run {run}; its rows are for {known}")
        return self.rows[run]


def read_parameter_table(path: Path) -> ParameterTable:
    """The table at `path`, told by its suffix.

    Raises
    ------
    ReadError
        With the row and column of what cannot be understood.
    DataError
        Naming a run with two rows.
    """
    header, lines = _load(path)
    columns: dict[str, tuple[str, str]] = {}
    for column in header:
        match = _HEADER.fullmatch(column)
        if match is None:
            raise ReadError(f"{path}: column {column!r} is no parameter name; expected name or name [unit]")
        columns[column] = (re.sub(r"\W+", "_", match["name"]), (match["unit"] or "").strip())
    key = next((c for c, (name, _) in columns.items() if name.lower() in _KEYS), None)
    if key is None:
        raise ReadError(f"{path}: no column called run; its columns are {', '.join(header) or 'none'}")
    units = _units_beside(path)
    rows: dict[str, dict[str, tuple[float, str]]] = {}
    twice: list[str] = []
    for number, line in enumerate(lines, 2):
        run = _text(line.get(key))
        if not run:
            raise ReadError(f"{path}: row {number} names no run in column {key!r}")
        if run in rows:
            twice.append(run)
        rows[run] = {
            name: (_number(line.get(column), f"{path}: row {number} (run {run}), column {column!r}"), unit or units.get(name, ""))
            for column, (name, unit) in columns.items()
            if column != key
        }  # fmt: skip
    if twice:
        raise DataError(f"{path}: more than one row for run {', '.join(dict.fromkeys(twice))}; keep one each")
    if not rows:
        raise ReadError(f"{path}: the table has no row")
    return ParameterTable(path, rows)


def _load(path: Path) -> tuple[list[str], list[dict[str, Any]]]:
    """Column names, and one dictionary a row."""
    if not path.is_file():
        raise ReadError(f"{path}: no such parameter table")
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ReadError(f"{path}: a parameter table is {', '.join(SUFFIXES)}, not {suffix or 'without suffix'}")
    try:
        lines = _json_rows(path) if suffix == ".json" else _sheet_rows(path)
    except ReadError:
        raise
    except Exception as error:  # each library below has errors of its own
        text = " ".join(str(error).split()) or type(error).__name__
        raise ReadError(f"{path}: cannot be read as a table ({text[:160]})") from error
    header = [_text(cell) for cell in lines[0]] if lines else []
    doubled = next((c for c in header if header.count(c) > 1), None)
    if doubled is not None:
        raise ReadError(f"{path}: column {doubled!r} stands there twice")
    if "" in header:
        raise ReadError(f"{path}: column {header.index('') + 1} has no name")
    return header, [dict(zip(header, line)) for line in lines[1:] if any(_text(cell) for cell in line)]


def _sheet_rows(path: Path) -> list[list[Any]]:
    import pandas as pd

    if path.suffix.lower() == ".xlsx":
        need(f"reading {path}", "formats")
        frame = pd.read_excel(path, header=None, dtype=object)
    else:
        options: dict[str, Any] = {"header": None, "dtype": str, "skipinitialspace": True, "encoding": "utf-8-sig"}
        with path.open(encoding="utf-8-sig") as stream:
            first = stream.readline()
        separator = max(",;\t", key=first.count)  # what the header uses; a single column has none
        frame = pd.read_csv(path, sep=separator, **options)
    return [list(row) for row in frame.itertuples(index=False)]


def _json_rows(path: Path) -> list[list[Any]]:
    data = json.loads(path.read_text(encoding="utf-8"))
    if isinstance(data, dict) and all(isinstance(row, dict) for row in data.values()):
        data = [{"run": run, **row} for run, row in data.items()]
    if not isinstance(data, list) or not data or not all(isinstance(row, dict) for row in data):
        raise ReadError(f"{path}: expected a list of rows, or an object of rows by run name")
    header = list(dict.fromkeys(column for row in data for column in row))
    return [header, *([row.get(column) for column in header] for row in data)]


def _text(cell: Any) -> str:
    """A cell as text; spreadsheets keep the number 3 as 3.0 at times."""
    if cell is None or cell != cell:
        return ""
    return str(int(cell)) if isinstance(cell, float) and cell.is_integer() else str(cell).strip()


def _number(cell: Any, place: str) -> float:
    try:
        value = float(cell)
    except (TypeError, ValueError):
        value = float("nan")
    if value != value or abs(value) == float("inf"):
        raise ReadError(f"{place}: found {_text(cell) or 'nothing'!r}, expected a number")
    return value


def _units_beside(path: Path) -> Mapping[str, str]:
    import yaml

    for suffix in (".yaml", ".yml"):
        beside = path.with_suffix(suffix)
        if not beside.exists():
            continue
        try:
            units = yaml.safe_load(beside.read_text(encoding="utf-8"))
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise ReadError(f"{beside}: not readable as YAML ({' '.join(str(error).split())[:160]})") from error
        if not isinstance(units, dict):
            raise ReadError(f"{beside}: expected lines such as impact_speed: m/s")
        return {str(name): str(unit) for name, unit in units.items()}
    return {}
