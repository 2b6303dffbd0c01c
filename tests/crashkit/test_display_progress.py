"""Progress in a notebook: one line that is written anew, and nothing elsewhere."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest

from crashkit.display import NotebookLine, in_notebook, progress_html, watched
from data_schema.progress import silent


def test_outside_a_notebook_nobody_listens_unless_asked() -> None:
    assert not in_notebook()
    assert watched(None) is silent
    assert watched(None, False) is silent
    assert isinstance(watched(None, True), NotebookLine)


def test_a_listener_of_the_users_own_comes_first() -> None:
    heard: list[tuple[str, int, int, str]] = []
    watched(lambda *told: heard.append(told), True)("MH3", 1, 2, "validation 1.65 cm")
    assert heard == [("MH3", 1, 2, "validation 1.65 cm")]


def test_in_a_notebook_one_line_is_shown_and_written_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []
    handle = SimpleNamespace(update=lambda line: shown.append(f"again {line}"))

    def display(line: str, display_id: bool) -> SimpleNamespace:
        shown.append(line)
        return handle

    shell = SimpleNamespace(
        get_ipython=lambda: SimpleNamespace(kernel=1), display=SimpleNamespace(HTML=str, display=display)
    )
    monkeypatch.setitem(sys.modules, "IPython", shell)
    monkeypatch.setitem(sys.modules, "IPython.display", shell.display)
    assert in_notebook()
    report = watched(None)
    report("MH3", 1, 2, "")
    report("MH3", 2, 2, "best")
    assert shown[0] == progress_html("MH3", 1, 2, "")
    assert shown[1] == "again " + progress_html("MH3", 2, 2, "best")


def test_texts_are_escaped() -> None:
    assert progress_html("<b>", 1, 0, "a & b") == "<div>&lt;b&gt; 1 a &amp; b</div>"
