"""Progress: one shape, eighty columns, never silent, stages from below through logging."""

from __future__ import annotations

import logging
import time

import pytest

from crashkit.cli import _progress
from crashkit.cli._console import print_json, say, wrapped
from crashkit.cli._progress import Progress, line


def test_a_line_of_training_fits_eighty_columns() -> None:
    said = line("MH3", 120, 300, "validation 1.65 cm (best 1.65, epoch 21)", 38.2)
    assert said == "MH3 120/300 | validation 1.65 cm (best 1.65, epoch 21) | 38 s left"
    assert len(said) <= 80


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("ingest", 0, 0, "looking at run_1", None), "ingest | looking at run_1"),
        (("ingest", 36, 36, "", 0.0), "ingest 36/36"),
        (("figures", 2, 19, "", 300.0), "figures 2/19 | 5 min left"),
    ],
)
def test_what_is_not_known_is_left_out(arguments: tuple, said: str) -> None:
    assert line(*arguments) == said


def test_work_that_says_nothing_is_spoken_for(capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    monkeypatch.setattr(_progress, "FIRST", 0.05)
    monkeypatch.setattr(_progress, "SILENCE", 0.05)
    with Progress("reading kart.zarr"):
        time.sleep(1.0)
    assert capsys.readouterr().err.count("reading kart.zarr ... ") >= 2


def test_with_json_nothing_is_said(capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    monkeypatch.setattr(_progress, "FIRST", 0.0)
    with Progress("reading", quiet=True) as shown:
        shown.step("runs", 3, 3)
        time.sleep(0.4)
    assert capsys.readouterr().err == ""


def test_what_the_rooms_log_becomes_a_stage_and_the_loggers_are_left_as_they_were(
    capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    monkeypatch.setattr(_progress, "SILENCE", 0.05)
    logger = logging.getLogger("surrogates")
    before = list(logger.handlers), logger.level
    with Progress("starting"):
        logging.getLogger("surrogates.models").info("fitting Gaussian processes")
        logging.getLogger("evaluation.figures").warning("a figure cannot be loaded")
        time.sleep(0.6)
    told = capsys.readouterr().err
    assert "fitting Gaussian processes" in told
    assert "warning: a figure cannot be loaded" in told
    assert (list(logger.handlers), logger.level) == before


def test_finished_work_is_said_once(capsys: pytest.CaptureFixture[str]) -> None:
    with Progress("starting") as shown:
        for k in range(1, 4):
            shown.step("runs", k, 3)
        shown.step("runs", 3, 3)
    assert capsys.readouterr().err == "runs 3/3\n"


def test_counted_work_that_ended_does_not_look_as_if_it_hung(capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    monkeypatch.setattr("crashkit.cli._progress.SILENCE", 0.3)
    with Progress("starting") as shown:
        shown.step("test runs", 9, 9)
        time.sleep(0.8)
    assert "test runs 9/9 done, going on ... " in capsys.readouterr().err


def test_json_has_neither_nan_nor_infinity(capsys: pytest.CaptureFixture[str]) -> None:
    print_json({"a": float("nan"), "b": [float("inf"), -float("inf"), 1.5]})
    assert capsys.readouterr().out.split() == ["{", '"a":', "null,", '"b":', "[", "null,", "null,", "1.5", "]", "}"]


def test_names_that_the_terminal_cannot_show_do_not_end_a_command(monkeypatch) -> None:
    import io
    import sys

    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stderr", stream)
    say("run Längsträger")
    stream.flush()
    assert stream.buffer.getvalue() == b"run L\\xe4ngstr\\xe4ger\n"


def test_long_lines_are_broken_between_words_and_paths_never() -> None:
    path = "/a" * 50
    lines = wrapped(f"  {'word ' * 20}{path} and more", 40).split("\n")
    assert all(len(line) <= 40 or line.strip() == path for line in lines)
    assert [line[: len(line) - len(line.lstrip())] for line in lines] == ["  ", *["    "] * (len(lines) - 1)]
    assert " ".join(" ".join(lines).split()) == f"{'word ' * 20}{path} and more"


def test_the_time_left_counts_down_while_nothing_is_told(capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    monkeypatch.setattr(_progress, "FIRST", 0.0)
    monkeypatch.setattr(_progress, "SILENCE", 0.0)
    with Progress("starting") as shown:
        shown.step("MH2", 32, 60, "validation 2.69 cm", left=1.6)
        time.sleep(2.3)
    said = capsys.readouterr().err.splitlines()
    counted = [text.split(" ... ")[0] for text in said if text.startswith("MH2")]
    assert "MH2 32/60 | validation 2.69 cm | 1 s left" in counted
    assert counted[-1] == "MH2 32/60 | validation 2.69 cm"


def test_a_message_stands_above_the_live_line(monkeypatch) -> None:
    import io
    import sys

    class Terminal(io.StringIO):
        encoding = "utf-8"

        def isatty(self) -> bool:
            return True

    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "80")
    with Progress("predicting r6 6/40"):
        time.sleep(0.3)
        say("error: interrupted; go on with --resume")
    before = screen.getvalue().split("error: interrupted")[0]
    assert before.endswith("\r\x1b[2K"), "the live line is cleared first"
    say("afterwards")
    assert screen.getvalue().endswith("afterwards\n")


def test_long_names_in_narrow_tables_are_folded_and_not_cut(capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    from crashkit.cli._console import table

    monkeypatch.setenv("COLUMNS", "80")
    name = "front_longitudinal_member_left_inner_reinforcement_panel"
    table(
        "Parts",
        ("part", "a long heading", "another long heading", "limit"),
        [(name, 1, 2, "max(displacement(part=box))")],
    )
    out = capsys.readouterr().out
    assert "…" not in out
    cells = [line.split("│") for line in out.splitlines() if line.startswith("│")]
    assert "".join(cell[1].strip() for cell in cells) == name
