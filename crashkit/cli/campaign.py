"""`crashkit campaign`: from a parameter box and a solver to an error that is small enough; `crashkit campaign status`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crashkit.cli._console import fail, print_json, say, share, table, what_next
from crashkit.cli._progress import Progress


def command(
    study: Annotated[Path, typer.Argument(help="Campaign file (YAML), or the word status.", show_default=False)],
    where: Annotated[
        Path | None, typer.Argument(help="With status: the campaign file or its folder.", show_default=False)
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder of the campaign.", show_default="beside the file, with its name"),
    ] = None,
    until: Annotated[
        str, typer.Option(help='Error over the box to reach, such as "8 mm".', show_default="what the file says")
    ] = "",
    confidence: Annotated[
        float | None,
        typer.Option(
            help="Probability that the error is below --until.",
            parser=share,
            metavar="SHARE",
            show_default="what the file says, or 0.9",
        ),
    ] = None,
    most_runs: Annotated[
        int | None, typer.Option(help="End at this number of runs.", min=1, show_default=False)
    ] = None,
    runs: Annotated[
        Path | None,
        typer.Option(
            help="Also compute the runs of this table, such as confirm.csv of crashkit optimise.", show_default=False
        ),
    ] = None,
    retry: Annotated[bool, typer.Option("--retry", help="Compute failed runs again.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Compute runs with your solver, and go on until the error over the box is small enough.

    Interrupted or killed, the same command goes on; what was computed is not computed again.
    """
    if str(study) == "status":
        _status(where or Path.cwd(), json)
        return
    from dataclasses import asdict

    from crashkit.api.run_campaign import run_campaign

    with Progress(f"campaign {study}", quiet=json) as shown:
        try:
            summary = run_campaign(
                study, output, until=until or None, confidence=confidence, most_runs=most_runs, retry=retry, runs=runs,
                report=shown.step,
                say=None if json else say,
            )  # fmt: skip
        except KeyboardInterrupt:
            fail("interrupted; jobs were stopped and their runs wait: the same command goes on", code=130)
    if json:
        print_json(asdict(summary))
        return
    say(f"ended: {summary.why}")
    if summary.done == 0:
        fail(f"no run ended well; see {summary.page}, and the run.log of each run", code=1)
    what_next(summary.page, ("info", summary.dataset))


def _status(where: Path, as_json: bool) -> None:
    """Counts and rounds of a campaign, also while another process runs it."""
    from crashkit.api.run_campaign import campaign_status

    found = campaign_status(where)
    if as_json:
        print_json({"folder": found.folder, **found.counts, "rounds": found.rounds})
        return
    say(f"{found.folder}: " + ", ".join(f"{n} {state}" for state, n in found.counts.items() if n))
    for name, why in found.lost.items():
        say(f"  {name} {why}")
    if found.rounds:
        table(
            "Error over the box",
            ("runs", "error (mm)", "interval (mm)", "solver time (min)"),
            (
                (r["runs"], f"{1e3 * r['error_m']:.2f}", f"{1e3 * r['low_m']:.2f} to {1e3 * r['high_m']:.2f}",
                 f"{r['solver_seconds'] / 60:.1f}")
                for r in found.rounds
            ),
        )  # fmt: skip
    if found.page is not None:
        say(f"{found.page}: the same as a page")
