"""What test runs said of a band is noted beside a model, and nonsense there is no note."""

from __future__ import annotations

from pathlib import Path

import pytest

from evaluation.report import verdict
from surrogates.storage.tested import BAND_HOLDS, BandCheck, held_on_tests, note_held


def test_what_was_noted_comes_back_and_a_missed_promise_is_said(tmp_path: Path) -> None:
    note_held(tmp_path, {"MH1": BandCheck(0.62, 9), "MH2": BandCheck(0.91, 9)})
    held = held_on_tests(tmp_path)
    assert held["MH1"].told.endswith("held 62 % of nodes and states: it is too narrow, do not take it for the error")
    assert held["MH2"].told == "on 9 test runs the 90 % band held 91 % of nodes and states"


def test_the_report_warns_below_the_same_share() -> None:
    assert verdict.BAND_HOLDS == BAND_HOLDS


@pytest.mark.parametrize("text", ["[", "3", '{"MH1": 3}', '{"MH1": {"share": 2, "runs": 1}}', "[" * 100_000])
def test_what_cannot_be_is_no_note(tmp_path: Path, text: str) -> None:
    (tmp_path / "tested.json").write_text(text)
    assert held_on_tests(tmp_path) == {}


def test_where_nothing_can_be_written_there_is_no_note(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    note_held(tmp_path / "file", {"MH1": BandCheck(0.9, 4)})
    assert held_on_tests(tmp_path / "file") == {}
