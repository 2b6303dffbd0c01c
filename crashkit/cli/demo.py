"""`crashkit demo`: the whole way on the embedded kart runs, through the public commands."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crashkit.cli._console import fixed, say, steps_shown, table, what_next

if TYPE_CHECKING:
    from crashkit.api.demo import DemoResult


def command(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for everything the demo makes.")] = Path(
        "demo"
    ),
    fresh: Annotated[bool, typer.Option("--fresh", help="Make everything again.")] = False,
) -> None:
    """Run the whole workflow on embedded kart crashes.

    From solver results to a report and ParaView files, in a few minutes. Run again, it does only what is missing.
    """
    from crashkit.api.demo import run_demo

    with steps_shown():
        result = run_demo(output, fresh=fresh, say=say)
    show(result)


def show(result: DemoResult) -> None:
    """The errors from the report's own numbers, and the paths worth opening."""
    say("")
    table(
        "Mean node error on runs no model has seen, on the full mesh",
        ("model", "error (cm)", "worst run (cm)", "best linear compression (cm)"),
        (
            (r["model"], *(fixed(r[key], 2) for key in ("error_cm", "worst_run_cm", "pod_floor_cm")))
            for r in result.performance
        ),
    )
    say(result.regressions)
    say("Open next:")
    for path, what in result.files.items():
        say(f"  {path}  {what}")
    what_next(None, ("info", result.model), ("ingest", "YOUR_RUNS", "-o", "crash.zarr"))
