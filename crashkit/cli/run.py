"""`crashkit run`: the whole way that one YAML file describes, through the commands one would type."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated

import typer

from crashkit.cli._console import run_shown, say, what_next

_EXAMPLE = """\b
A study.yaml (paths are relative to it):
  output: results
  ingest:   {sources: [runs], params: table.csv, units: mm-ms-kg}
  coarsen:  {nodes: [1165, 292, 73]}
  train:
    test: 0.25
    models: {mh: {preset: fast}, pod-gpr: {}}
  evaluate: {write_vtu: true}
Keys are the options of the commands, with _ instead of -."""


def command(
    study: Annotated[Path, typer.Argument(help="YAML file.", show_default=False)],
    fresh: Annotated[bool, typer.Option("--fresh", help="Make everything again.")] = False,
    dry: Annotated[bool, typer.Option("--dry-run", help="Show the commands, run none.")] = False,
) -> None:
    """Run the whole workflow described by one YAML file.

    Ingest, coarsen, train and evaluate, as often as you like: only what changed is done again.
    """
    from crashkit.api.run_study import steps
    from crashkit.api.study import read_study
    from crashkit.errors import OutputError

    wanted = read_study(study)
    todo = steps(wanted, study.parent)
    if dry:
        import shlex

        for step in todo:
            typer.echo("crashkit " + shlex.join(step.arguments))
        return
    output = study.parent / wanted.output
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{output}: cannot be written ({error.strerror}); choose another output") from error
    run_shown(todo, output / "done.json", fresh=fresh)
    say("")
    if wanted.evaluate is not None:
        model = next(iter(wanted.train.models))
        what_next(output / "report" / "report.html", ("predict", output / model, "--param", "NAME=VALUE"))
    else:
        what_next(output, ("info", output / next(iter(wanted.train.models))))


command.__doc__ = f"{inspect.cleandoc(command.__doc__ or '')}\n\n{_EXAMPLE}\n"
