"""What the decks beside OpenRadioss animation files tell: units and end time."""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

from crashkit.readers._folders import files_in
from data_schema import UnknownUnits, unit_system

_UNIT_NAMES = {"mg": "t", "ton": "t", "mus": "us", "msec": "ms", "sec": "s"}
# /BEGIN stands at the head of a starter deck, /RUN somewhere in an engine deck, which is short.
_LINES = 2000
# A card has 80 columns; a line without an end is no card.
_LINE_BYTES = 4096


def decks(folder: Path, root: str) -> tuple[Path, ...]:
    """The decks of the run `root`: starter (0000) first, then the engine's (0001, ...), plain or gzip."""
    name = re.compile(re.escape(root) + r"_(\d{4})\.rad(?:\.gz)?")
    found = {m[1]: file for file in reversed(list(files_in(folder))) if (m := name.fullmatch(file.name))}
    return tuple(file for _, file in sorted(found.items()))


def units(files: Sequence[Path]) -> str | None:
    """The working unit system of the starter deck (/BEGIN), e.g. "mm-ms-kg"; None where the deck does not say."""
    for file in files:
        lines = _lines(file)
        for line in lines:
            if line.upper().startswith("/BEGIN"):
                # Title, version, units of input, units of work: mass, length, time
                rest = [line.split() for line in islice(lines, 4)]
                if len(rest) == 4 and len(rest[3]) == 3:
                    mass, length, time = (_UNIT_NAMES.get(u.lower(), u) for u in rest[3])
                    return _known(f"{length}-{time}-{mass}")
                return None
    return None


def end_time(files: Sequence[Path]) -> float | None:
    """The latest end time that an engine deck asks for (/RUN), in the run's own unit; None where there is none."""
    times = []
    for file in files:
        lines = _lines(file)
        for line in lines:
            if line.upper().startswith("/RUN/"):
                try:
                    times.append(float(next(lines).split()[0]))
                except (StopIteration, IndexError, ValueError):
                    continue
    return max(times, default=None)


def _known(name: str) -> str | None:
    try:
        system = unit_system(name)
    except UnknownUnits:
        return None
    return "SI" if (system.length, system.time, system.mass) == (1.0, 1.0, 1.0) else name


def _lines(file: Path) -> Iterator[str]:
    """The first lines of a deck without comments; a deck that cannot be read tells nothing."""
    try:
        with (
            gzip.open(file, "rt", encoding="latin-1") if file.suffix == ".gz" else file.open(encoding="latin-1") as text
        ):
            for line in islice(iter(lambda: text.readline(_LINE_BYTES), ""), _LINES):
                if not line.startswith("#") and line.strip():
                    yield line.strip()
    except (OSError, EOFError, zlib.error):
        return
