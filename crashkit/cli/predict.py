"""`crashkit predict`: ask a stored model about a crash that nobody computed."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crashkit.api.predict import SUFFIXES, further_arrays, load_model, predict, write_prediction
from crashkit.cli._console import print_json, say

if TYPE_CHECKING:
    pass


def command(
    model: Annotated[Path, typer.Argument(help="Model folder.", show_default=False)],
    param: Annotated[
        list[str] | None, typer.Option("--param", help="One parameter: impact_speed=20 or yield_stress=400MPa.")
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="run.pvd, run.vtkhdf (ParaView), run.vtu (one state) or run.npz.")
    ] = Path("prediction.pvd"),
    time: Annotated[
        str, typer.Option(help="Times, s: 0.015 or 0,0.01,0.02.", show_default="those of the training runs")
    ] = "",
    level: Annotated[int | None, typer.Option(help="Mesh level.", show_default="the finest it has")] = None,
    full: Annotated[bool, typer.Option("--full", help="On the full mesh.")] = False,
    band: Annotated[
        float | None,
        typer.Option(help="Also how far nodes may be off, so that this share (0.9) lies within.", show_default=False),
    ] = None,
    sensitivity: Annotated[bool, typer.Option("--sensitivity", help="Also the derivatives by each parameter.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Predict one run, and write it for ParaView or as arrays."""
    from crashkit.errors import OutputError

    if output.suffix not in SUFFIXES:
        raise OutputError(f"{output}: the suffix says what is written; expected one of {', '.join(SUFFIXES)}")
    surrogate = load_model(model)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        run = predict(surrogate, _given(param or ()), _times(time), level, full)
    for sentence in filter(None, run.attrs["warnings"].split("; ")):
        say(f"warning: {sentence}")
    further = further_arrays(surrogate, run, band, sensitivity)
    files = write_prediction(surrogate, run, output, further)
    largest = float((run**2).sum("xyz").max() ** 0.5)
    if json:
        print_json(
            {
                "files": files, "arrays": ["displacement", *further], "level": run.attrs["level"],
                "states": run.sizes["time"], "nodes": run.sizes["node"],
                "largest_displacement_m": largest, "warnings": run.attrs["warnings"],
            }
        )  # fmt: skip
        return
    say(
        f"{files[0]}: {run.attrs['model']}, {run.sizes['time']} states of {run.sizes['node']} nodes, "
        f"largest displacement {100 * largest:.1f} cm"
    )


def _given(texts: Iterable[str]) -> dict[str, str]:
    out: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name.strip() or not value.strip():
            raise typer.BadParameter(f"{text!r}; expected name=value, such as impact_speed=20", param_hint="--param")
        if name.strip() in out:
            raise typer.BadParameter(f"{name.strip()} is given twice", param_hint="--param")
        out[name.strip()] = value
    return out


def _times(text: str) -> list[float] | None:
    if not text:
        return None
    try:
        return [float(piece) for piece in text.split(",")]
    except ValueError as error:
        raise typer.BadParameter(
            f"{text!r}; expected seconds, such as 0.015 or 0,0.01,0.02", param_hint="--time"
        ) from error
