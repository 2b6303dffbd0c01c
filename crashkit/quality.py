"""Whether a run ended well, and how good it is, from what the solver itself wrote: its last lines, energies, added mass.

A solver can end normally with nonsense (an unknown keyword is passed over, and the structure does not move), so the
files are looked at, too. Values are per cent.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

# A cycle line of OpenRadioss: CYCLE TIME TIME-STEP ELEMENT NUMBER ERROR I-ENERGY K-ENERGY T K-ENERGY R EXT-WORK MAS.ERR ...
_RADIOSS_LINE = re.compile(
    r"^\s*\d+\s+[\d.E+-]+\s+[\d.E+-]+\s+\S+\s+\d+\s+(?P<error>-?[\d.]+)%\s+(?P<internal>[\d.E+-]+)\s+"
    r"(?P<kinetic>[\d.E+-]+)\s+[\d.E+-]+\s+[\d.E+-]+\s+(?P<mass>[\d.E+-]+)",
    re.MULTILINE,
)
_DYNA_RATIO = re.compile(r"total energy / initial energy\s*\.*\s*(?P<ratio>[\d.E+-]+)", re.IGNORECASE)
_DYNA_MASS = re.compile(r"percentage increase\s*\.*\s*=?\s*(?P<mass>[\d.E+-]+)", re.IGNORECASE)
_TAIL = 1 << 16


@dataclass(frozen=True)
class Verdict:
    """ended: None where no known output says; energy_error and mass_added: per cent; still: all energies are zero."""

    ended: bool | None
    energy_error: float | None = None
    mass_added: float | None = None
    still: bool = False


def look(folder: Path) -> Verdict:
    """What OpenRadioss (NAME_0001.out) or LS-DYNA (messag, d3hsp, run.log) wrote in `folder` about its run."""
    outputs = sorted(p for p in folder.glob("*_[0-9][0-9][0-9][0-9].out") if not p.name.endswith("_0000.out"))
    if outputs:
        text = _end(outputs[-1])
        lines = list(_RADIOSS_LINE.finditer(text))
        last = lines[-1] if lines else None
        return Verdict(
            "NORMAL TERMINATION" in text,
            None if last is None else abs(float(last["error"])),
            None if last is None else 100 * abs(float(last["mass"])),
            bool(lines) and not any(float(k["internal"]) or float(k["kinetic"]) for k in lines),
        )
    for name in ("messag", "mes0000", "d3hsp", "run.log"):
        if (folder / name).is_file():
            text = _end(folder / name)
            plain = text.replace(" ", "").lower()
            if "normaltermination" in plain or "errortermination" in plain:
                ratio, mass = list(_DYNA_RATIO.finditer(text)), list(_DYNA_MASS.finditer(text))
                return Verdict(
                    "normaltermination" in plain,
                    100 * abs(1 - float(ratio[-1]["ratio"])) if ratio else None,
                    abs(float(mass[-1]["mass"])) if mass else None,
                )
    return Verdict(None)


def says(folder: Path, pattern: str, text: str) -> bool:
    """Whether one of the files `pattern` of `folder` has `text` near its end."""
    return any(text in _end(file) for file in sorted(folder.glob(pattern)) if file.is_file())


def _end(file: Path) -> str:
    with file.open("rb") as stream:
        stream.seek(max(0, file.stat().st_size - _TAIL))
        return stream.read().decode("latin-1")
