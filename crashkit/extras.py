"""What is installed only when asked for (`pip install 'crashkit[train]'`), and the one line that says it is missing."""

from __future__ import annotations

import importlib.util
import sys

from crashkit.errors import CrashkitError

# Extra -> the modules it brings that crashkit imports. `[project.optional-dependencies]` in pyproject.toml has their packages.
MODULES = {
    "train": ("torch", "sklearn", "safetensors", "threadpoolctl", "nautilus"),
    "report": ("matplotlib", "jinja2", "objective_rating_metrics"),
    "formats": ("meshio", "openpyxl"),
    "viewer": ("trame_vtk",),
    "campaign": ("jinja2", "psutil", "submitit"),
    "distributed": ("dask", "distributed"),
    "tracking": ("tensorboard",),
    "export": ("onnx", "onnxscript", "onnxruntime"),
}


class MissingExtraError(CrashkitError, ImportError):
    """A package is needed that an extra of crashkit brings, and it is not installed."""


def need(what: str, *extras: str) -> None:
    """Raise MissingExtraError, in one line, unless the packages of `extras` are installed; imports none of them.

    Parameters
    ----------
    what
        What needs them, as the subject of a sentence: "training a model".
    *extras
        Keys of `MODULES`.

    Raises
    ------
    MissingExtraError
        Naming what was to be done, the missing packages and the command that installs them.
    """
    missing = {extra: [m for m in MODULES[extra] if not _installed(m)] for extra in extras}
    modules = [m for extra in extras for m in missing[extra]]
    if modules:
        raise MissingExtraError(_sentence(what, [e for e in extras if missing[e]], modules))


def explained(error: ImportError) -> str | None:
    """The same line for an import that failed somewhere inside; None where no extra brings the module."""
    module = (error.name or "").split(".")[0]
    extras = [extra for extra, modules in MODULES.items() if module in modules]
    return _sentence("this", extras, [module]) if extras else None


def _sentence(what: str, extras: list[str], modules: list[str]) -> str:
    verb = "is" if len(modules) == 1 else "are"
    return f"{what} needs {', '.join(modules)}, which {verb} not installed: pip install 'crashkit[{','.join(extras)}]'"


def _installed(module: str) -> bool:
    if module in sys.modules:
        return sys.modules[module] is not None
    return importlib.util.find_spec(module) is not None
