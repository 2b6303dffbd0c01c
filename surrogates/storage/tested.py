"""What test runs said of a stored model's band of 90 %: noted beside the model by an evaluation, told with later bands.

The note is no part of the model: it is not among the files whose digests are checked, and goes when the model is
replaced.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from data_schema.replace import beside

_FILE = "tested.json"
# A band of 90 % that holds less than this share on test runs misses its promise.
BAND_HOLDS = 0.85


@dataclass(frozen=True)
class BandCheck:
    """The share of nodes and states within the band, and on how many test runs."""

    share: float
    runs: int

    @property
    def told(self) -> str:
        """In words, with a warning where the promise was missed."""
        text = f"on {self.runs} test runs the 90 % band held {100 * self.share:.0f} % of nodes and states"
        return text if self.share >= BAND_HOLDS else f"{text}: it is too narrow, do not take it for the error"


def note_held(folder: Path, held: Mapping[str, BandCheck]) -> None:
    """Note what was held by level, such as "MH1", beside the model in `folder`; where that cannot be written, do without."""
    with contextlib.suppress(OSError), beside(folder / _FILE) as new:
        new.write_text(json.dumps({level: asdict(value) for level, value in held.items()}), encoding="utf-8")


def held_on_tests(folder: Path) -> Mapping[str, BandCheck]:
    """What was noted, by level; empty where nothing was, or nothing that can be."""
    try:
        noted = json.loads((folder / _FILE).read_text(encoding="utf-8"))
        found = {str(level): BandCheck(float(v["share"]), int(v["runs"])) for level, v in noted.items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return {}
    return {level: held for level, held in found.items() if 0 <= held.share <= 1 and held.runs > 0}
