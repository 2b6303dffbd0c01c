"""`crashkit coarsen`: give a dataset its mesh hierarchy, and say what each level costs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from crashkit.cli._console import fail, print_json, progress, say, table

if TYPE_CHECKING:
    from crashkit.mesh.levels import Hierarchy


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
    the pass over the runs.

    Raises MeshError for counts that cannot be had, DataError, ReadError and OutputError for the files.
    """
    from crashkit.errors import MeshError
    from crashkit.mesh.hierarchy import build_hierarchy, ratios_to_counts
    from crashkit.mesh.store import open_mesh, write_hierarchy

    if nodes is not None and ratios is not None:
        raise MeshError("both node counts and ratios were given; give one of them")
    mesh = open_mesh(Path(path))
    counts = nodes if ratios is None else ratios_to_counts(len(mesh.position), ratios)
    hierarchy = build_hierarchy(
        mesh.position,
        mesh.face_nodes,
        counts,
        face_part=mesh.face_part,
        selection=selection,
        pair_distance=pair_distance,
    )
    write_hierarchy(path, hierarchy, progress=report)
    return hierarchy


def command(
    path: Annotated[Path, typer.Argument(help="Dataset (.zarr or .nc) that gets the hierarchy.", show_default=False)],
    nodes: Annotated[str, typer.Option(help="Exact nodes of each level, finest first: 1165,292,73.")] = "",
    ratios: Annotated[str, typer.Option(help="Instead: how many times fewer nodes than one level finer: 8,4,4.")] = "",
    selection: Annotated[str, typer.Option(help="quadric or vtk.")] = "quadric",
    pair_distance: Annotated[
        float | None,
        typer.Option(
            help="Metres below which nodes without a common edge may contract.", show_default="1 % of the size"
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Select the nodes of three (or more) coarser levels and store them in the dataset."""
    from crashkit.mesh.store import summarize_hierarchy

    if selection not in ("quadric", "vtk"):
        fail(f"selection {selection!r} is not known; expected quadric or vtk", code=2)
    counts = [int(c) for c in _numbers(nodes, "--nodes", "1165,292,73", whole=True)] or None
    factors = _numbers(ratios, "--ratios", "8,4,4") or None
    say(f"{path}: selecting nodes")
    with progress() as bar:
        task = bar.add_task("reading runs", total=None, note="")

        def report(done: int, runs: int) -> None:
            bar.update(task, completed=done, total=runs)

        coarsen(path, counts, factors, selection=selection, pair_distance=pair_distance, report=report)  # type: ignore[arg-type]
    rows = summarize_hierarchy(path)
    if as_json:
        print_json({"path": path, "levels": rows})
        return
    table(
        f"Mesh hierarchy of {path}",
        ("level", "nodes", "faces", "edges", "distance mean (cm)", "max (cm)", "lifting error mean (cm)", "max (cm)"),
        (
            (
                row["level"], row["nodes"], row["faces"], row["edges"],
                *(f"{100 * row[name]:.3f}" for name in (
                    "distance_mean", "distance_max", "lifting_error_mean", "lifting_error_max",
                )),
            )
            for row in rows
        ),
    )  # fmt: skip


def _numbers(text: str, option: str, example: str, whole: bool = False) -> list[float]:
    """The numbers of a list such as "8,4,4"; leaves with code 2 where it is none."""
    try:
        return [int(piece) if whole else float(piece) for piece in text.split(",")] if text else []
    except ValueError:
        kind = "whole numbers" if whole else "numbers"
        fail(f"{option} {text!r} not understood; expected {kind} with commas between them, such as {example}", code=2)
