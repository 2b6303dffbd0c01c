"""`crashkit validate`: does a dataset keep the rules?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crashkit.cli._console import print_json, say
from crashkit.cli._progress import Progress


def command(
    path: Annotated[Path, typer.Argument(help="Dataset (.zarr or .nc).", show_default=False)],
    quick: Annotated[
        bool, typer.Option("--quick", help="Check names, dimensions, units and attributes, not the values.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the violations as JSON.")] = False,
) -> None:
    """Check a dataset against the schema and its checksums; list what is wrong and exit with 1 if anything is."""
    from dataclasses import asdict

    from crashkit.api.validate import validate

    with Progress(f"checking {path}", quiet=as_json):
        violations = validate(path, values=not quick)
    if as_json:
        print_json({"path": path, "valid": not violations, "violations": [asdict(v) for v in violations]})
    else:
        for violation in violations:
            typer.echo(str(violation))
        count = f"{len(violations)} violation{'s' if len(violations) > 1 else ''}"
        say(f"{path}: {count if violations else 'keeps every rule of a crash dataset'}")
    if violations:
        raise typer.Exit(1)
