"""A picture of the mesh hierarchy: every level beside the full mesh."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from crashkit.mesh.levels import Hierarchy


def draw_levels(
    picture: Path, hierarchy: Hierarchy, position: Any, face_nodes: Any, lifting_error: Sequence[float]
) -> None:
    """A PNG with the full mesh and every level side by side: above the kept nodes on the full mesh, below their mesh.

    position (n, 3), m, and face_nodes (m, 3 or 4) of level 0; lifting_error of each level, m.

    Raises
    ------
    OutputError
        If `picture` cannot be written.
    """
    import numpy as np
    from matplotlib.figure import Figure

    from data_schema.edges import without_sides
    from evaluation.drawing.rendering import choose_view, render

    with _output(picture):
        picture.parent.mkdir(parents=True, exist_ok=True)
    view = choose_view([position], face_nodes)
    columns = len(hierarchy.levels) + 1
    width = 620
    size = 3.6
    figure = Figure(figsize=(size * columns, 2 * size * view.height / view.width + 0.9), layout="constrained", dpi=150)
    axes = figure.subplots(2, columns, squeeze=False)
    axes[0, 0].imshow(render(position, face_nodes, view, width=width))
    axes[0, 0].set_title(f"full mesh: {len(position)} nodes", fontsize=10)
    axes[1, 0].imshow(render(position, face_nodes, view, width=width, edges=True))
    for k, level in enumerate(hierarchy.levels):
        dots = float(np.clip(150 / np.sqrt(level.n_nodes), 2.5, 9))
        above = render(position, face_nodes, view, width=width, marked=level.kept, marker_size=dots, opacity=0.5)
        lines = without_sides(level.edges, level.faces)
        below = render(
            position[level.kept], level.faces, view, width=width, lines=lines, edges=True,
            marked=np.arange(level.n_nodes), marker_size=dots,
        )  # fmt: skip
        axes[0, k + 1].imshow(above)
        axes[1, k + 1].imshow(below)
        axes[0, k + 1].set_title(
            f"level {level.index}: {level.n_nodes} nodes\ninterpolation error {100 * lifting_error[k]:.3f} cm",
            fontsize=10,
        )
    for ax in axes.ravel():
        ax.set_axis_off()
    with _output(picture):
        figure.savefig(picture, format="png")


@contextmanager
def _output(picture: Path) -> Iterator[None]:
    from crashkit.errors import OutputError

    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{picture}: cannot be written ({error.strerror or error}); the hierarchy is stored, choose another place"
        ) from error
