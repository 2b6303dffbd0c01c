"""crashkit: crash runs in, one labelled dataset, a mesh hierarchy and trustworthy surrogates out.

The functions below are what the commands of the same name call; they are imported when first used, so that
`import crashkit` stays quick.
"""

from __future__ import annotations

import importlib
from typing import Any

from crashkit.version import __version__

# Public name -> "module:attribute".
_LAZY = {
    "ingest": "crashkit.ingestion.ingest:ingest",
    "open_dataset": "crashkit.dataset:open_dataset",
    "open_hierarchy": "crashkit.mesh.store:open_hierarchy",
    "validate": "data_schema:validate",
    "coarsen": "crashkit.api.coarsen:coarsen",
    "train": "crashkit.api.train:train",
    "load_model": "crashkit.api.predict:load_model",
    "predict": "crashkit.api.predict:predict",
    "evaluate": "crashkit.api.evaluate:evaluate",
    "write_paraview": "crashkit.writers.paraview:write_paraview",
    "CrashkitError": "crashkit.errors:CrashkitError",
}

__all__ = ["__version__", *_LAZY]


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'crashkit' has no attribute {name!r}")
    module, attribute = _LAZY[name].split(":")
    return getattr(importlib.import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted(__all__)
