"""The report: complete, self-contained, escaped, and made of the numbers that lie beside it."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from evaluation.comparison.result import compare
from evaluation.comparison.split import Split, agree_on_split
from evaluation.drawing.style import Sheet, readable, smoothed, styles
from evaluation.figures import ORDER, drawings, kinds, sheet_of
from evaluation.figures.kind import drawn, image
from evaluation.report.files import write_run
from evaluation.report.page import plain, show_table
from evaluation.report.report import write_report

PICTURES = ("worst", "map", "folds", "contributions", "meshes", "paraview")


class _Page(HTMLParser):
    """Balanced tags, and everything that a browser would fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.fetched: list[str] = []
        self.links: list[str] = []
        self.ids: set[str] = set()

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.ids.add(values.get("id") or "")
        self.fetched += [values[a] for a in ("src", "srcset", "poster", "data") if a in values]
        if tag == "link":
            self.fetched.append(values.get("href", ""))
        if tag == "a":
            self.links.append(values["href"])
        if tag not in ("meta", "img", "source", "br", "link"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag


def parsed(path: Path) -> _Page:
    page = _Page()
    page.feed(path.read_text(encoding="utf-8"))
    assert page.open == []
    return page


# Shown where models say something of elements, curves or numbers; tests/crashkit/test_bumper.py and test_numbers.py draw them.
OF_OTHER_TARGETS = ("removal", "element_fields", "numbers", "histories")


@pytest.fixture(scope="module")
def report(evaluation, tmp_path_factory) -> Iterator[Path]:
    with pytest.MonkeyPatch.context() as small:  # software rendering of large pictures takes most of a minute
        small.setattr("evaluation.drawing.pictures.PIXELS_PER_CM", 12)
        folder = tmp_path_factory.mktemp("report")
        files = write_run(evaluation, 9, folder / "vtk")
        yield write_report(replace(evaluation, files=tuple(files)), folder, view=False)


def test_every_figure_is_there_three_times(report):
    page = parsed(report)
    for name in ORDER:
        if name in OF_OTHER_TARGETS:
            continue
        assert f"figure-{name}" in page.ids
        png, svg, numbers = (report.parent / "figures" / f"{name}.{s}" for s in ("png", "svg", "csv"))
        assert png.read_bytes().startswith(b"\x89PNG")
        assert b"<svg" in svg.read_bytes()
        rows = list(csv.reader(numbers.open(encoding="utf-8")))
        assert len(rows) > 1
        assert {len(row) for row in rows} == {len(rows[0])}


def test_nothing_is_fetched_and_links_stay_inside(report):
    page = parsed(report)
    assert page.fetched
    assert all(address.startswith("data:image/") for address in page.fetched)
    assert all(link.startswith("#") or (report.parent / link).is_file() for link in page.links)
    text = report.read_text(encoding="utf-8")
    assert "@import" not in text
    assert "url(" not in text
    assert "<script" not in text


def test_it_says_the_numbers_of_the_json_beside_it(report, evaluation):
    numbers = json.loads((report.parent / "report.json").read_text(), parse_constant=pytest.fail)
    row = numbers["performance"][0]
    assert row["model"] == "MH1"
    assert row["error_cm"] == pytest.approx(100 * evaluation.scores["MH1"].mean)
    text = report.read_text(encoding="utf-8")
    assert plain(row["error_cm"]) in text
    assert all(s["text"].split(":")[0] in text for s in numbers["statements"])
    assert numbers["test_runs"] == ["run_09", "run_10", "run_11"]
    table = list(csv.DictReader((report.parent / "tables" / "performance.csv").open(encoding="utf-8")))
    assert float(table[0]["error_cm"]) == pytest.approx(row["error_cm"], rel=1e-6)


def test_names_from_the_data_are_escaped(reference, models, tmp_path):
    evil = "<script>alert(1)</script>"
    named = replace(reference, runs=(*reference.runs[:9], evil, *reference.runs[10:]))
    seen = [replace(m, held_out_runs=(evil, "run_10")) for m in models[1:]]
    result = compare(named, seen, agree_on_split(named, seen), timed=False, context={"Dataset": evil})
    text = write_report(result, tmp_path, names=("error_over_time",), view=False).read_text(encoding="utf-8")
    assert "<script" not in text
    assert "&lt;script&gt;alert(1)" in text


def test_one_test_run_and_one_model_make_a_report(reference, models, tmp_path):
    result = compare(reference, models[1:2], Split(tuple(range(9)), (9,)), timed=False)
    by_run = ("error_over_time", "floors", "parameters", "regions", "rigid", "intrusion", "ratings")
    page = write_report(result, tmp_path, names=by_run, view=False)
    assert "All numbers come from a single test run" in page.read_text(encoding="utf-8")
    assert json.loads((tmp_path / "report.json").read_text())["performance"][0]["spread_cm"] is None


def test_where_nothing_can_be_rendered_the_rest_is_there(evaluation, tmp_path, monkeypatch):
    monkeypatch.setattr("evaluation.drawing.rendering.rendering_problem", lambda: "no display here")
    page = parsed(write_report(evaluation, tmp_path, names=("error_over_time", "worst", "map", "meshes"), view=True))
    assert "figure-error_over_time" in page.ids
    assert "figure-worst" not in page.ids
    assert "no display here" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_every_file_in_the_folder_of_figures_that_is_a_figure_is_in_order():
    folder = Path(__file__).parents[3] / "evaluation" / "figures"
    files = {p.stem for p in folder.glob("*.py") if "\nFIGURE = Kind(" in p.read_text(encoding="utf-8")}
    assert files == set(ORDER)
    assert [kind.name for kind in kinds()] == list(ORDER)


def test_figures_fit_a_page_and_a_phone(evaluation):
    for kind, drawing in drawings(evaluation, [n for n in ORDER if n not in PICTURES]):
        for width in (17.0, 9.0):
            figure = drawn(drawing, sheet_of(evaluation, width))
            assert figure.get_figwidth() * 2.54 <= width + 1e-6, kind.name
        assert len(drawing.caption()) > 80
        assert "nan" not in drawing.caption()


def test_the_same_figure_gives_the_same_file(evaluation):
    ((_, drawing),) = drawings(evaluation, ["error_over_time"])
    first, second = (image(drawn(drawing, sheet_of(evaluation)), "svg") for _ in range(2))
    assert first == second


def test_a_model_looks_the_same_everywhere_and_unlike_the_others():
    labels = ["MH1", "PODNN", "POD-GPR r=12", "mine", "MH1 (other)"]
    looks = styles(labels)
    assert len({s.colour for s in looks.values()}) == len(labels)
    assert looks["MH1"].colour == styles(["PODNN", "MH1"])["MH1"].colour
    assert Sheet(styles=looks).style("mine") == looks["mine"]


def test_smoothing_keeps_length_and_constants_and_drops_spikes():
    values = np.ones(50)
    values[20] = 99
    assert smoothed(values).tolist() == [1.0] * 50


@pytest.mark.parametrize(
    ("values", "unit", "expected", "shown"),
    [([2e8], "Pa", 200, "MPa"), ([20.0], "Pa", 20, "Pa"), ([0.002], "m", 2, "mm"), ([3.0], "m s-1", 3, "m/s")],
)
def test_units_people_read(values, unit, expected, shown):
    out, name = readable(np.array(values), unit)
    assert out[0] == pytest.approx(expected)
    assert name == shown


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (float("nan"), "–"),
        (None, "–"),
        (0.0, "0"),
        (0.00213, "0.0021"),
        (1.2345, "1.23"),
        (2.0, "2.00"),
        (999.7, "1000"),
        (12345, "12\u2009345"),
        (7, "7"),
    ],
)
def test_numbers_people_read(value, text):
    assert plain(value) == text


def test_columns_of_a_table_stand_in_units_people_read():
    table = show_table("Runs", {"yield_stress (Pa)": [2.5e8], "peak_cm": [1.0], "note (old)": ["x"]})
    assert [c.name for c in table.columns] == ["yield stress (MPa)", "peak (cm)", "note (old)"]
    assert [cell.value for cell in table.rows[0]] == ["250", "1.00", "x"]


def test_of_the_levels_of_a_cascade_the_best_alone_leads(evaluation):
    assert sorted(e.label for e in evaluation.leaders) == sorted(
        ["PODNN", "POD-GPR", min(("MH1", "MH2", "MH3"), key=lambda m: evaluation.scores[m].mean)]
    )


def test_no_run_leaves_the_panel_of_its_model(evaluation):
    ((_, drawing),) = drawings(evaluation, ["error_over_time"])
    for axes in drawn(drawing, sheet_of(evaluation)).axes:
        assert axes.get_ylim()[1] >= max(line.get_ydata().max() for line in axes.lines)


def test_a_legend_of_long_names_stays_within_the_figure(evaluation):
    ((_, drawing),) = drawings(evaluation, ["floors"])
    long = replace(drawing, points={f"{label} (a long folder name)": p for label, p in drawing.points.items()})
    figure = drawn(long, Sheet(9.0))
    figure.draw_without_rendering()
    (legend,) = figure.legends
    assert legend.get_window_extent().x1 <= figure.bbox.x1


def test_no_number_of_the_report_carries_a_stray_nan(report):
    text = re.sub(r"data:image/[^\"]+", "", report.read_text(encoding="utf-8"))
    assert not re.search(r">\s*nan\s*<|\bnan cm|\bnan %", text)
