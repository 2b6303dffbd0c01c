"""`crashkit scatter`: what scatter of the parameters does to fields and numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crashkit.cli._console import print_json, say, share, table, what_next
from crashkit.cli._progress import Progress


def command(
    model: Annotated[Path, typer.Argument(help="Model folder.", show_default=False)],
    vary: Annotated[
        str,
        typer.Option(
            help="What scatters, and how far: yield_stress=5%,impact_angle=2deg (standard deviation); thickness=5%:uniform.",
            show_default=False,
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for page, figures and ParaView files.")] = Path(
        "scatter"
    ),
    draws: Annotated[int, typer.Option("--draws", "-n", help="Number of draws.", min=2)] = 10_000,
    param: Annotated[
        list[str] | None,
        typer.Option(
            "--param", "-p", help="Nominal value: impact_speed=20.", show_default="middle of the trained range"
        ),
    ] = None,
    number: Annotated[
        list[str] | None,
        typer.Option(help="A number by formula: intrusion=max(displacement(part=box,along=x)). Repeat for more."),
    ] = None,
    limit: Annotated[
        list[str] | None,
        typer.Option(help="A limit: 'intrusion < 80 mm', or of every node 'displacement() < 0.3 m'. Repeat for more."),
    ] = None,
    distribution: Annotated[str, typer.Option(help="normal or uniform.")] = "normal",
    plan: Annotated[str, typer.Option(help="How draws are spread: latin (hypercube) or sobol.")] = "latin",
    level: Annotated[int | None, typer.Option(help="Predict from this mesh level.", show_default="the finest")] = None,
    confidence: Annotated[
        float, typer.Option(help="Of the intervals of probabilities: a share or 90%.", parser=share, metavar="SHARE")
    ] = 0.9,
    seed: Annotated[int, typer.Option(help="The same seed gives the same draws.", min=0)] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier result.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """How fields and numbers scatter with the parameters: probabilities, influences, and where runs begin to differ."""
    import itertools
    import json as as_text

    from crashkit.api.scatter import scatter
    from crashkit.cli.predict import given

    for what, found, allowed in (
        ("distribution", distribution, ("normal", "uniform")),
        ("plan", plan, ("latin", "sobol")),
    ):
        if found not in allowed:
            raise typer.BadParameter(f"{found!r}; expected {' or '.join(allowed)}", param_hint=f"--{what}")
    if "(" in vary or ".." in vary:
        raise typer.BadParameter(
            f"{vary!r}; expected name=width around the nominal value (-p), such as yield_stress=5% or thickness=0.1mm:uniform",
            param_hint="--vary",
        )
    pieces = [piece for piece in vary.split(",") if piece.strip()]
    asked = given(pieces, "--vary", "yield_stress=5%")
    numbers = {
        name.strip(): text.strip() for name, text in given(number or (), "--number", "peak=max(displacement())").items()
    }
    with Progress(f"reading {model}", quiet=json) as shown:
        result = scatter(
            model, asked, output, at=given(param or ()), draws=draws, numbers=numbers, limits=limit or (),
            shape=distribution, plan=plan, level=level, confidence=confidence, seed=seed, overwrite=overwrite,  # type: ignore[arg-type]
            report=shown.step,
        )  # fmt: skip
    if json:
        print_json({"output": output, **as_text.loads((output / "scatter.json").read_text(encoding="utf-8"))})
        return
    from evaluation.report.page import plain
    from evaluation.scatter.page import limit_table, number_table, part_table

    say(f"nominal: {result.about['Nominal']}")
    chances = limit_table(result)
    for columns, title in (
        (
            {name: c for name, c in number_table(result).items() if name != "formula"},
            f"{len(result.draws)} draws of {', '.join(s.name for s in result.scatter)}",
        ),
        (
            {name: chances[name] for name in ("limit", "broken", "from", "to", "outside")},
            f"Limits, in per cent; intervals of {100 * confidence:.0f} %",
        ),
        (part_table(result), "Where runs begin to differ"),
    ):
        rows = list(itertools.zip_longest(*columns.values()))
        if rows:
            table(title, [_heading(name) for name in columns], ([plain(cell) for cell in row] for row in rows))
    names = [s.name for s in result.scatter]
    for one, total in zip(result.numbers, result.indices.total, strict=True):
        shares = ", ".join(f"{100 * v:.0f} % {n}" for v, n in sorted(zip(total, names, strict=True), reverse=True))
        say(f"{one.name}: variance by {shares} (total Sobol indices)")
    if result.folding.count > 1:
        say(f"folding modes: {result.folding.count} groups of shapes")
    if result.limits:
        say(f"the model's own error in the intervals: {result.doubt or 'none, it has no band'}")
    for sentence in result.warnings:
        say(f"warning: {sentence}")
    what_next(output / "scatter.html")


def _heading(name: str) -> str:
    for ending, unit in (("_ms", "ms"), ("_cm", "cm"), ("_percent", "%")):
        if name.endswith(ending):
            return f"{name.removesuffix(ending)} ({unit})"
    return name
