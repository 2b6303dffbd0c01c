"""One self-contained HTML page: summary, figures, views, methods, tables. Shared by the report and the data card."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.drawing.style import Sheet, readable, span
from evaluation.figures.kind import Drawing, Kind, drawn, image, write
from evaluation.report.verdict import Statement

PHONE_WIDTH = 9.0  # cm
_UNITS = {"_m_per_s": "m/s", "_percent": "%", "_cm": "cm", "_ms": "ms"}  # endings of names of columns


@dataclass(frozen=True)
class ShownFigure:
    """A figure in the page; `wide` and `narrow` are data URIs, `files` what lies beside the page."""

    name: str
    title: str
    caption: str
    wide: str
    narrow: str
    files: tuple[str, ...] = ()
    share: float = 1.0  # of the width of the page


@dataclass(frozen=True)
class ShownView:
    """An interactive view: a whole HTML document of its own."""

    title: str
    caption: str
    html: str


@dataclass(frozen=True)
class TableColumn:
    name: str
    text: bool


@dataclass(frozen=True)
class Cell:
    value: str
    text: bool
    best: bool


@dataclass(frozen=True)
class ShownTable:
    title: str
    columns: tuple[TableColumn, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""


@dataclass(frozen=True)
class Page:
    """The content of a page, in its order; texts are plain and escaped by the template."""

    title: str
    subtitle: str
    statements: Sequence[Statement] = ()
    rules: str = ""
    key_table: ShownTable | None = None
    figures: Sequence[ShownFigure] = ()
    views: Sequence[ShownView] = ()
    text: Sequence[str] = ()
    methods: Sequence[tuple[str, str]] = ()
    details: Sequence[tuple[str, str]] = ()
    tables: Sequence[ShownTable] = field(default_factory=tuple)


def render_page(page: Page) -> str:
    """The page as HTML; everything it needs is inside it, and whatever is shown is escaped."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    from crashkit.version import __version__

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html").render(page=page, version=__version__)


def show_figure(kind: Kind, drawing: Drawing, folder: Path, sheet: Sheet, base: Path) -> ShownFigure:
    """Write a drawing into `folder` and show it: as written on a page, drawn once more for a phone.

    `base` is the folder of the page, from which the files are linked. Pictures of meshes are shown as PNG.
    """
    paths, width = write(drawing, kind.name, folder, sheet)
    form = "png" if kind.raster else "svg"
    narrow = image(drawn(drawing, Sheet(PHONE_WIDTH, sheet.styles)), form, dpi=160)
    return ShownFigure(
        kind.name,
        kind.title,
        drawing.caption(),
        data_uri(paths[0 if kind.raster else 1].read_bytes(), form),
        data_uri(narrow, form),
        tuple(path.relative_to(base).as_posix() for path in paths),
        min(1.0, width / sheet.width),
    )


def data_uri(content: bytes, form: str) -> str:
    """`content` of a PNG or SVG as a data URI."""
    kind = {"svg": "image/svg+xml", "png": "image/png"}[form]
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def show_table(
    title: str,
    columns: Mapping[str, Sequence[Any]],
    note: str = "",
    headings: Mapping[str, str] | None = None,
    lowest: Sequence[str] = (),
) -> ShownTable:
    """Columns as a table of the page.

    Parameters
    ----------
    headings
        Column -> what stands above it; only these columns are shown, in this order (default: all, in the units that
        people read).
    lowest
        Columns in which the smallest number is marked as the best.
    """
    if headings is None:
        columns = dict(_readable_column(name, values) for name, values in columns.items())
        headings = {name: name for name in columns}
    shown = {name: columns[name] for name in headings}
    textual = {name: all(isinstance(v, str) for v in values) for name, values in shown.items()}
    best = {name: min((v for v in shown[name] if v == v), default=None) for name in lowest if name in shown}
    count = len(next(iter(shown.values()), ()))
    rows = tuple(
        tuple(
            Cell(plain(values[k]), textual[name], name in best and values[k] == best[name] and count > 1)
            for name, values in shown.items()
        )
        for k in range(count)
    )
    return ShownTable(title, tuple(TableColumn(headings[n], textual[n]) for n in shown), rows, note)


def _readable_column(name: str, values: Sequence[Any]) -> tuple[str, Sequence[Any]]:
    """A column of a CSV file as people read it: `yield_stress (Pa)` in MPa, `peak_cm` under `peak (cm)`."""
    for ending, unit in _UNITS.items():
        if name.endswith(ending):
            return span(name.removesuffix(ending), unit), values
    start, found, unit = name.removesuffix(")").rpartition(" (")
    if not found or not all(isinstance(v, float) for v in values):
        return name.replace("_", " "), values
    numbers, unit = readable(np.array(values), unit)
    return span(start, unit), numbers.tolist()


def plain(value: Any) -> str:
    """A number as people read it: three significant digits, a dash where there is none."""
    if value is None or value != value:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return _grouped(value, 10000)
    if isinstance(value, float):
        if value != 0 and abs(value) < 1e-4:
            return f"{value:.2g}"
        if abs(value) < 0.01:
            return f"{value:.4f}".rstrip("0").rstrip(".") or "0"
        return f"{value:#.3g}".rstrip(".") if abs(value) < 999.5 else _grouped(round(value), 10000)
    return str(value)


def _grouped(value: int, least: int) -> str:
    """Digits in threes, apart by a thin space, from `least` on."""
    return f"{value:,}".replace(",", "\u2009") if abs(value) >= least else str(value)


def plain_json(value: Any) -> Any:
    """`value` for JSON, which knows no NaN and no arrays."""
    if isinstance(value, Mapping):
        return {str(k): plain_json(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, set)):
        return [plain_json(v) for v in value]
    if hasattr(value, "tolist"):
        return plain_json(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, (str, int, float, bool)):
        return value
    return str(value)
