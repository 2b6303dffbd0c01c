"""What all commands share: the two consoles, JSON output, failing, and what to look at next."""

from __future__ import annotations

import contextlib
import json
import math
import shlex
import shutil
import sys
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import typer

if TYPE_CHECKING:
    from rich.console import Console


def console(stderr: bool = False) -> Console:
    """The terminal. Results go to stdout, progress and messages to stderr, so that pipes get results alone."""
    from rich.console import Console

    return Console(stderr=stderr, highlight=False, soft_wrap=True)


def fail(message: str, code: int = 1) -> NoReturn:
    """Print one line to stderr and leave with `code`."""
    say("error: " + " ".join(message.split()))
    raise typer.Exit(code)


def say(message: str, *, wrap: bool = True) -> None:
    """A line for people, on stderr; what its encoding lacks is written as `\\xe9` instead of ending in an error.

    On a terminal that is narrower, it is broken between words; in a file or a pipe it stays one line. Where work is shown on
    a live line, the message stands above it, on a line of its own.
    """
    encoding = getattr(sys.stderr, "encoding", None) or "utf-8"
    if wrap and sys.stderr.isatty():
        message = wrapped(message, shutil.get_terminal_size().columns)
    message = message.encode(encoding, "backslashreplace").decode(encoding)
    if LIVE:
        from rich.text import Text

        LIVE[-1].print(Text(message), soft_wrap=True)
    else:
        typer.echo(message, err=True)


# Consoles that show a live line now, the last one on top.
LIVE: list[Console] = []


def wrapped(text: str, width: int) -> str:
    """`text` broken between words, further lines set in; paths and names are never broken."""
    indent = text[: len(text) - len(text.lstrip())]
    lines = textwrap.wrap(
        text, width, subsequent_indent=f"{indent}  ", break_long_words=False, break_on_hyphens=False,
        replace_whitespace=False, drop_whitespace=True,
    )  # fmt: skip
    return "\n".join(lines)


def what_next(look: Path | str | None, *commands: Iterable[object]) -> None:
    """The last lines of a command: the path to look at, and the next command, ready to be pasted."""
    if look is not None:
        say(f"look at  {look}", wrap=False)
    for command in commands:
        say("next     crashkit " + shlex.join(map(str, command)), wrap=False)


def look_in_paraview(files: Sequence[Path]) -> None:
    """The file to open, and the script beside it that shows it in fixed colour ranges, if there is one."""
    view = f"; {files[-1]} shows it in fixed colour ranges (File > Load State)"
    what_next(f"{files[0]} in ParaView{view}" if files[-1].name.endswith("_view.py") else files[0])


@contextlib.contextmanager
def steps_shown() -> Iterator[None]:
    """Around commands that run one after the other: what stops one of them, it has said itself."""
    from crashkit.api.steps import StepFailedError

    try:
        yield
    except StepFailedError as error:
        fail(str(error), error.code)
    except KeyboardInterrupt:
        say("stopped; the same command goes on from there")
        raise typer.Exit(130) from None


def print_json(value: Any) -> None:
    """One JSON document on stdout; NaN and infinity become null, since JSON has neither."""
    typer.echo(json.dumps(_plain(value), indent=2, allow_nan=False))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, set)):
        return [_plain(v) for v in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, (str, int, float, bool)):
        return value
    return str(value)


def table(title: str, columns: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """A table on stdout; the first column is text, the others are right-aligned. What is too long is folded, never cut."""
    from rich.table import Table
    from rich.text import Text

    out = Table(title=Text(title), title_justify="left")
    for k, column in enumerate(columns):
        out.add_column(column, justify="left" if k == 0 else "right", overflow="fold")
    for row in rows:
        out.add_row(*(Text(str(cell)) for cell in row))
    console().print(out)


def fixed(value: float | None, digits: int, factor: float = 1.0) -> str:
    """A number for a table; a dash where there is none."""
    return "-" if value is None or value != value else f"{factor * value:.{digits}f}"


def numbers(text: str, option: str, example: str, *, kind: str = "numbers", whole: bool = False) -> list[Any]:
    """The numbers of a list such as "8,4,4"; bad usage where it is none."""
    try:
        return [int(piece) if whole else float(piece) for piece in text.split(",")] if text else []
    except ValueError as error:
        kind = "whole numbers" if whole else kind
        raise typer.BadParameter(
            f"{text!r}; expected {kind} with commas between them, such as {example}", param_hint=option
        ) from error


def share(given: str | float) -> float:
    """A share such as 0.9 or 90%; bad usage where it is none."""
    text = str(given).strip()
    percent = text.endswith("%")
    try:
        value = float(text.removesuffix("%")) / (100 if percent else 1)
    except ValueError:
        value = math.nan
    if not 0 < value < 1:
        like = f"{float(text):g}%" if not percent and 1 < value < 100 else "90%"
        raise typer.BadParameter(f"{text!r}; expected a share between 0 and 1, such as 0.9, or {like}")
    return value


def names(text: str) -> list[str]:
    """The names of a list such as "floor,pillar*"."""
    return [piece.strip() for piece in text.split(",") if piece.strip()]
