"""Runs in folders, named the same way for every format."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

Family = TypeVar("Family")


def runs_in(path: Path, find: Callable[[Path], Mapping[str, Family]]) -> dict[str, Family]:
    """Run name -> family of files, for the folder `path` and the folders in it; `find` looks into one folder.

    A family alone in its folder is called as the folder, several in one folder by their own names.
    """
    found: dict[str, Family] = {}
    for folder in (path, *sorted(p for p in path.iterdir() if p.is_dir())):
        families = find(folder)
        for own, family in families.items():
            inside = own if folder is path else f"{folder.name}/{own}"
            name = folder.resolve().name if len(families) == 1 else inside
            found[f"{folder.name}/{own}" if name in found else name] = family
    return found
