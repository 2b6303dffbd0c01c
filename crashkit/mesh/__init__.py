"""Meshes through VTK: surface, quadric selection, probe maps, hierarchy.

Arrays in, arrays out; only `store` and `export` know files. The names below are imported when first used, because
numba and VTK take their time. Functions that are called like their module, `surface` and `refine`, are imported from it.
"""

from __future__ import annotations

import importlib
from typing import Any

_LAZY = {
    "Hierarchy": "levels",
    "Level": "levels",
    "Surface": "surface",
    "build_hierarchy": "hierarchy",
    "level_displacement": "store",
    "open_hierarchy": "store",
    "summarize_hierarchy": "store",
    "write_hierarchy": "store",
    "write_levels": "export",
}

__all__ = list(_LAZY)


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'crashkit.mesh' has no attribute {name!r}")
    return getattr(importlib.import_module(f"crashkit.mesh.{_LAZY[name]}"), name)
