"""What an object says of itself, at a prompt and in a notebook: a title, facts, and perhaps a table."""

from __future__ import annotations

import html
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

from data_schema.progress import Progress, silent

Facts = Mapping[str, object]
Rows = Sequence[Sequence[object]]


class Described:
    """What says of itself the same as text and as HTML; dataclasses of this kind are made with `repr=False`."""

    def _facts(self) -> tuple[str, Facts, Sequence[str], Rows]:
        """Title, facts, names of columns and rows."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return as_text(*self._facts())

    def _repr_html_(self) -> str:
        return as_html(*self._facts())


def as_text(title: str, facts: Facts, columns: Sequence[str] = (), rows: Rows = ()) -> str:
    """A title, a line a fact, and the rows below their columns, aligned."""
    width = max(map(len, facts), default=0)
    lines = [title, *(f"  {name:<{width}}  {value}" for name, value in facts.items())]
    if rows:
        cells = [list(columns), *([str(cell) for cell in row] for row in rows)]
        widths = [max(len(row[k]) for row in cells) for k in range(len(columns))]
        lines += ["  " + "  ".join(_aligned(row, widths)) for row in cells]
    return "\n".join(line.rstrip() for line in lines)


def as_html(title: str, facts: Facts, columns: Sequence[str] = (), rows: Rows = ()) -> str:
    """The same for a notebook; every text is escaped."""
    out = [f"<div><strong>{html.escape(title)}</strong>"]
    if facts:
        out.append("<table>" + "".join(_row("th", [name], "td", [value]) for name, value in facts.items()) + "</table>")
    if rows:
        head, body = _row("th", columns), "".join(_row("td", row) for row in rows)
        out.append(f"<table><thead>{head}</thead><tbody>{body}</tbody></table>")
    return "".join([*out, "</div>"])


def listed(names: Iterable[object], most: int = 6) -> str:
    """Names with commas; of many the first, and how many more there are."""
    known = [str(name) for name in names]
    return ", ".join(known[:most]) + (f" and {len(known) - most} more" if len(known) > most else "") or "none"


def _aligned(row: Sequence[str], widths: Sequence[int]) -> list[str]:
    return [f"{cell:<{width}}" if k == 0 else f"{cell:>{width}}" for k, (cell, width) in enumerate(zip(row, widths))]


def _row(kind: str, cells: Sequence[object], other: str = "", others: Sequence[object] = ()) -> str:
    pieces = [(kind, cell) for cell in cells] + [(other, cell) for cell in others]
    return "<tr>" + "".join(f"<{tag}>{html.escape(str(cell))}</{tag}>" for tag, cell in pieces) + "</tr>"


def watched(report: Progress | None, progress: bool | Literal["auto"] = "auto") -> Progress:
    """`report`, or a line below a notebook's cell where nobody listens and this is a notebook (or `progress` is True)."""
    if report is not None:
        return report
    if progress is False or (progress == "auto" and not in_notebook()):
        return silent
    return NotebookLine()


def in_notebook() -> bool:
    """Whether this runs in the kernel of a notebook, which shows what it is given as HTML."""
    shell = sys.modules.get("IPython")
    found = shell.get_ipython() if shell is not None else None
    return found is not None and hasattr(found, "kernel")


class NotebookLine:
    """One line below a cell that is written anew, and is empty once the cell is done: what is being done, how far it is, a note."""

    def __init__(self) -> None:
        self._shown: Any = None
        self._last = 0.0

    def __call__(self, what: str, done: int, total: int, note: str) -> None:
        now = time.monotonic()
        if self._shown is not None and now - self._last < 0.2 and done != total:
            return
        self._last = now
        from IPython.display import HTML, display

        line = HTML(progress_html(what, done, total, note))
        if self._shown is None:
            self._shown = display(line, display_id=True)
            self._leave_with_the_cell()
        else:
            self._shown.update(line)

    def _leave_with_the_cell(self) -> None:
        """Empty the line when the cell ends: what was told last is seldom the end."""
        if not in_notebook():
            return
        from IPython.display import HTML

        events = sys.modules["IPython"].get_ipython().events

        def leave(*_: object) -> None:
            events.unregister("post_run_cell", leave)
            self._shown.update(HTML(""))
            self._shown = None

        events.register("post_run_cell", leave)


def progress_html(what: str, done: int, total: int, note: str) -> str:
    """The line as HTML; every text is escaped."""
    bar = f'<progress value="{done}" max="{total}"></progress> {done}/{total}' if total else str(done or "")
    return f"<div>{html.escape(what)} {bar} {html.escape(note)}</div>"


def seeds_told(seeds: Sequence[int]) -> str:
    """The seeds of a model in words: seed 0, or the mean of 5 trainings with seeds 0 to 4."""
    return (
        f"seed {seeds[0]}"
        if len(seeds) == 1
        else f"seeds {seeds[0]} to {seeds[-1]}, the mean of {len(seeds)} trainings"
    )
