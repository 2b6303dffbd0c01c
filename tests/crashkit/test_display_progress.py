"""Progress in a notebook: one line that is written anew, and nothing elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Callable
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


class Events:
    """What a notebook's shell calls when a cell is done."""

    def __init__(self) -> None:
        self.calls: list[Callable[..., None]] = []

    def register(self, when: str, call: Callable[..., None]) -> None:
        assert when == "post_run_cell"
        self.calls.append(call)

    def unregister(self, when: str, call: Callable[..., None]) -> None:
        self.calls.remove(call)


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> tuple[list[str], Events]:
    """A notebook's shell that notes what it shows, and its events."""
    lines: list[str] = []
    events = Events()
    handle = SimpleNamespace(update=lambda line: lines.append(f"again {line}"))

    def display(line: str, display_id: bool) -> SimpleNamespace:
        lines.append(line)
        return handle

    shell = SimpleNamespace(
        get_ipython=lambda: SimpleNamespace(kernel=1, events=events),
        display=SimpleNamespace(HTML=str, display=display),
    )
    monkeypatch.setitem(sys.modules, "IPython", shell)
    monkeypatch.setitem(sys.modules, "IPython.display", shell.display)
    return lines, events


def test_in_a_notebook_one_line_is_shown_and_written_anew(shown: tuple[list[str], Events]) -> None:
    lines, _ = shown
    assert in_notebook()
    report = watched(None)
    report("MH3", 1, 2, "")
    report("MH3", 2, 2, "best")
    assert lines == [progress_html("MH3", 1, 2, ""), "again " + progress_html("MH3", 2, 2, "best")]


def test_the_line_leaves_when_the_cell_is_done(shown: tuple[list[str], Events]) -> None:
    lines, events = shown
    report = watched(None)
    report("figures", 17, 25, "meshes")
    for call in list(events.calls):
        call()
    assert lines[-1] == "again "
    assert events.calls == []


def test_texts_are_escaped() -> None:
    assert progress_html("<b>", 1, 0, "a & b") == "<div>&lt;b&gt; 1 a &amp; b</div>"
