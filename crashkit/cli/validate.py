"""`crashkit validate`: does a dataset keep the rules?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crashkit.cli._console import print_json, say


def command(
    path: Annotated[Path, typer.Argument(help="Dataset (.zarr or .nc).", show_default=False)],
    quick: Annotated[bool, typer.Option("--quick", help="Names, dimensions, units and attributes only.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the violations as JSON.")] = False,
) -> None:
    """Check a dataset against the schema and list every violation; exit code 1 if there is any."""
    from crashkit.dataset import open_dataset
    from data_schema import validate

    with open_dataset(path) as dataset:
        violations = validate(dataset, values=not quick)
    if json:
        print_json([{"where": v.where, "found": v.found, "expected": v.expected} for v in violations])
    else:
        for violation in violations:
            typer.echo(str(violation))
        say(f"{path}: {len(violations)} violations" if violations else f"{path}: keeps every rule of a crash dataset")
    if violations:
        raise typer.Exit(1)
