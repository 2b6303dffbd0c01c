"""`crashkit run`: the whole way that one YAML file describes, through the commands one would type."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated

import typer

from crashkit.cli._console import say, steps_shown, what_next

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
    from crashkit.api.run_study import run_study, study_steps

    if dry:
        for step in study_steps(study):
            typer.echo(step.line)
        return
    with steps_shown():
        result = run_study(study, fresh=fresh, say=say)
    say("")
    if result.report is not None:
        what_next(result.report, ("predict", result.models[0], "--param", "NAME=VALUE"))
    else:
        what_next(result.output, ("info", result.models[0]))


command.__doc__ = f"{inspect.cleandoc(command.__doc__ or '')}\n\n{_EXAMPLE}\n"
