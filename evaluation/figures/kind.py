"""What a figure is: arrays that can be drawn, written as numbers and described."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from evaluation.drawing.style import Sheet, look
from evaluation.errors import EvaluationError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evaluation.comparison.result import Evaluation

Columns = Mapping[str, Sequence[Any]]


class Drawing(Protocol):
    """The plain arrays behind one figure."""

    def numbers(self) -> Columns:
        """Every number of the figure: column with unit -> values, columns of equal length."""

    def draw(self, sheet: Sheet) -> Figure:
        """The figure on `sheet`."""

    def caption(self) -> str:
        """What to see in it, from its own numbers."""


@dataclass(frozen=True)
class Kind:
    """A registered figure: file name, title, and how its arrays are taken from an evaluation (None: not shown).

    `raster`: made of pictures of meshes, so that the page shows it as PNG.
    """

    name: str
    title: str
    select: Callable[[Evaluation], Drawing | None]
    raster: bool = False


def drawn(drawing: Drawing, sheet: Sheet) -> Figure:
    """The figure in the common look, laid out once for all the files it is written to."""
    with look():
        figure = drawing.draw(sheet)
        engine = figure.get_layout_engine()
        if engine is not None:
            engine.execute(figure)
            figure.set_layout_engine("none")
    return figure


def to_csv(columns: Columns) -> str:
    """Columns as CSV text, missing values empty, numbers with seven digits."""
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        raise EvaluationError(f"columns of different length: {lengths}; expected one length for all")
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(map(_cell, columns))
    writer.writerows([_cell(v) for v in row] for row in zip(*columns.values(), strict=True))
    return out.getvalue()


# Spreadsheets compute texts that begin so; names of runs come from strangers.
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def _cell(value: Any) -> str:
    if value is None or value != value:
        return ""
    if isinstance(value, float) or getattr(getattr(value, "dtype", None), "kind", "") == "f":
        return f"{float(value):.7g}"
    text = str(value)
    return f"'{text}" if isinstance(value, str) and text.startswith(_FORMULA) else text


def image(figure: Figure, form: str, dpi: int = 200) -> bytes:
    """The figure as bytes of a PNG or SVG file; the same figure gives the same bytes."""
    out = io.BytesIO()
    with look():
        metadata = {"Date": None} if form == "svg" else {"Software": None}
        figure.savefig(out, format=form, dpi=dpi, metadata=metadata)
    return out.getvalue()


def write(drawing: Drawing, name: str, folder: Path, sheet: Sheet) -> tuple[list[Path], float]:
    """Write `name`.png, .svg and .csv into `folder`; returns the paths in this order, and the width drawn, cm."""
    folder.mkdir(parents=True, exist_ok=True)
    figure = drawn(drawing, sheet)
    paths = [folder / f"{name}.{suffix}" for suffix in ("png", "svg", "csv")]
    paths[0].write_bytes(image(figure, "png"))
    paths[1].write_bytes(image(figure, "svg"))
    paths[2].write_text(to_csv(drawing.numbers()), encoding="utf-8")
    return paths, float(figure.get_figwidth()) * 2.54
