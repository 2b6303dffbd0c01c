"""Pictures of the mesh with text: truth, prediction and error; contributions of levels; kept nodes.

Arrays in metres and seconds in, a matplotlib Figure out; lengths are shown in centimetres. The images themselves
come from `evaluation.drawing.rendering`, so nothing here needs a display.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evaluation.drawing.rendering import Image, choose_view, render
from evaluation.drawing.style import CM, INK, MS, Sheet, look
from evaluation.errors import EvaluationError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DISPLACEMENT = "viridis"
ERROR = "inferno_r"  # small is light, large is dark, on paper too
PIXELS_PER_CM = 80

Limits = tuple[float, float]


@dataclass(frozen=True)
class Panel:
    """One image and its title."""

    image: Image
    title: str = ""


@dataclass(frozen=True)
class Scale:
    """A colour bar: what is shown, with its unit, between `limits` in `colours`."""

    label: str
    limits: Limits
    colours: str


@dataclass(frozen=True)
class Row:
    """One row of pictures over time: a mesh that moves by `displacement` (t, n, 3), m, coloured by `values` (t, n).

    `label` names the row, `scale` what its colours mean; without limits of its own they are those of `values`.
    """

    label: str
    displacement: NDArray[np.floating]
    values: NDArray[np.floating]
    quantity: str = "displacement (cm)"
    colours: str = DISPLACEMENT


@dataclass(frozen=True)
class KeptNodes:
    """The nodes of one level on the full mesh: `kept` node numbers, `faces` (m, 3) and `edges` (e, 2) between them.

    `faces` and `edges` are in the level's own numbering, as in `data_schema.levels.Level`.
    """

    label: str
    kept: NDArray[np.integer]
    faces: NDArray[np.integer]
    edges: NDArray[np.integer]


def field_picture(
    points: ArrayLike,
    faces: ArrayLike,
    displacement: ArrayLike,
    values: ArrayLike,
    label: str,
    sheet: Sheet | None = None,
    colours: str = DISPLACEMENT,
) -> Figure:
    """A field on the deformed mesh.

    Parameters
    ----------
    points
        (n, 3) m; displacement (n, 3) m.
    values
        (n,) or (m,) in the unit that `label` names; shown between 0, or the smallest, and the largest.
    """
    sheet = sheet or Sheet()
    position = np.asarray(points) + np.asarray(displacement)
    scale = Scale(label, limits_of(values), colours)
    view = choose_view([position], faces)
    image = render(position, faces, view, values, scale.limits, colours, _pixels(sheet, 1))
    return _sheet_of([[Panel(image)]], [scale], sheet)


def comparison_picture(
    points: ArrayLike,
    faces: ArrayLike,
    truth: ArrayLike,
    prediction: ArrayLike,
    name: str = "prediction",
    sheet: Sheet | None = None,
    alive: ArrayLike | None = None,
    error_limits: Limits | None = None,
    titles: tuple[str, str, str] | None = None,
) -> Figure:
    """Truth, prediction and error of one state, in one view; the first two in one scale.

    points (n, 3) m; truth and prediction (n, 3) displacements, m; alive (m,) bool. The error is the distance
    between predicted and true position of each node, shown on the true mesh. Behind the prediction stands the
    truth as a grey shadow. With `titles` they may be any two states and their distance.
    """
    sheet = sheet or Sheet()
    shown = titles or ("truth", name, f"error of {name}" if name != "prediction" else "error")
    x, u, p = (np.asarray(a, np.float64) for a in (points, truth, prediction))
    if not x.shape == u.shape == p.shape:
        raise EvaluationError(
            f"points {x.shape}, truth {u.shape} and prediction {p.shape}: expected (n, 3) on the same nodes"
        )
    sizes = [CM * np.linalg.norm(a, axis=-1) for a in (u, p)]
    error = CM * np.linalg.norm(p - u, axis=-1)
    view = choose_view([x + u, x + p], faces)
    moved = Scale("displacement (cm)", limits_of(np.concatenate(sizes)), DISPLACEMENT)
    wrong = Scale("error (cm)" if titles is None else "distance (cm)", error_limits or limits_of(error), ERROR)
    width = _pixels(sheet, 1 if sheet.narrow else 3)
    panels = [
        Panel(render(x + a, faces, view, values, s.limits, s.colours, width, alive=alive, ghost=ghost), title)
        for a, values, s, title, ghost in (
            (u, sizes[0], moved, shown[0], None),
            (p, sizes[1], moved, shown[1], x + u),
            (u, error, wrong, shown[2], None),
        )
    ]
    rows = [[panel] for panel in panels] if sheet.narrow else [panels]
    return _sheet_of(rows, [moved, wrong], sheet, below=True)


def file_picture(
    path: str | os.PathLike[str],
    state: int = -1,
    name: str = "prediction",
    sheet: Sheet | None = None,
    truth: str = "displacement",
    prediction: str = "predicted",
) -> Figure:
    """The comparison of one state of a ParaView file (`.pvd` or `.vtkhdf`), read back through VTK.

    Parameters
    ----------
    truth, prediction
        Names of the point arrays (n, 3), m, in the file; its points are undeformed.
    """
    from crashkit.writers.paraview import read_state

    _, mesh = read_state(path, state)
    missing = [array for array in (truth, prediction) if array not in mesh.point_data]
    if missing:
        found = ", ".join(mesh.point_data.keys()) or "none"
        raise EvaluationError(f"{path}: no point array {missing[0]!r}; expected it among those there: {found}")
    by_type = mesh.cells_dict
    alive = mesh.cell_data.get("alive", np.ones(mesh.n_cells)).astype(bool)
    faces = np.full((mesh.n_cells, 4), -1)
    for kind, corners in by_type.items():
        if corners.shape[1] in (3, 4):
            faces[mesh.celltypes == kind, : corners.shape[1]] = corners
    surface = faces[:, 2] >= 0
    return comparison_picture(
        mesh.points, faces[surface], mesh[truth], mesh[prediction], name, sheet, alive=alive[surface]
    )


def states_picture(
    points: ArrayLike,
    faces: ArrayLike,
    time: ArrayLike,
    rows: Sequence[Row],
    shares: Sequence[float] = (1 / 3, 2 / 3, 1.0),
    sheet: Sheet | None = None,
    alive: ArrayLike | None = None,
) -> Figure:
    """Rows of pictures at `shares` of the last time, such as the contribution of each level at t/3, 2t/3 and t.

    points (n, 3) m; time (t,) s; alive (t, m) bool. All pictures have one view, every row its own scale.
    """
    sheet = sheet or Sheet()
    x, times = np.asarray(points, np.float64), np.asarray(time, np.float64)
    for row in rows:
        if row.displacement.shape != (len(times), *x.shape) or row.values.shape[:1] != times.shape:
            raise EvaluationError(
                f"row {row.label!r} has displacements {row.displacement.shape} and values {row.values.shape}: "
                f"expected {len(times)} states of {len(x)} nodes"
            )
    chosen = states_at(times, shares)
    view = choose_view([x + row.displacement[chosen] for row in rows], faces)
    scales, grid = [], []
    for row in rows:
        scale = Scale(row.quantity, limits_of(row.values[chosen]), row.colours)
        scales.append(scale)
        grid.append(
            [
                Panel(
                    render(
                        x + row.displacement[k], faces, view, row.values[k], scale.limits, scale.colours,
                        _pixels(sheet, len(chosen)), alive=None if alive is None else np.asarray(alive)[k],
                    ),
                    f"{row.label}\n{MS * times[k]:.1f} ms" if j == 0 else f"\n{MS * times[k]:.1f} ms",
                )
                for j, k in enumerate(chosen)
            ]
        )  # fmt: skip
    return _sheet_of(grid, scales, sheet)


def kept_nodes_picture(
    points: ArrayLike, faces: ArrayLike, levels: Sequence[KeptNodes], sheet: Sheet | None = None
) -> Figure:
    """The kept nodes of every level on the full mesh, and the coarse mesh between them.

    points (n, 3) m and faces (m, 3 or 4) of the full mesh.
    """
    sheet = sheet or Sheet()
    x = np.asarray(points, np.float64)
    view = choose_view([x], faces)
    across = 1 if sheet.narrow else 2
    width = _pixels(sheet, across)
    rows = []
    for level in levels:
        size = float(np.clip(220 / np.sqrt(len(level.kept)), 4, 12)) * width / 700
        full = render(x, faces, view, width=width, marked=level.kept, marker_size=size, opacity=0.55)
        coarse = render(x[level.kept], level.faces, view, width=width, lines=level.edges)
        panels = [Panel(full, f"{level.label}: {len(level.kept)} of {len(x)} nodes kept"), Panel(coarse, "its mesh")]
        rows += [[panel] for panel in panels] if sheet.narrow else [panels]
    return _sheet_of(rows, [], sheet)


def limits_of(values: ArrayLike) -> Limits:
    """Limits of a colour bar: from 0, or the smallest value below it, to the largest; NaN does not count."""
    array = np.asarray(values, np.float64)
    array = array[np.isfinite(array)]
    return (min(0.0, float(array.min())), float(array.max())) if array.size else (0.0, 1.0)


def states_at(time: ArrayLike, shares: Sequence[float]) -> list[int]:
    """The states nearest to `shares` of the way from the first to the last time (t,)."""
    times = np.asarray(time, np.float64)
    return [int(np.argmin(abs(times - times[0] - share * (times[-1] - times[0])))) for share in shares]


def _pixels(sheet: Sheet, across: int) -> int:
    return round(sheet.width * PIXELS_PER_CM / across)


def _sheet_of(rows: Sequence[Sequence[Panel]], scales: Sequence[Scale], sheet: Sheet, below: bool = False) -> Figure:
    """Panels in rows. Colour bars stand right of their row, one a row, or all in one line `below`."""
    from matplotlib.figure import Figure

    across = len(rows[0])
    beside = bool(scales) and not below
    bar = 2.3 if beside else 0.0  # cm
    image_width = (sheet.width - bar) / across
    heights = [0.75 + 0.35 * rows[k][0].title.count("\n") + image_width * _ratio(rows[k]) for k in range(len(rows))]
    foot = 1.6 if scales and below else 0.0
    total = sum(heights) + foot + 0.15
    with look():
        figure = Figure(figsize=(sheet.width / 2.54, total / 2.54))
        top = total
        for k, row in enumerate(rows):
            image_height = image_width * _ratio(row)
            for j, panel in enumerate(row):
                box = (j * image_width, top - heights[k], image_width, image_height)
                axes = figure.add_axes(_share(box, sheet.width, total))
                axes.imshow(panel.image, interpolation="antialiased", aspect="auto")
                axes.set_axis_off()
                at = ((j * image_width + 0.15) / sheet.width, (top - 0.12) / total)
                figure.text(*at, panel.title, va="top", ha="left", weight="bold", size=9, color=INK, linespacing=1.35)
            if beside:
                box = (sheet.width - bar + 0.1, top - heights[k] + 0.05 * image_height, 0.28, 0.7 * image_height)
                ticks = 5 if box[3] > 1.6 else 3
                _bar(
                    figure.add_axes(_share(box, sheet.width, total)), scales[min(k, len(scales) - 1)], "vertical", ticks
                )
            top -= heights[k]
        if below:
            each = sheet.width / len(scales)
            for k, scale in enumerate(scales):
                box = (k * each + 0.08 * each, foot - 0.5, 0.84 * each, 0.28)
                _bar(figure.add_axes(_share(box, sheet.width, total)), scale, "horizontal")
    return figure


def _ratio(row: Sequence[Panel]) -> float:
    height, width = row[0].image.shape[:2]
    return float(height / width)


def _share(box: tuple[float, float, float, float], width: float, height: float) -> tuple[float, float, float, float]:
    left, bottom, across, up = box
    return left / width, bottom / height, across / width, up / height


def _bar(axes: Axes, scale: Scale, orientation: str, ticks: int = 5) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.ticker import MaxNLocator

    low, high = scale.limits
    mappable = ScalarMappable(Normalize(low, high if high > low else low + 1e-12), scale.colours)
    bar = axes.figure.colorbar(mappable, cax=axes, orientation=orientation)
    bar.outline.set_visible(False)
    bar.locator = MaxNLocator(ticks)
    bar.update_ticks()
    if orientation == "vertical":  # written across, above the bar: along it, it may be longer than the bar
        axes.set_title(scale.label.replace(" (", "\n("), weight="normal", size=8, color=INK)
    else:
        bar.set_label(scale.label)
    axes.tick_params(length=2)
    axes.grid(False)
