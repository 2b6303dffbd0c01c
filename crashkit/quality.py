"""Whether a run ended well, and how good it is, from what the solver itself wrote: its last lines, energies, added mass.

A solver can end normally with nonsense (an unknown keyword is passed over, and the structure does not move), so the
numbers are looked at, too: first those of the time histories, which know the whole run and the energy of contacts, then
those in the last lines of the solver's listing. Values are per cent.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from crashkit.readers.history import History

# A cycle line of OpenRadioss: CYCLE TIME TIME-STEP ELEMENT NUMBER ERROR I-ENERGY K-ENERGY T K-ENERGY R EXT-WORK MAS.ERR ...
_RADIOSS_LINE = re.compile(
    r"^\s*\d+\s+[\d.E+-]+\s+[\d.E+-]+\s+\S+\s+\d+\s+(?P<error>-?[\d.]+)%\s+(?P<internal>[\d.E+-]+)\s+"
    r"(?P<kinetic>[\d.E+-]+)\s+[\d.E+-]+\s+[\d.E+-]+\s+(?P<mass>[\d.E+-]+)",
    re.MULTILINE,
)
_DYNA_RATIO = re.compile(r"total energy / initial energy\s*\.*\s*(?P<ratio>[\d.E+-]+)", re.IGNORECASE)
_DYNA_MASS = re.compile(r"percentage increase\s*\.*\s*=?\s*(?P<mass>[\d.E+-]+)", re.IGNORECASE)
_TAIL = 1 << 16


# What is measured -> how people call it, and the largest value that is fine, per cent. None: no limit.
MEASURES: Mapping[str, str] = {
    "energy_error": "error of the energy balance",
    "hourglass_share": "hourglass energy over internal energy",
    "mass_added": "added mass",
}
Limits = Mapping[str, float | None]
LIMITS: Limits = {"energy_error": 15.0, "hourglass_share": 10.0, "mass_added": 10.0}


@dataclass(frozen=True)
class Quality:
    """How good a run is; None where nothing says.

    Attributes
    ----------
    ended
        Whether the solver says that it ended normally.
    energy_error
        Largest difference of the total energy from what it was at first and the work done since, per cent of the largest
        total energy.
    hourglass_share
        Largest hourglass energy, per cent of the largest internal energy.
    mass_added
        Mass added by mass scaling, per cent of the mass without it.
    still
        All energies are zero.
    leap
        A node that leaps away in one state and is back in the next, with where and how far; empty without.
    """

    ended: bool | None = None
    energy_error: float | None = None
    hourglass_share: float | None = None
    mass_added: float | None = None
    still: bool = False
    leap: str = ""

    @property
    def values(self) -> dict[str, float]:
        """What is known, per cent, by the names of `MEASURES`."""
        return {name: value for name in MEASURES if (value := getattr(self, name)) is not None}

    def beyond(self, limits: Limits = LIMITS) -> list[str]:
        """A sentence for each thing that is wrong, the worst first; empty where the run is fine."""
        out = []
        if self.ended is False:
            out.append("the solver did not end normally")
        if self.still:
            out.append("all energies are zero: nothing moved; check the deck's initial velocity")
        if self.leap:
            out.append(self.leap)
        for name, value in self.values.items():
            limit = limits.get(name)
            if limit is not None and not value <= limit:
                out.append(f"{MEASURES[name]} {value:.3g} %, the limit is {limit:g} %")
        return out


def measured(history: History | None, printed: Quality = Quality()) -> Quality:
    """`printed`, with what the time histories know better."""
    if history is None:
        return printed
    curves = {c.name.removeprefix("glstat_"): v for c, v in zip(history.channels, history.values.T, strict=True)}
    error, share, mass = _energy_error(curves), _hourglass_share(curves), _mass_added(curves)
    energies = [curves[n] for n in ("internal_energy", "kinetic_energy") if n in curves]
    return replace(
        printed,
        energy_error=printed.energy_error if error is None else error,
        hourglass_share=share,
        mass_added=printed.mass_added if mass is None else mass,
        still=printed.still or (len(energies) == 2 and not any(np.any(e) for e in energies)),
    )


Curves = Mapping[str, NDArray[np.float64]]


def _energy_error(curves: Curves) -> float | None:
    """LS-DYNA's own ratio; else internal, kinetic and contact energy against their first value and the external work."""
    ratio = curves.get("energy_ratio")
    if ratio is not None and np.isfinite(ratio).any():
        return 100 * float(np.nanmax(np.abs(ratio - 1)))
    if not {"internal_energy", "kinetic_energy"} <= set(curves):
        return None
    parts = ("internal_energy", "kinetic_energy", "rotation_energy", "contact_energy", "sliding_interface_energy")
    total = np.sum([curves[n] for n in parts if n in curves], axis=0)
    work = curves.get("external_work", np.zeros_like(total))
    largest = float(np.nanmax(np.abs(total), initial=0.0))
    return None if not largest else 100 * float(np.nanmax(np.abs(total - total[0] - (work - work[0])))) / largest


def _hourglass_share(curves: Curves) -> float | None:
    """Of the whole model; of all parts together where the solver leaves the whole at zero."""
    whole = curves.get("hourglass_energy")
    if whole is None or not np.any(whole):
        parts = [v for name, v in curves.items() if name.endswith("_hourglass_energy") and "eroded" not in name]
        whole = np.sum(parts, axis=0) if parts else whole
    internal = curves.get("internal_energy")
    if whole is None or internal is None:
        return None
    largest = float(np.nanmax(internal, initial=0.0))
    return None if not largest else 100 * float(np.nanmax(whole, initial=0.0)) / largest


def _mass_added(curves: Curves) -> float | None:
    for name in ("added_mass_percent", "percent_increase"):
        if name in curves and np.isfinite(curves[name]).any():
            return float(np.nanmax(curves[name]))
    mass = curves.get("mass")
    if mass is None or not mass[0] > 0:
        return None
    return 100 * float(np.nanmax(mass) / mass[0] - 1)


def look(folder: Path, name: str = "*") -> Quality:
    """What OpenRadioss (`name`_0001.out) or LS-DYNA (messag, d3hsp, run.log) printed in `folder` about its run."""
    outputs = sorted(p for p in folder.glob(f"{name}_[0-9][0-9][0-9][0-9].out") if not p.name.endswith("_0000.out"))
    if outputs:
        text = _end(outputs[-1])
        lines = list(_RADIOSS_LINE.finditer(text))
        last = lines[-1] if lines else None
        return Quality(
            "NORMAL TERMINATION" in text,
            energy_error=None if last is None else abs(float(last["error"])),
            mass_added=None if last is None else 100 * abs(float(last["mass"])),
            still=bool(lines) and not any(float(k["internal"]) or float(k["kinetic"]) for k in lines),
        )
    for name in ("messag", "mes0000", "d3hsp", "run.log"):
        if (folder / name).is_file():
            text = _end(folder / name)
            plain = text.replace(" ", "").lower()
            if "normaltermination" in plain or "errortermination" in plain:
                ratio, mass = list(_DYNA_RATIO.finditer(text)), list(_DYNA_MASS.finditer(text))
                return Quality(
                    "normaltermination" in plain,
                    energy_error=100 * abs(1 - float(ratio[-1]["ratio"])) if ratio else None,
                    mass_added=abs(float(mass[-1]["mass"])) if mass else None,
                )
    return Quality()


def says(folder: Path, pattern: str, text: str) -> bool:
    """Whether one of the files `pattern` of `folder` has `text` near its end."""
    return any(text in _end(file) for file in sorted(folder.glob(pattern)) if file.is_file())


def _end(file: Path) -> str:
    with file.open("rb") as stream:
        stream.seek(max(0, file.stat().st_size - _TAIL))
        return stream.read().decode("latin-1")
