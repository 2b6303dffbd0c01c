"""`crashkit explore`: stored models as one HTML file with sliders."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crashkit.cli._console import print_json, say, share, what_next
from crashkit.cli._progress import Progress


def command(
    models: Annotated[list[Path], typer.Argument(help="Model folders made by `crashkit train`.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", help="HTML file.")] = Path("crash.html"),
    title: Annotated[str, typer.Option(help="Heading of the page.", show_default="names of the models")] = "",
    band: Annotated[
        float,
        typer.Option(
            help="Share of nodes and states that the band should hold, 0.9 or 90%.", parser=share, metavar="SHARE"
        ),
    ] = 0.9,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that is there.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Write one HTML file with sliders in which the models run: for a colleague, a phone, a meeting."""
    from crashkit.api.explore import explore

    with Progress("a page with sliders", quiet=json):
        page = explore(models, output, title=title, share=band, overwrite=overwrite)
    size = page.stat().st_size
    if json:
        print_json({"output": page, "bytes": size})
        return
    say(f"{page}: {size / 1e6:.1f} MB, opens from the disk in any browser")
    what_next(page)
