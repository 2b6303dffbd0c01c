"""Design parameters from a table beside the runs: CSV, TSV, JSON or XLSX, one row a run.

The column `run` names the run as the dataset does; every other column is a parameter, with its unit in brackets
behind the name (`impact_speed [m/s]`), in a row of units below the header, or in a YAML file of the same name beside
the table (`impact_speed: m/s`). JSON is a list of such rows, or an object of them by run name.

Tables come out of many spreadsheets. What they leave in a file is read where it has one meaning: commas, semicolons
or tabs between cells, a line `sep=;`, UTF-8, UTF-16 or the Windows code page, titles and comments above the header, an
empty column at the end, a comma as decimal mark or between thousands. Where it has two, the table is refused.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import re
import unicodedata
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from crashkit.errors import DataError, ReadError
from crashkit.extras import need
from crashkit.readers.parameter_names import parameter_columns, parameter_name
from data_schema.units import is_unit

# The column with the names of the runs, the first that is there; the others are names for people.
_KEYS = ("run", "sim", "name")
SUFFIXES = (".csv", ".tsv", ".json", ".xlsx")
# The header stands in one of the first rows: above it are titles.
_TITLE_ROWS = 20
_UNIT_ROWS = ("", "unit", "units", "einheit", "einheiten", "-")
# What other code pages (Shift-JIS, GBK, those of DOS and old Macs) look like when they are taken for that of Windows.
_OTHER_CODE_PAGE = re.compile(r"[^\x00-\x7f\w\s°·±×€–—…´«»„“”‘’§©®™ª²³]|\w[„“”‘«»®©§]\w|[^\W\d_\x00-\x7f]{3}|\ufffd")
# A table of parameters is small; a workbook is packed and could be made to fill the memory.
_MOST_BYTES = 64 << 20
_PLAIN = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_DECIMAL_COMMA = re.compile(r"[-+]?(?:\d{1,3}(?:\.\d{3})+|\d*),\d+(?:[eE][-+]?\d+)?")
_THOUSANDS = re.compile(r"[-+]?\d{1,3}(?:,\d{3})+(?:\.\d*)?")
_SPACES = re.compile(r"(?<=\d)[\u00a0\u2009\u202f'\u2019 ](?=\d{3}(?:\D|$))")
# 1.500 where the comma is the decimal mark: fifteen hundred to some, one and a half to others.
_POINTS = re.compile(r"[-+]?[1-9]\d{0,2}(?:\.\d{3})+")


_TOO_LARGE = 10**308


class _Percent(float):
    """A number of a cell that is shown in percent."""


@dataclass(frozen=True)
class ParameterTable:
    """Rows by run name: parameter name -> (value, unit as written, "" where none is).

    notes  what to tell: columns that are left out though they hold numbers
    """

    path: Path
    rows: Mapping[str, Mapping[str, tuple[float, str]]]
    notes: tuple[str, ...] = ()

    def key(self, run: str) -> str:
        """The name of the row of `run`: its own, or the same number written otherwise where only one row is that.

        Run 001 and run_001 have row 1 where the table knows its runs by their numbers alone.

        Raises
        ------
        DataError
            If there is no such row, or if there are several.
        """
        if run in self.rows:
            return run
        same = [key for key in self.rows if _one_form(key) == _one_form(run)]
        if len(same) == 1:
            return same[0]
        number = re.search(r"\d+$", run)
        if number is not None and all(key.isdigit() for key in self.rows):
            alike = [key for key in self.rows if int(key) == int(number[0])]
            if len(alike) == 1:
                return alike[0]
            if alike:
                raise DataError(
                    f"{self.path}: rows {' and '.join(alike)} could both be that of run {run}; name it as {run}"
                )
        names = list(self.rows)
        known = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
        raise DataError(f"{self.path}: has no row for run {run}; its rows are for {known}")

    def row(self, run: str) -> Mapping[str, tuple[float, str]]:
        """The parameters of `run`.

        Raises
        ------
        DataError
            If it has no row.
        """
        return self.rows[self.key(run)]


def _one_form(name: str) -> str:
    """A name whose letters with accents are one character each: file systems and editors part them in their own ways."""
    return unicodedata.normalize("NFC", name)


def read_parameter_table(path: Path, *, numbered: bool = False) -> ParameterTable:
    """The table at `path`, read by its suffix.

    numbered  a table without a column of runs is taken, too: its rows are called row_2, row_3, ... as in the file

    Raises
    ------
    ReadError
        With the row and column of what cannot be understood.
    DataError
        Naming a run with two rows.
    """
    table = _load(path, _KEYS)
    keys = next((found for name in _KEYS if (found := _called(table.header, name))), [])
    if len(keys) > 1:
        told = " and ".join(repr(table.header[k]) for k in keys)
        raise ReadError(f"{path}: columns {told} could both name the runs; rename one of them")
    if not keys and not numbered:
        raise ReadError(
            f"{path}: no column called run; its columns are {', '.join(filter(None, table.header)) or 'none'}; add one "
            "with the names of the runs"
        )
    if not keys:
        table = _Table(["run", *table.header], [(number, ["", *line]) for number, line in table.lines])
    key, numbered = (keys[0], False) if keys else (0, True)
    chosen = [k for k, c in enumerate(table.header) if k != key and _plain(c) not in _KEYS]
    others = [k for k in range(len(table.header)) if k != key and k not in chosen]
    columns = parameter_columns([table.header[k] for k in chosen], [""] * len(chosen), str(path))
    body, below = _without_units_row(table, key, chosen)
    for k, (name, unit) in zip(chosen, columns, strict=True):
        if unit and below.get(k, unit) != unit:
            raise ReadError(
                f"{path}: {name} is in {unit} by its title and in {below[k]} by the row of units; leave one of them"
            )
    beside = _units_beside(path)
    mark = _decimal_mark(body, chosen, path)
    rows: dict[str, dict[str, tuple[float, str]]] = {}
    twice: list[str] = []
    for number, line in body:
        run = f"row_{number}" if numbered else _text(line[key])
        if not run:
            raise ReadError(f"{path}: row {number} names no run in column {table.header[key]!r}")
        if run in rows:
            twice.append(run)
        values = {}
        for k, (name, unit) in zip(chosen, columns, strict=True):
            place = f"{path}: row {number} (run {run}), column {table.header[k]!r}"
            stated = unit or below.get(k, "") or beside.get(name, "")
            values[name] = (_number(line[k], mark, place, percent=stated == "%"), stated)
        rows[run] = values
    if twice:
        raise DataError(f"{path}: more than one row for run {', '.join(dict.fromkeys(twice))}; keep one each")
    if not rows:
        raise ReadError(f"{path}: the table has no row")
    notes = tuple(
        f"{path}: column {table.header[k]!r} is taken for another name of the runs and is no parameter"
        for k in others
        if _holds_values(body, k, key)
    )
    return ParameterTable(path, rows, notes)


def _holds_values(body: Sequence[tuple[int, list[Any]]], column: int, key: int) -> bool:
    """Whether a column of names holds numbers that are not those of the runs."""
    cells = [(_text(line[column]), _text(line[key])) for _, line in body]
    return all(_PLAIN.fullmatch(text) for text, _ in cells) and any(
        not run.endswith(text.lstrip("0") or "0") for text, run in cells
    )


@dataclass(frozen=True)
class _Table:
    """Titles of the columns, and (row in the file, cells) of what stands below; as many cells as columns."""

    header: list[str]
    lines: list[tuple[int, list[Any]]]


@dataclass(frozen=True)
class Numbers:
    """A table of numbers: (name, unit) of each column, and (row in the file, values); NaN where a cell is empty."""

    columns: tuple[tuple[str, str], ...]
    rows: tuple[tuple[int, tuple[float, ...]], ...]


def read_numbers(path: Path, keys: Sequence[str], aside: Sequence[str] = (), what: str = "table of numbers") -> Numbers:
    """A table with numbers in every column, such as measured points; its header has at least one of `keys`.

    Columns called as in `aside` are left out. Messages call it `what`.

    Raises
    ------
    ReadError
        With the row and column of what cannot be understood.
    """
    table = _load(path, keys, what)
    every = [k for k, title in enumerate(table.header) if _plain(title) not in aside]
    columns = parameter_columns([table.header[k] for k in every], [""] * len(every), str(path))
    first = next((k for name in keys for k in _called(table.header, name)), 0)
    body: list[tuple[int, list[Any]]] = table.lines
    below: dict[int, str] = {}
    if body and any(_text(cell) and not _PLAIN.fullmatch(_text(cell)) for cell in body[0][1]):
        body, below = _without_units_row(table, first, [k for k in every if k != first])
    if not body:
        raise ReadError(f"{path}: the table has no row")
    mark = _decimal_mark(body, every, path)
    rows = [
        (
            number,
            tuple(
                math.nan if _text(line[k]) in ("", "-", "nan", "NaN") else
                _number(line[k], mark, f"{path}: row {number}, column {table.header[k]!r}")
                for k in every
            ),
        )
        for number, line in body
    ]  # fmt: skip
    named = tuple((n, u or below.get(k, "")) for k, (n, u) in zip(every, columns, strict=True))
    return Numbers(named, tuple(rows))


def _load(path: Path, keys: Sequence[str], what: str = "parameter table") -> _Table:
    if path.is_dir():
        raise ReadError(f"{path}: is a folder; expected a {what} ({', '.join(SUFFIXES)})")
    if not path.is_file():
        raise ReadError(f"{path}: no such {what}; expected a file ({', '.join(SUFFIXES)})")
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ReadError(f"{path}: a {what} is {', '.join(SUFFIXES)}, not {suffix or 'without suffix'}")
    if path.stat().st_size > _MOST_BYTES:
        raise ReadError(f"{path}: has {path.stat().st_size >> 20} MB; expected a table with a row a run, below 64 MB")
    read = {".json": _json_rows, ".xlsx": _workbook_rows, ".csv": _text_rows, ".tsv": _text_rows}[suffix]
    try:
        lines = read(path, keys)
    except ReadError:
        raise
    except Exception as error:  # each library below has errors of its own
        text = " ".join(str(error).split()) or type(error).__name__
        raise ReadError(f"{path}: cannot be read as a table ({text[:160]})") from error
    lines = [(number, line) for number, line in lines if any(_text(cell) for cell in line)]
    if not lines:
        raise ReadError(f"{path}: cannot be read as a table (it is empty)")
    above = next(
        (k for k, (_, line) in enumerate(lines[:_TITLE_ROWS]) if any(_plain(_text(c)) in keys for c in line)), 0
    )
    header = [_text(cell) for cell in lines[above][1]]
    width = max(len(line) for _, line in lines[above:])
    header += [""] * (width - len(header))
    body = [(number, [*line, *[None] * (width - len(line))]) for number, line in lines[above + 1 :]]
    # A column without a title and without values is what a separator at the end of each line leaves.
    kept = [k for k in range(width) if header[k] or any(_text(line[k]) for _, line in body)]
    doubled = next((c for c, times in Counter(header[k] for k in kept).items() if c and times > 1), None)
    if doubled is not None:
        raise ReadError(f"{path}: column {doubled!r} appears twice")
    nameless = next((k for k in kept if not header[k]), None)
    if nameless is not None:
        raise ReadError(f"{path}: column {nameless + 1} has values and no name; name it in the header, or empty it")
    return _Table([header[k] for k in kept], [(number, [line[k] for k in kept]) for number, line in body])


def _called(header: Sequence[str], name: str) -> list[int]:
    """The columns whose title is `name`, whatever its capitals and signs."""
    return [k for k, title in enumerate(header) if _plain(title) == name]


def _plain(title: str) -> str:
    """A column's title as it is compared with `_KEYS`."""
    return re.sub(r"\W+", "", title).lower()


def _text_rows(path: Path, keys: Sequence[str]) -> list[tuple[int, list[Any]]]:
    text = _decoded(path.read_bytes(), path)
    lines = text.splitlines()
    separator = ""
    if lines and (stated := re.fullmatch(r"\s*\"?sep=(.)\"?\s*", lines[0], re.IGNORECASE)):
        separator = stated[1]
        lines[0] = ""
    lines = ["" if line.lstrip().startswith("#") else line for line in lines]
    if not separator:
        # That of the header, which is the first line that names the column of the runs.
        pattern = re.compile(rf'(?:^|[,;\t|])\s*"?(?:{"|".join(keys)})"?\s*(?:[,;\t|\[( ]|$)', re.IGNORECASE)
        header = next((line for line in lines[:_TITLE_ROWS] if pattern.search(line)), next(filter(None, lines), ""))
        separator = max(";\t|,", key=header.count)
    reader = csv.reader(io.StringIO("\n".join(lines)), delimiter=separator, skipinitialspace=True, strict=True)
    return [(reader.line_num, list(row)) for row in reader]


def _decoded(content: bytes, path: Path) -> str:
    """Text in UTF-8 or UTF-16, which say so themselves or are valid, else in the code page of Windows."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        text = content.decode("utf-16")
    else:
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("cp1252", errors="replace")
            if _OTHER_CODE_PAGE.search(text):
                raise ReadError(
                    f"{path}: its letters are neither UTF-8 nor those of Windows in western Europe; save it as CSV in UTF-8"
                ) from None
    if "\0" in text:
        raise ReadError(f"{path}: holds bytes that are no text; save the table as CSV in UTF-8, or as XLSX")
    return text


def _workbook_rows(path: Path, keys: Sequence[str]) -> list[tuple[int, list[Any]]]:
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as packed:
            size = sum(entry.file_size for entry in packed.infolist())
        if size > 4 * _MOST_BYTES:
            raise ReadError(f"{path}: unpacks to {size >> 20} MB; expected a table with a row a run")
    need(f"reading {path}", "formats")
    import openpyxl

    with contextlib.closing(openpyxl.load_workbook(path, read_only=True, data_only=True)) as book:
        sheets = {sheet.title: _sheet_rows(sheet) for sheet in book.worksheets if sheet.sheet_state == "visible"}
    with_runs = [
        title
        for title, lines in sheets.items()
        if any(_plain(_text(cell)) in keys for _, line in lines[:_TITLE_ROWS] for cell in line)
    ]
    if len(with_runs) > 1:
        raise ReadError(
            f"{path}: sheets {' and '.join(map(repr, with_runs))} both have a column of runs; keep one, or save it as CSV"
        )
    return sheets[with_runs[0]] if with_runs else next(iter(sheets.values()), [])


def _sheet_rows(sheet: Any) -> list[tuple[int, list[Any]]]:
    """The rows of a sheet that hold anything, numbers shown in percent as such; unsolved formulas are empty."""

    def value(cell: Any) -> Any:
        shown = isinstance(cell.value, (int, float)) and not isinstance(cell.value, bool)
        return _Percent(cell.value) if shown and "%" in str(cell.number_format) else cell.value

    # What a sheet says of its own size may be a million empty rows.
    sheet.reset_dimensions()
    rows = ((number, [value(cell) for cell in row]) for number, row in enumerate(sheet.iter_rows(), 1))
    return [(number, row) for number, row in rows if any(cell is not None for cell in row)]


def _json_rows(path: Path, keys: Sequence[str]) -> list[tuple[int, list[Any]]]:
    def distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        twice = next((name for name, times in Counter(name for name, _ in pairs).items() if times > 1), None)
        if twice is not None:
            raise ReadError(f"{path}: {twice!r} appears twice in one object; keep one each")
        return dict(pairs)

    data = json.loads(_decoded(path.read_bytes(), path), object_pairs_hook=distinct)
    if isinstance(data, dict) and all(isinstance(row, dict) for row in data.values()):
        data = [{"run": run, **row} for run, row in data.items()]
    if not isinstance(data, list) or not data or not all(isinstance(row, dict) for row in data):
        raise ReadError(f"{path}: expected a list of rows, or an object of rows by run name")
    header = list(dict.fromkeys(column for row in data for column in row))
    return [(1, header), *((k, [row.get(column) for column in header]) for k, row in enumerate(data, 2))]


def _without_units_row(
    table: _Table, key: int, chosen: Sequence[int]
) -> tuple[list[tuple[int, list[Any]]], dict[int, str]]:
    """The rows of runs, and the units of columns where the first row below the header holds them."""
    if not table.lines:
        return table.lines, {}
    first = table.lines[0][1]
    cells = {k: _text(first[k]).strip("[]() ") for k in chosen}
    told = {k: text for k, text in cells.items() if text}
    if (
        _text(first[key]).lower().strip("[]():") not in _UNIT_ROWS
        or not told
        or not all(is_unit(text) for text in told.values())
    ):
        return table.lines, {}
    return table.lines[1:], {k: "" if text == "-" else text for k, text in told.items()}


def _decimal_mark(body: Sequence[tuple[int, list[Any]]], chosen: Sequence[int], path: Path) -> str:
    """What a comma in the numbers of the table is: "decimal", "thousands", or "" where there is none.

    Raises
    ------
    ReadError
        Where both would do ("350,000"), or cells contradict each other.
    """
    cells = [(number, _SPACES.sub("", _text(line[k])).replace("\u2212", "-")) for number, line in body for k in chosen]
    with_comma = [(number, text) for number, text in cells if "," in text]
    decimal = [(n, t) for n, t in with_comma if _DECIMAL_COMMA.fullmatch(t) and not _THOUSANDS.fullmatch(t)]
    thousands = [(n, t) for n, t in with_comma if _THOUSANDS.fullmatch(t) and not _DECIMAL_COMMA.fullmatch(t)]
    either = [(n, t) for n, t in with_comma if _THOUSANDS.fullmatch(t) and _DECIMAL_COMMA.fullmatch(t)]
    if decimal and thousands:
        raise ReadError(
            f"{path}: the comma is a decimal mark in row {decimal[0][0]} ({decimal[0][1]}) and stands between thousands in "
            f"row {thousands[0][0]} ({thousands[0][1]}); write all numbers with a decimal point"
        )
    if either and not decimal and not thousands:
        number, text = either[0]
        raise ReadError(
            f"{path}: row {number}: {text!r} may be {text.replace(',', '')} or {text.replace(',', '.')}; write it without "
            "the comma, or with a decimal point"
        )
    return "decimal" if decimal else "thousands" if thousands else ""


def _text(cell: Any) -> str:
    """A cell as text; spreadsheets keep the number 3 as 3.0 at times."""
    if cell is None or cell != cell:
        return ""
    text = str(int(cell)) if isinstance(cell, float) and cell.is_integer() else str(cell)
    return "".join(c for c in text if unicodedata.category(c) != "Cf").strip()  # invisible characters


def _number(cell: Any, mark: str, place: str, *, percent: bool = False) -> float:
    if isinstance(cell, _Percent):
        # What the spreadsheet shows as 50 % it keeps as 0.5.
        value = 100.0 * cell if percent else float(cell)
    elif isinstance(cell, (int, float)) and not isinstance(cell, bool):
        value = float(cell) if abs(cell) < _TOO_LARGE else math.inf
    else:
        text = _SPACES.sub("", _text(cell)).replace("\u2212", "-")
        if mark == "decimal" and _POINTS.fullmatch(text):
            plain = text.replace(".", "")
            raise ReadError(
                f"{place}: {text!r} may be {plain} or {float(text):g}; write it without the point, or with a comma"
            )
        if mark == "decimal" and _DECIMAL_COMMA.fullmatch(text):
            text = text.replace(".", "").replace(",", ".")
        elif mark == "thousands" and _THOUSANDS.fullmatch(text):
            text = text.replace(",", "")
        value = float(text) if _PLAIN.fullmatch(text) else float("nan")
    if value != value or abs(value) == float("inf"):
        words = _text(cell)[:1].isalpha() and _text(cell).lower() not in ("nan", "inf", "none", "na")
        cure = "; take a column that is no parameter out of the table" if words else ""
        raise ReadError(f"{place}: found {_text(cell)[:40] or 'nothing'!r}, expected a number{cure}")
    return value


def _units_beside(path: Path) -> Mapping[str, str]:
    import yaml

    for suffix in (".yaml", ".yml"):
        beside = path.with_suffix(suffix)
        if not beside.is_file():
            continue
        try:
            units = yaml.safe_load(beside.read_text(encoding="utf-8"))
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise ReadError(f"{beside}: not readable as YAML ({' '.join(str(error).split())[:160]})") from error
        if not isinstance(units, dict):
            raise ReadError(f"{beside}: expected lines such as impact_speed: m/s")
        return {parameter_name(str(name), str(beside)): str(unit) for name, unit in units.items()}
    return {}
