"""The mesh hierarchy: its levels (`data_schema.levels`) and how they were made."""

from __future__ import annotations

from dataclasses import dataclass

from data_schema.levels import Level


@dataclass(frozen=True)
class Hierarchy:
    """Coarse levels of one mesh, finest (level 1) first, and how they were made (for the dataset's attributes)."""

    n_nodes: int
    levels: tuple[Level, ...]
    settings: dict[str, object]

    def __getitem__(self, index: int) -> Level:
        """The level with number `index` (1 is the finest coarse level)."""
        if not 1 <= index <= len(self.levels):
            raise IndexError(f"level {index} asked for; the hierarchy has levels 1 to {len(self.levels)}")
        return self.levels[index - 1]
