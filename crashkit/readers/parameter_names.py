"""Names of design parameters, the same for tables, HDF5 files and whatever else states them."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from crashkit.errors import ReadError

# "speed [m/s]", "speed (m/s)", "speed in m/s"; what stands in brackets in the middle belongs to the name.
_BRACKETS = re.compile(r"(?P<name>.+?)\s*(?:\[(?P<square>[^\[\]]*)\]|\((?P<round>[^()]*)\))")
_IN = re.compile(r"(?P<name>.+?)\s+in\s+(?P<unit>\S+)")
_LIKE_A_UNIT = re.compile(r"[/^*°²³·%\d]")
# A name goes into files, formulas and file names.
LONGEST_NAME = 100


def split_title(title: str, is_unit: Callable[[str], bool]) -> tuple[str, str]:
    """Name and unit of a column's title: what stands in brackets at its end, or behind "in", where it is a unit.

    Brackets that hold a word belong to the name ("t (front)"). Square brackets that look like a unit are taken for one
    even where it is not known, so that whoever converts it says so.
    """
    text = " ".join(title.split())
    match = _BRACKETS.fullmatch(text)
    if match:
        inside = (match["square"] if match["square"] is not None else match["round"]).strip()
        looks_so = match["square"] is not None and _LIKE_A_UNIT.search(inside)
        return (match["name"], inside) if not inside or looks_so or is_unit(inside) else (text, "")
    match = _IN.fullmatch(text)
    return (match["name"], match["unit"]) if match and is_unit(match["unit"]) else (text, "")


def parameter_name(title: str, place: str) -> str:
    """A name of letters, digits and underscores, made of a title without its unit.

    Raises
    ------
    ReadError
        Naming `place` where nothing is left of it, or too much.
    """
    name = re.sub(r"\W+", "_", title.strip()).strip("_")
    if not name:
        raise ReadError(f"{place}: {title[:40]!r} is no name of a parameter; expected letters or digits")
    if len(name) > LONGEST_NAME:
        raise ReadError(f"{place}: the name {name[:40]}... has {len(name)} letters; expected at most {LONGEST_NAME}")
    return name


def _check_brackets(title: str, place: str) -> None:
    """Refuse "speed [m/s", whose name would hold the unit."""
    for opened, closed in ("[]", "()"):
        if title.count(opened) != title.count(closed):
            missing = closed if title.count(opened) > title.count(closed) else opened
            raise ReadError(f"{place}: column {title!r} lacks a bracket {missing!r}; expected such as 'speed [m/s]'")


def parameter_columns(titles: Sequence[str], units: Sequence[str], place: str) -> list[tuple[str, str]]:
    """(name, unit) of every column, from its title and the unit stated beside it ("" for none).

    Raises
    ------
    ReadError
        Naming `place` and both columns where two would be one parameter, and a column that lacks a bracket or states two units.
    """
    from data_schema.units import is_unit

    out: list[tuple[str, str]] = []
    first: dict[str, str] = {}
    for title, beside in zip(titles, units, strict=True):
        _check_brackets(title, place)
        plain, unit = split_title(title, is_unit)
        left = split_title(plain, is_unit)[1] if unit else ""
        if left:
            raise ReadError(f"{place}: column {title!r} states two units, {left} and {unit}; leave one")
        name = parameter_name(plain, place)
        other = first.setdefault(name.lower(), title)
        if len(out) and other is not title:
            raise ReadError(
                f"{place}: columns {other!r} and {title!r} would both be parameter {name}; rename one of them"
            )
        out.append((name, beside.strip() or unit))
    return out
