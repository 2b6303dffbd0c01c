"""`crashkit invert`: which parameters explain measured positions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from crashkit.cli._console import print_json, say, table, what_next
from crashkit.cli._progress import Progress


def command(
    model: Annotated[Path, typer.Argument(help="Model folder.", show_default=False)],
    measured: Annotated[
        Path,
        typer.Option(
            help="Table of points: node, or undeformed x, y, z; ux, uy, uz (displacement) or px, py, pz (position); time. "
            "Units in brackets: ux [mm].",
            show_default=False,
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")] = Path("inverted"),
    noise: Annotated[str, typer.Option(help="Standard deviation of a measured component.")] = "1mm",
    known: Annotated[
        list[str] | None,
        typer.Option(help="A parameter that is known: impact_speed=56km/h; repeat for more.", show_default="none"),
    ] = None,
    level: Annotated[int | None, typer.Option(help="Mesh level that predicts.", show_default="the finest one")] = None,
    seed: Annotated[int, typer.Option(help="The same seed gives the same samples.", min=0)] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier result.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Find the parameters that explain measured positions: crashkit invert gpr/ --measured points.csv"""
    from crashkit.api.invert import invert
    from crashkit.cli.predict import given
    from crashkit.output import refuse_earlier

    if not overwrite:
        refuse_earlier(output, "explanations.csv", "result")
    values = given(known or (), "--known")
    with Progress(f"reading {model}", quiet=json) as shown:
        found = invert(model, measured, noise=noise, known=values, level=level, seed=seed, report=shown.step)
        found.save(output)
    told = found.table()
    if json:
        print_json(
            {
                "output": output, "parameters": told.reset_index().to_dict("records"),
                "explanations": found.explanations().to_dict("records"), "warnings": found.warnings, "notes": found.notes,
            }
        )  # fmt: skip
        return
    for sentence in found.notes:
        say(f"note: {sentence}")
    for sentence in found.warnings:
        say(f"warning: {sentence}")
    table(
        f"{measured}: {len(found.residual)} numbers",
        ("parameter", "most likely", "90 % interval", "trained range"),
        (
            (f"{name} ({r['unit']})" if r["unit"] else name, f"{r['best']:.4g}", *_spans(r.to_dict()))
            for name, r in told.iterrows()
        ),
    )  # fmt: skip
    what_next(
        output / "pairs.png",
        ("predict", model, "--params", output / "explanations.csv", "-o", output / "explained"),
    )


def _spans(row: Mapping[Any, Any]) -> tuple[str, str]:
    if row["range_low"] == row["range_high"]:
        return "known", "-"
    return f"{row['low']:.4g} to {row['high']:.4g}", f"{row['range_low']:.4g} to {row['range_high']:.4g}"
