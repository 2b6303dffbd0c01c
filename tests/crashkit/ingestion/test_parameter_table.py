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
        ("runs.csv", "run,a,a\nx,1,2\n", ReadError, "column 'a' appears twice"),
        ("runs.json", '{"x": 3}', ReadError, "expected a list of rows"),
        ("runs.json", "[{", ReadError, "cannot be read as a table"),
        ("runs.xlsx", "no workbook", ReadError, "cannot be read as a table"),
        ("runs.txt", "run a", ReadError, r"a parameter table is .csv, .tsv, .json, .xlsx, not .txt"),
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


SPEEDS = {"001": {"speed": (50.5, "km/h"), "t": (1.0, "mm")}, "002": {"speed": (51.5, "km/h"), "t": (1.5, "mm")}}


@pytest.mark.parametrize(
    "content",
    [
        "run;speed [km/h];t [mm]\r\n001;50,5;1,0\r\n002;51,5;1,5\r\n".encode("utf-8-sig"),
        "run;speed [km/h];t [mm]\n001;50,5;1,0\n002;51,5;1,5\n".encode("utf-16"),
        b"sep=;\nrun;speed [km/h];t [mm]\n001;50,5;1,0\n002;51,5;1,5\n",
        b"run\tspeed [km/h]\tt [mm]\n001\t50,5\t1,0\n002\t51,5\t1,5\n",
        b"run,speed [km/h],t [mm],\n001,50.5,1,\n002,51.5,1.5,\n",
        b"# a comment\nrun,speed (km/h),t in mm\n001,50.5,1\n002,51.5,1.5\n",
        b"Front crash,,\n,,\nrun,speed,t\n,km/h,mm\n001,50.5,1\n002,51.5,1.5\n",
        b"run,speed,t\nunit,[km/h],[mm]\n001,50.5,1\n002,51.5,1.5\n",
        b"name,run,speed [km/h],t [mm]\nfast,001,50.5,1\nfaster,002,51.5,1.5\n",
    ],
    ids=["german", "utf-16", "sep", "tabs", "trailing comma", "comment", "title and units row", "units row", "name and run"],
)  # fmt: skip
def test_what_spreadsheets_leave_is_read(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "runs.csv").write_bytes(content)
    assert read_parameter_table(tmp_path / "runs.csv").rows == SPEEDS


def test_the_code_page_of_windows_and_letters_of_other_languages(tmp_path: Path) -> None:
    (tmp_path / "runs.csv").write_bytes("run;Tür [°]\n1;0,5\n".encode("cp1252"))
    assert read_parameter_table(tmp_path / "runs.csv").rows == {"1": {"Tür": (0.5, "°")}}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("350,000,000", 3.5e8),
        ("1,000.5", 1000.5),
        ("1.000,5", 1000.5),
        ("350 000", 3.5e5),
        ("0,5", 0.5),
        ("-12,25", -12.25),
        ("1,5e-3", 0.0015),
        ("2.5E3", 2500.0),
    ],
)
def test_numbers_of_one_meaning_are_read(tmp_path: Path, text: str, expected: float) -> None:
    (tmp_path / "runs.csv").write_text(f'run;a\nx;"{text}"\n')
    assert read_parameter_table(tmp_path / "runs.csv").rows["x"]["a"][0] == expected


def test_titles_units_and_merged_cells_of_a_workbook(tmp_path: Path) -> None:
    lines = [
        ["Front crash", None, None],
        ["run", "speed", "t"],
        [None, "km/h", "mm"],
        ["001", 50.5, 1],
        ["002", 51.5, 1.5],
    ]
    pd.DataFrame(lines).to_excel(tmp_path / "runs.xlsx", index=False, header=False)
    assert read_parameter_table(tmp_path / "runs.xlsx").rows == SPEEDS


@pytest.mark.parametrize(
    ("header", "names"),
    [
        ("t (front),t (rear)", {"t_front": "", "t_rear": ""}),
        ("t [front],t [rear]", {"t_front": "", "t_rear": ""}),
        ("t (mm),t (min)", {"t": "mm", "t_min": ""}),
        ("speed [m/ss],E [N/mm²]", {"speed": "m/ss", "E": "N/mm²"}),
        ("a (rail) [mm],b", {"a_rail": "mm", "b": ""}),
    ],
)
def test_brackets_hold_a_unit_or_belong_to_the_name(tmp_path: Path, header: str, names: dict[str, str]) -> None:
    (tmp_path / "runs.csv").write_text(f"run,{header}\nx,1,2\n", encoding="utf-8")
    row = read_parameter_table(tmp_path / "runs.csv").rows["x"]
    assert {name: unit for name, (_, unit) in row.items()} == names


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("run,speed [m/s],speed [km/h]\nx,1,2\n", r"columns 'speed \[m/s\]' and 'speed \[km/h\]' would both be parameter"),
        ("run,a b,a_b\nx,1,2\n", "columns 'a b' and 'a_b' would both be parameter a_b; rename one"),
        ("run,a\nx,\"350,000\"\n", "'350,000' may be 350000 or 350.000; write it without the comma"),
        ("run;a;b\nx;1,5;\"350,000,000\"\n", r"decimal mark in row 2 \(1,5\) and stands between thousands in row 2"),
        ("run,a,\nx,1,2\n", "column 3 has values and no name"),
        ("run,...\nx,1\n", "'...' is no name of a parameter"),
        ("run,a\nx,1_000\n", "found '1_000', expected a number"),
        ("run,a\nx,\0\n", "holds bytes that are no text"),
    ],
)  # fmt: skip
def test_what_has_two_meanings_is_refused_with_the_cure(tmp_path: Path, content: str, told: str) -> None:
    (tmp_path / "runs.csv").write_text(content)
    with pytest.raises(ReadError, match=told):
        read_parameter_table(tmp_path / "runs.csv")


def test_runs_find_their_rows_by_number_where_that_is_unique(tmp_path: Path) -> None:
    (tmp_path / "runs.json").write_text('[{"run": 1, "a": 10}, {"run": 2, "a": 11}]')
    table = read_parameter_table(tmp_path / "runs.json")
    assert [table.row(run)["a"][0] for run in ("001", "1", "run_002")] == [10, 10, 11]
    with pytest.raises(DataError, match="has no row for run 003"):
        table.row("003")
    (tmp_path / "runs.csv").write_text("run,a\n01,1\n1,2\n")
    twice = read_parameter_table(tmp_path / "runs.csv")
    assert twice.row("1")["a"][0] == 2
    with pytest.raises(DataError, match="rows 01 and 1 could both be that of run 001"):
        twice.row("001")


def test_one_key_twice_in_json_is_refused(tmp_path: Path) -> None:
    (tmp_path / "runs.json").write_text('{"x": {"a": 1}, "x": {"a": 2}}')
    with pytest.raises(ReadError, match="'x' appears twice"):
        read_parameter_table(tmp_path / "runs.json")


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("runs.csv", "run;v\nx;1.500\ny;2.250,5\n", r"row 2 \(run x\), column 'v': '1.500' may be 1500 or 1.5"),
        ("runs.csv", "run,v [m/s]\n,km/h\nx,1\n", "v is in m/s by its title and in km/h by the row of units"),
        ("runs.csv", "run,Run,v\nx,a,1\n", "columns 'run' and 'Run' could both name the runs"),
        ("runs.json", '[{"run": "x", "v": %s}]' % ("9" * 400), "found '9{40}', expected a number"),
    ],
)
def test_what_contradicts_itself_is_refused(tmp_path: Path, name: str, content: str, told: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(ReadError, match=told):
        read_parameter_table(tmp_path / name)


def test_tabs_typeset_minus_and_thin_spaces(tmp_path: Path) -> None:
    (tmp_path / "runs.tsv").write_text("run\tv\nUnit:\tmm\nx\t\u22125\ny\t1\u2009000\n", "utf-8")
    assert read_parameter_table(tmp_path / "runs.tsv").rows == {"x": {"v": (-5.0, "mm")}, "y": {"v": (1000.0, "mm")}}


def workbook(path: Path, **sheets: list[list[object]]) -> Path:
    import openpyxl

    book = openpyxl.Workbook()
    book.remove(book.active)
    for title, lines in sheets.items():
        sheet = book.create_sheet(title)
        for line in lines:
            sheet.append(line)
        for row in sheet.iter_rows():
            for cell in row:
                if isinstance(cell.value, float) and cell.value < 1:
                    cell.number_format = "0.0%"
    book.save(path)
    return path


def test_numbers_that_a_spreadsheet_shows_in_percent_are_percent(tmp_path: Path) -> None:
    path = workbook(tmp_path / "runs.xlsx", doe=[["run", "overlap [%]", "ratio"], ["x", 0.4, 0.5]])
    assert read_parameter_table(path).rows["x"] == {"overlap": (40.0, "%"), "ratio": (0.5, "")}


def test_the_sheet_with_the_runs_is_read_and_two_are_refused(tmp_path: Path) -> None:
    lines = [["run", "v"], ["x", 3]]
    one = workbook(tmp_path / "one.xlsx", cover=[["Project"]], doe=lines)
    assert read_parameter_table(one).rows == {"x": {"v": (3.0, "")}}
    with pytest.raises(ReadError, match="sheets 'doe' and 'old' both have a column of runs; keep one"):
        read_parameter_table(workbook(tmp_path / "two.xlsx", doe=lines, old=lines))


def test_a_cell_at_the_end_of_a_sheet_takes_no_memory(tmp_path: Path) -> None:
    import openpyxl

    path = workbook(tmp_path / "runs.xlsx", doe=[["run", "v"], ["x", 3]])
    book = openpyxl.load_workbook(path)
    book["doe"].cell(1_000_000, 1, "y")
    book["doe"].cell(1_000_000, 2, 4)
    book.save(path)
    assert read_parameter_table(path).rows == {"x": {"v": (3.0, "")}, "y": {"v": (4.0, "")}}


def test_accents_written_in_two_ways_are_the_same(tmp_path: Path) -> None:
    (tmp_path / "runs.csv").write_text("run,angle\nTu\u0308r 1,15\nT\u00fcr 2,20\n", encoding="utf-8")
    table = read_parameter_table(tmp_path / "runs.csv")
    assert table.row("T\u00fcr 1")["angle"] == (15.0, "")
    assert table.row("Tu\u0308r 2")["angle"] == (20.0, "")


@pytest.mark.parametrize(("cells", "said"), [(("1.5", "2.5"), True), (("1", "2"), False), (("base", "soft"), False)])
def test_a_second_column_of_names_that_holds_numbers_is_said(
    tmp_path: Path, cells: tuple[str, str], said: bool
) -> None:
    (tmp_path / "runs.csv").write_text(f"run,sim,angle\nrun_01,{cells[0]},15\nrun_02,{cells[1]},20\n")
    notes = read_parameter_table(tmp_path / "runs.csv").notes
    assert [
        note.endswith("column 'sim' is taken for another name of the runs and is no parameter") for note in notes
    ] == ([True] if said else [])


@pytest.mark.parametrize(
    ("code_page", "title"),
    [("cp437", "größe"), ("mac_roman", "größe"), ("shift_jis", "速度"), ("gbk", "厚度"), ("cp1251", "скорость")],
)
def test_letters_of_another_code_page_are_refused_instead_of_misread(tmp_path, code_page, title):
    (tmp_path / "runs.csv").write_bytes(f"run,{title} [mm]\nx,1\n".encode(code_page))
    with pytest.raises(ReadError, match="save it as CSV in UTF-8"):
        read_parameter_table(tmp_path / "runs.csv")


@pytest.mark.parametrize("title", ["größe", "l’épaisseur", "contraseña", "Øre", "winkel °", "„Maß“"])
def test_letters_of_western_europe_are_read(tmp_path, title):
    (tmp_path / "runs.csv").write_bytes(f"run,{title} [mm]\nx,1\n".encode("cp1252"))
    assert list(read_parameter_table(tmp_path / "runs.csv").row("x").values()) == [(1.0, "mm")]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("run,speed [m/s\nx,1\n", r"column 'speed \[m/s' lacks a bracket '\]'"),
        ("run,speed [m/s] [km/h]\nx,1\n", "states two units, m/s and km/h"),
        ("run,speed (m/s) in km/h\nx,1\n", "states two units"),
        ("run,speed,note\nx,1,good\n", "found 'good', expected a number; take a column that is no parameter out"),
    ],
)
def test_titles_and_columns_that_are_no_parameter_are_told_with_the_cure(tmp_path, text, told):
    (tmp_path / "runs.csv").write_text(text)
    with pytest.raises(ReadError, match=told):
        read_parameter_table(tmp_path / "runs.csv")


def test_invisible_letters_of_a_run_name_do_not_count(tmp_path):
    (tmp_path / "runs.csv").write_text("run,speed\nx\u200b,1\n\ufeffy,2\n")
    assert read_parameter_table(tmp_path / "runs.csv").row("y") == {"speed": (2.0, "")}
