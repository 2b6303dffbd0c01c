"""`crashkit demo`: the whole way on the embedded kart runs, through the public commands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from crashkit.cli._console import run_shown, say, table, what_next


def command(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for everything the demo makes.")] = Path(
        "demo"
    ),
    fresh: Annotated[bool, typer.Option("--fresh", help="Make everything again.")] = False,
) -> None:
    """Run the whole workflow on embedded kart crashes.

    From solver results to a report and ParaView files, in a few minutes. Run again, it does only what is missing.
    """
    from crashkit.api.demo import steps
    from crashkit.dataset import demo_data
    from crashkit.errors import OutputError

    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{output}: cannot be written ({error.strerror}); choose another folder with -o") from error
    run_shown(steps(output, demo_data()), output / "done.json", fresh=fresh)
    show_result(output)


def show_result(output: Path) -> None:
    """The errors from the report's own numbers, and the paths worth opening."""
    rows = json.loads((output / "report" / "report.json").read_text())["performance"]
    say("")
    table(
        "Mean node error on runs no model has seen, on the full mesh",
        ("model", "error (cm)", "worst run (cm)", "best linear compression (cm)"),
        (
            (r["model"], *(_centimetres(r[key]) for key in ("error_cm", "worst_run_cm", "pod_floor_cm")))
            for r in sorted(rows, key=lambda r: -float(r["error_cm"]))
        ),
    )
    say("Open next:")
    for path, what in (
        (output / "crash.html", "sliders: change speed, angle and strength and see the crash, in a browser"),
        (output / "report" / "report.html", "the report, in a browser"),
        (output / "report" / "vtk", "truth, predictions and errors of two runs, in ParaView (.pvd)"),
        (output / "new_crash.pvd", "a crash nobody computed, in ParaView"),
        (output / "levels.png", "the meshes the surrogate works on"),
    ):
        if path.exists():
            say(f"  {path}  {what}")
    what_next(None, ("info", output / "mh"), ("run", "study.yaml"))


def _centimetres(value: float | None) -> str:
    """A number of the report, which has none where a model keeps more modes than are looked at."""
    return "-" if value is None else f"{value:.2f}"
