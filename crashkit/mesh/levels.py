"""The mesh hierarchy: its levels (`data_schema.levels`) and how they were made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from crashkit.display import Described, Facts, Rows
from data_schema.levels import Level


@dataclass(frozen=True, repr=False)
class Hierarchy(Described):
    """Coarse levels of one mesh, finest (level 1) first, and how they were made (for the dataset's attributes)."""

    n_nodes: int
    levels: tuple[Level, ...]
    settings: dict[str, object]

    def __getitem__(self, index: int) -> Level:
        """The level with number `index` (1 is the finest coarse level)."""
        if not 1 <= index <= len(self.levels):
            raise IndexError(f"level {index} asked for; the hierarchy has levels 1 to {len(self.levels)}")
        return self.levels[index - 1]

    def _facts(self) -> tuple[str, Facts, Sequence[str], Rows]:
        rows: list[tuple[object, ...]] = [(0, self.n_nodes, "", "", "")]
        for level in self.levels:
            distance = "" if level.distance is None else f"{1e3 * level.distance.mean():.2f}"
            rows.append((level.index, level.n_nodes, len(level.faces), len(level.edges), distance))
        return "mesh hierarchy", {}, ("level", "nodes", "faces", "edges", "mean distance (mm)"), rows
