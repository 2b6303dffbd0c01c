"""Times as they are typed: a list, or start:stop:number, with a unit where it is not s."""

from __future__ import annotations

import itertools

import typer

# More times than this are a slip of the keyboard.
_MOST = 100_000
_FORMS = "expected times in s or with a unit, such as 15ms or 0,0.01,0.02, or start:stop:number, such as 0:30ms:4"


def times(text: str, option: str = "--time") -> list[float] | None:
    """Times in s, increasing; None for an empty text; bad usage, with the forms there are, for anything else."""
    if not text.strip():
        return None
    found = _even(text, option) if ":" in text else [_time(piece, text, option) for piece in text.split(",")]
    if any(b <= a for a, b in itertools.pairwise(found)):
        raise typer.BadParameter(f"{text!r}; expected increasing times, each once", param_hint=option)
    return found


def _even(text: str, option: str) -> list[float]:
    """start:stop:number; where one of both has a unit, it is that of the other, too."""
    from data_schema.units import number_and_unit

    pieces = text.split(":")
    number = pieces[-1].strip()
    if len(pieces) != 3 or not number.isdigit() or not 2 <= int(number) <= _MOST:
        what = f"{number!r} is no number of times from 2 to {_MOST}; " if len(pieces) == 3 else ""
        raise typer.BadParameter(f"{text!r}; {what}{_FORMS}", param_hint=option)
    said = [found[1] if (found := number_and_unit(piece)) else "" for piece in pieces[:2]]
    unit = said[0] or said[1]
    ends = [piece if own else f"{piece} {unit}" for piece, own in zip(pieces[:2], said, strict=True)]
    first, last = (_time(piece, text, option) for piece in ends)
    count = int(number)
    return [first + (last - first) * k / (count - 1) for k in range(count)]


def _time(piece: str, text: str, option: str) -> float:
    from data_schema.units import UnknownUnits, duration

    try:
        return duration(piece)
    except UnknownUnits as error:
        raise typer.BadParameter(f"{text!r}: {error}; {_FORMS}", param_hint=option) from error
