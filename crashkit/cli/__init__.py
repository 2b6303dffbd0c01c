"""The command line: one small file a command, put together here.

Every command module has a function `command` (the options, a few lines, the printing); those with a result worth
calling from Python also have a public function of the command's name. Modules import VTK, torch, xarray and
friends only inside functions, so that `crashkit --help` stays quick.
"""

from __future__ import annotations

import functools
import gc
import importlib
from collections.abc import Callable
from typing import Any

import typer

from crashkit.cli._console import fail

# The order of a first day's work; `crashkit --help` lists them so.
COMMANDS = (
    "demo",
    "run",
    "ingest",
    "info",
    "validate",
    "coarsen",
    "train",
    "evaluate",
    "predict",
    "explore",
    "scatter",
    "invert",
    "optimise",
    "propose",
    "campaign",
    "export",
)

app = typer.Typer(
    name="crashkit",
    help="Crash runs in, one labelled dataset, a mesh hierarchy and trustworthy surrogates out.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _guarded(command: Callable[..., Any]) -> Callable[..., Any]:
    """`command`, with failures the user can act on printed in one line and exit code 1 instead of a traceback."""

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> Any:
        from crashkit.errors import CrashkitError
        from crashkit.extras import explained
        from data_schema.memory import one_heap
        from evaluation.errors import EvaluationError
        from surrogates.errors import SurrogateError

        one_heap()
        try:
            return command(*args, **kwargs)
        except (CrashkitError, SurrogateError, EvaluationError) as error:
            fail(str(error))
        except OSError as error:
            fail(f"{error.filename or 'file'}: {error.strerror or error}")
        except MemoryError as error:
            fail(f"not enough memory ({str(error) or 'no details'}); close other programs, or use a machine with more")
        except ImportError as error:
            if (line := explained(error)) is None:
                raise
            fail(line)
        except KeyboardInterrupt:
            fail("interrupted", code=130)

    return run


for _name in COMMANDS:
    app.command(_name)(_guarded(importlib.import_module(f"crashkit.cli.{_name}").command))


def _version(value: bool) -> None:
    if value:
        from crashkit.version import __version__

        typer.echo(f"crashkit {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
) -> None:
    pass


def main() -> None:
    """Entry point of the console script."""
    try:
        app()
    finally:
        # Else the interpreter searches all that is left for cycles as it goes down: a quarter of the time of `info`.
        gc.freeze()
