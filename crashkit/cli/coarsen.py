"""`crashkit coarsen`: give a dataset its mesh hierarchy, and say what each level costs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from crashkit.cli._console import print_json, progress, say, table

if TYPE_CHECKING:
    from crashkit.mesh.levels import Hierarchy
    from crashkit.mesh.store import MeshArrays


def coarsen(
    path: str | Path,
    nodes: Sequence[int] | None = None,
    ratios: Sequence[float] | None = None,
    *,
    selection: Literal["quadric", "vtk"] = "quadric",
    pair_distance: float | None = None,
    report: Callable[[int, int], None] | None = None,
) -> Hierarchy:
    """Build the mesh hierarchy of the dataset at `path` and write it into it, with the displacements of level 1.

    `nodes` are the exact node counts of level 1, 2, ..; or `ratios` by how much each level has fewer nodes than the
    finer one (default 8, 4, 4). `pair_distance`, m: see `crashkit.mesh.build_hierarchy`. `report(done, runs)` follows
    the pass over the runs. An older hierarchy is replaced once the new one is complete.

    Raises MeshError for counts that cannot be had, DataError, ReadError and OutputError for the files.
    """
    from crashkit.errors import MeshError
    from crashkit.mesh.hierarchy import build_hierarchy, ratios_to_counts
    from crashkit.mesh.store import open_mesh, write_hierarchy

    if nodes is not None and ratios is not None:
        raise MeshError("both node counts and ratios were given; give one of them")
    mesh = open_mesh(Path(path))
    try:
        hierarchy = build_hierarchy(
            mesh.position,
            mesh.face_nodes,
            nodes if ratios is None else ratios_to_counts(len(mesh.position), ratios),
            face_part=mesh.face_part,
            selection=selection,
            pair_distance=pair_distance,
        )
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error
    write_hierarchy(path, hierarchy, progress=report)
    return hierarchy


def command(
    path: Annotated[Path, typer.Argument(help="Dataset (.zarr or .nc) that gets the hierarchy.", show_default=False)],
    nodes: Annotated[str, typer.Option(help="Exact nodes of each level, finest first: 1165,292,73.")] = "",
    ratios: Annotated[
        str, typer.Option(help="Instead: how many times fewer nodes than one level finer.", show_default="8,4,4")
    ] = "",
    selection: Annotated[
        str, typer.Option(help="quadric (half-edge contraction) or vtk (vtkQuadricDecimation).")
    ] = "quadric",
    pair_distance: Annotated[
        float | None,
        typer.Option(help="Nodes closer than this, m, may join without an edge.", show_default="1 % of the size"),
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="Draw all levels side by side into this PNG.")] = None,
    vtp: Annotated[
        Path | None, typer.Option(help="Write each level as VTP, with the probe maps, into this folder.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Select the nodes of ever coarser meshes and store them in the dataset, with the maps between them."""
    from crashkit.mesh.store import open_mesh, summarize_hierarchy

    if selection not in ("quadric", "vtk"):
        raise typer.BadParameter(f"{selection!r}; expected quadric or vtk", param_hint="--selection")
    counts = [int(n) for n in _numbers(nodes, "--nodes", "1165,292,73", whole=True)]
    factors = _numbers(ratios, "--ratios", "8,4,4")
    if counts and factors:
        raise typer.BadParameter("give either --nodes or --ratios", param_hint="--ratios")
    say(f"{path}: selecting nodes, then one pass over the runs")
    with progress(quiet=json) as bar:
        task = bar.add_task("reading runs", total=None, note="")

        def report(done: int, runs: int) -> None:
            bar.update(task, completed=done, total=runs)

        hierarchy = coarsen(
            path,
            counts or None,
            factors or None,
            selection="vtk" if selection == "vtk" else "quadric",
            pair_distance=pair_distance,
            report=report,
        )
    levels = summarize_hierarchy(path)
    mesh = open_mesh(path)
    files = [] if vtp is None else _write_levels(vtp, hierarchy, mesh)
    drawn = picture is not None and _draw(picture, hierarchy, mesh, levels)
    if json:
        print_json(
            {
                "path": path,
                "settings": hierarchy.settings,
                "levels": levels,
                "vtp": files,
                "picture": picture if drawn else None,
            }
        )
        return
    table(
        f"Mesh hierarchy of {path}",
        ("level", "nodes", "faces", "edges", "distance mean / max (cm)", "lifting error mean / max (cm)"),
        (
            (
                row["level"],
                row["nodes"],
                row["faces"],
                row["edges"],
                f"{100 * row['distance_mean']:.3f} / {100 * row['distance_max']:.2f}",
                f"{100 * row['lifting_error_mean']:.3f} / {100 * row['lifting_error_max']:.2f}",
            )
            for row in levels
        ),
    )
    if files:
        say(f"levels as VTP: {vtp}")
    if drawn:
        say(f"picture: {picture}")


def _numbers(text: str, option: str, example: str, whole: bool = False) -> list[float]:
    """The numbers of a list such as "8,4,4"."""
    try:
        return [int(piece) if whole else float(piece) for piece in text.split(",")] if text else []
    except ValueError as error:
        kind = "whole numbers" if whole else "numbers"
        raise typer.BadParameter(
            f"{text!r}; expected {kind} with commas between them, such as {example}", param_hint=option
        ) from error


def _write_levels(folder: Path, hierarchy: Hierarchy, mesh: MeshArrays) -> list[Path]:
    from crashkit.mesh.export import write_levels

    return write_levels(
        folder,
        hierarchy,
        mesh.position,
        mesh.face_nodes,
        mesh.node_id,
        mesh.part_id[mesh.face_part],
        mesh.part_id,
    )


def _draw(picture: Path, hierarchy: Hierarchy, mesh: MeshArrays, levels: list[dict[str, Any]]) -> bool:
    """Draw the picture; where this machine cannot, say so and go on, since the hierarchy is what was asked for."""
    from evaluation.drawing.rendering import rendering_problem

    problem = rendering_problem()
    if problem is not None:
        say(f"{picture}: {problem}")
        return False
    draw_levels(picture, hierarchy, mesh.position, mesh.face_nodes, [row["lifting_error_mean"] for row in levels])
    return True


def draw_levels(
    picture: Path, hierarchy: Hierarchy, position: Any, face_nodes: Any, lifting_error: Sequence[float]
) -> None:
    """A PNG with the full mesh and every level side by side: above the kept nodes on the full mesh, below their mesh.

    position (n, 3), m, and face_nodes (m, 3 or 4) of level 0; lifting_error of each level, m.
    Raises OutputError if `picture` cannot be written.
    """
    import numpy as np
    from matplotlib.figure import Figure

    from crashkit.mesh.probe import without_sides
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
            f"level {level.index}: {level.n_nodes} nodes\nlifting error {100 * lifting_error[k]:.3f} cm", fontsize=10
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
