"""How large, how long, how fast: what shows at a glance whether the units of a source were understood."""

from __future__ import annotations

from dataclasses import dataclass
from math import log10

from data_schema import unit_system

# What a crash or an impact may have, SI: beyond it, the units are asked about. (smallest, largest).
_SIZE, _DURATION, _SPEED, _DISPLACEMENT = (1e-3, 100.0), (1e-6, 10.0), (0.0, 1e3), (0.0, 1e3)
# What most have, for a choice among systems of units.
_USUAL = {"size": 1.5, "duration": 0.05, "speed": 15.0}
_SYSTEMS = ("SI", "mm-ms-kg", "mm-s-t", "cm-us-g", "mm-us-g", "in-s-kg")
# A system that would make a speed of this many m/s of the numbers is not proposed.
_FASTEST = 3e3


@dataclass(frozen=True)
class CampaignScale:
    """The largest of all runs, SI: `size` along x, y and z, m; `duration`, s; `displacement`, m; `speed`, m/s."""

    size: tuple[float, float, float]
    duration: float
    displacement: float
    speed: float

    def __str__(self) -> str:
        size = " x ".join(f"{length:.3g}" for length in self.size)
        return (
            f"structure of {size} m, {1e3 * self.duration:.4g} ms, largest displacement {self.displacement:.3g} m, "
            f"largest speed {self.speed:.3g} m/s"
        )

    def question(self, units: str) -> str:
        """What to ask the user who read the source in `units`; empty where nothing is absurd."""
        size = max(self.size)
        odd = []
        if not _SIZE[0] <= size <= _SIZE[1]:
            odd.append(f"a structure of {size:.3g} m")
        if self.duration and not _DURATION[0] <= self.duration <= _DURATION[1]:
            odd.append(f"{self.duration:.3g} s")
        if self.speed > _SPEED[1]:
            odd.append(f"a speed of {self.speed:.3g} m/s")
        if self.displacement > _DISPLACEMENT[1]:
            odd.append(f"a displacement of {self.displacement:.3g} m")
        if not odd:
            return ""
        likely = " or ".join(self._likely(units)[:2])
        advice = f"if not, the numbers fit {likely}" if likely else "see what its deck is in"
        return f"{' and '.join(odd)} {'is' if len(odd) == 1 else 'are'} unusual: is --units {units} right? {advice}"

    def _likely(self, units: str) -> list[str]:
        """Other systems that the same numbers fit, the one first in which they are nearest to what crashes have."""
        stated = unit_system(units)
        found = []
        for name in _SYSTEMS:
            system = unit_system(name)
            length, time = system.length / stated.length, system.time / stated.time
            if (length, time) == (1.0, 1.0):
                continue
            size, duration, speed = max(self.size) * length, self.duration * time, self.speed * length / time
            if not (_SIZE[0] <= size <= _SIZE[1] and duration <= _DURATION[1] and speed <= _FASTEST):
                continue
            values = {"size": size, "duration": duration, "speed": speed}
            far = sum(log10(values[k] / usual) ** 2 for k, usual in _USUAL.items() if values[k] > 0)
            found.append((far, name))
        return [name for _, name in sorted(found)]
