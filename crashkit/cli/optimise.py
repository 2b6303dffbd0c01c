"""`crashkit optimise`: the best parameters within limits."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crashkit.cli._console import print_json, say, share, table, what_next
from crashkit.cli._progress import Progress

if TYPE_CHECKING:
    import pandas as pd


def command(
    model: Annotated[Path, typer.Argument(help="Model folder.", show_default=False)],
    minimise: Annotated[
        str, typer.Option(help="Formula, or name of a --number, to be made small.", show_default=False)
    ] = "",
    maximise: Annotated[str, typer.Option(help="The same, to be made large.", show_default=False)] = "",
    subject_to: Annotated[
        list[str] | None, typer.Option(help="A limit: 'intrusion < 80 mm'. Repeat for more.", show_default="none")
    ] = None,
    number: Annotated[
        list[str] | None,
        typer.Option(help="A number by formula: 'intrusion=max(displacement(part=box,along=x))'. Repeat for more."),
    ] = None,
    known: Annotated[
        list[str] | None,
        typer.Option(help="A parameter that is given: impact_speed=56km/h. Repeat for more.", show_default="none"),
    ] = None,
    confidence: Annotated[
        float,
        typer.Option(
            help="Share of cases in which each limit is to be kept, 0.9 or 90%; 0.5: as predicted.",
            parser=share,
            metavar="SHARE",
        ),
    ] = 0.9,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")] = Path("optimum"),
    level: Annotated[int | None, typer.Option(help="Predict from this mesh level.", show_default="the finest")] = None,
    starts: Annotated[int, typer.Option(help="Searches from different places.", min=1)] = 6,
    seed: Annotated[int, typer.Option(help="The same seed gives the same answer.", min=0)] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier result.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Find the best parameters within limits: crashkit optimise gpr/ --minimise thickness --subject-to "peak < 80 mm" """
    from crashkit.api.optimise import optimise
    from crashkit.cli.predict import given
    from crashkit.output import refuse_earlier

    if bool(minimise) == bool(maximise):
        raise typer.BadParameter("give one of them: --minimise mass", param_hint="--minimise|--maximise")
    if not overwrite:
        refuse_earlier(output, "confirm.csv", "result")
    numbers = {n.strip(): t.strip() for n, t in given(number or (), "--number", "peak=max(displacement())").items()}
    with Progress(f"reading {model}", quiet=json) as shown:
        found = optimise(
            model, minimise or None, maximise=maximise or None, subject_to=subject_to or (), numbers=numbers,
            known=given(known or (), "--known"), confidence=confidence, level=level, starts=starts, seed=seed,
            report=shown.step,
        )  # fmt: skip
        found.save(output)
    if json:
        print_json(
            {
                "output": output, "feasible": found.feasible, "parameters": found.parameters, "objective": found.objective,
                "value": found.value, "unit": found.unit, "limits": found.limits.to_dict("records"),
                "table": found.table.to_dict("records"),
                "sensitivities": found.sensitivities.to_dict("records"), "confirm": found.confirm.to_dict("records"),
                "notes": found.notes,
            }
        )  # fmt: skip
        return
    for sentence in found.notes:
        say(f"note: {sentence}")
    limits = _as_written(found.limits)
    if not found.feasible:
        short = limits[limits["slack"] < 0]
        told = "; ".join(f"{r['limit']}: short by {-r['slack']:.4g} {r['unit']}".rstrip() for _, r in short.iterrows())
        say(f"warning: nothing in the trained range keeps all limits; these parameters break them least ({told})")
    unit = "" if found.unit == "1" else f" {found.unit}"
    table(
        f"{found.objective}: {found.value:.5g}{unit}",
        ("parameter", "value", "trained range", "at"),
        (
            (
                f"{r['parameter']} ({r['unit']})" if r["unit"] else r["parameter"], f"{r['value']:.5g}",
                f"{r['range_low']:.4g} to {r['range_high']:.4g}", r["at"],
            )
            for _, r in found.table.iterrows()
        ),
    )  # fmt: skip
    if len(limits):
        table(
            f"Limits, tightened so that each is kept in {100 * confidence:g} % of cases",
            ("limit", "predicted", "margin", "left", "active", "kept (%)", "price"),
            (
                (
                    r["limit"], *(f"{r[name]:{digits}} {r['unit']}".removesuffix(" 1").rstrip() for name, digits in _LENGTHS),
                    "yes" if r["active"] else "", f"{100 * r['probability']:.0f}", _price(r["price"], found.unit, r["unit"]),
                )
                for _, r in limits.iterrows()
            ),
        )  # fmt: skip
    what_next(
        output / "confirm.csv", ("predict", model, "--params", output / "confirm.csv", "-o", output / "predicted")
    )


def _as_written(limits: pd.DataFrame) -> pd.DataFrame:
    """The limits in the units in which they were written: 80 mm beside 72 mm."""
    out = limits.copy()
    for k, (unit, factor) in enumerate(limits.attrs["written"]):
        if unit:
            out.loc[k, ["predicted", "margin", "bound", "slack"]] /= factor
            out.loc[k, "price"] *= factor
            out.loc[k, "unit"] = unit
    return out


# Columns in the unit of the limit, and their digits.
_LENGTHS = (("predicted", ".4g"), ("margin", ".2g"), ("slack", ".2g"))


def _price(value: float, unit: str, of: str) -> str:
    """What one unit of a limit costs."""
    mine, its = ("" if u == "1" else u for u in (unit, of))
    behind = f" {mine or 1} per {its}" if its else f" {mine}"
    return f"{value:.3g}{behind}".rstrip() if value else "0"
