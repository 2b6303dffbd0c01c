"""Design parameters from a table beside the runs: CSV, JSON or XLSX, one row a run.

The column `run` names the run as its source does; every other column is a parameter, its unit in brackets behind
the name (`impact_speed [m/s]`) or in a YAML file of the same name beside the table (`impact_speed: m/s`).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from crashkit.errors import DataError, ReadError
from crashkit.readers.base import Parameter

_HEADER = re.compile(r"^\s*(?P<name>[^\[(]+?)\s*(?:[\[(](?P<unit>[^\])]*)[\])])?\s*$")


@dataclass(frozen=True)
class ParameterTable:
    """Rows by run name, and where they come from."""

    path: Path
    rows: Mapping[str, Mapping[str, Parameter]]

    def match(self, runs: Sequence[str]) -> list[str]:
        """What does not fit: runs without a row, rows without a run; each by name."""
        without_row = [r for r in runs if r not in self.rows]
        without_run = [r for r in self.rows if r not in set(runs)]
        out = []
        if without_row:
            out.append(f"{self.path}: no row for run {', '.join(without_row)}")
        if without_run:
            out.append(f"{self.path}: row for {', '.join(without_run)}, but there is no such run")
        return out


def read_parameter_table(path: Path) -> ParameterTable:
    """The table at `path`, told by its suffix.

    Raises ReadError with the row and column of what cannot be understood, DataError for a run with two rows.
    """
    frame_rows, header = _load(path)
    names: dict[str, tuple[str, str]] = {}
    for column in header:
        match = _HEADER.match(str(column))
        if match is None:
            raise ReadError(f"{path}: column {column!r} is no parameter name; expected name or name [unit]")
        names[str(column)] = (re.sub(r"\W+", "_", match["name"].strip()), (match["unit"] or "").strip())
    key = next((c for c, (n, _) in names.items() if n.lower() in ("run", "sim", "name")), None)
    if key is None:
        raise ReadError(f"{path}: no column called run; its columns are {', '.join(map(str, header))}")
    units = _units_beside(path)
    rows: dict[str, dict[str, Parameter]] = {}
    for number, row in enumerate(frame_rows, 2):
        run = str(row[key]).strip()
        if run in rows:
            raise DataError(f"{path}: run {run} has two rows (the second is row {number}); keep one")
        values = {}
        for column, (name, unit) in names.items():
            if column == key:
                continue
            try:
                value = float(row[column])
            except (TypeError, ValueError):
                value = float("nan")
            if value != value or abs(value) == float("inf"):
                raise ReadError(f"{path}: row {number} ({run}), column {column}: {row[column]!r} is not a number")
            values[name] = Parameter(value, unit or units.get(name, ""))
        rows[run] = values
    if not rows:
        raise ReadError(f"{path}: the table has no row")
    return ParameterTable(path, rows)


def _load(path: Path) -> tuple[list[dict[Any, Any]], list[str]]:
    import pandas as pd

    if not path.exists():
        raise ReadError(f"{path}: no such parameter table")
    suffix = path.suffix.lower()
    try:
        if suffix == ".csv":
            frame = pd.read_csv(path, dtype=object, skipinitialspace=True, sep=None, engine="python")
        elif suffix == ".xlsx":
            frame = pd.read_excel(path, dtype=object)
        elif suffix == ".json":
            import json

            data = json.loads(path.read_text())
            frame = pd.DataFrame(
                [{"run": k, **v} for k, v in data.items()] if isinstance(data, dict) else data, dtype=object
            )
        else:
            raise ReadError(f"{path}: a parameter table is .csv, .json or .xlsx, not {suffix or 'without suffix'}")
    except ReadError:
        raise
    except Exception as error:  # each library below has errors of its own
        raise ReadError(f"{path}: cannot be read as a table ({' '.join(str(error).split())[:160]})") from error
    header = [str(c) for c in frame.columns]
    doubled = {c for c in header if header.count(c) > 1}
    if doubled:
        raise ReadError(f"{path}: column {doubled.pop()!r} stands there twice")
    frame.columns = header
    return frame.to_dict("records"), header


def _units_beside(path: Path) -> Mapping[str, str]:
    import yaml

    for suffix in (".yaml", ".yml"):
        beside = path.with_suffix(suffix)
        if beside.exists():
            try:
                units = yaml.safe_load(beside.read_text())
            except yaml.YAMLError as error:
                raise ReadError(f"{beside}: not readable as YAML ({' '.join(str(error).split())[:160]})") from error
            if not isinstance(units, dict):
                raise ReadError(f"{beside}: expected lines of the form parameter: unit")
            return {str(k): str(v) for k, v in units.items()}
    return {}
