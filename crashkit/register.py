"""`import crashkit` gives xarray the accessor `.crash`, and does not wait half a second for xarray."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType


def register_accessor() -> None:
    """Register `.crash` now where xarray is imported, else as soon as somebody imports it."""
    if "xarray" in sys.modules:
        import crashkit.accessor  # noqa: F401  registers `.crash`
    else:
        sys.meta_path.insert(0, _AfterXarray())


class _AfterXarray(MetaPathFinder):
    """Finds xarray as Python would, and has the accessor registered behind its import; leaves all else alone."""

    _asking = False

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name != "xarray" or self._asking:
            return None
        self._asking = True
        try:
            spec = importlib.util.find_spec(name)
        finally:
            self._asking = False
        if spec is None or spec.loader is None:
            return spec
        execute = spec.loader.exec_module

        def exec_module(module: ModuleType) -> None:
            execute(module)
            if self in sys.meta_path:
                sys.meta_path.remove(self)
            import crashkit.accessor  # noqa: F401  registers `.crash`

        spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec
