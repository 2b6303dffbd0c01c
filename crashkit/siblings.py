"""A file `evaluation.py` in the user's folder is not taken for our package of that name, here and in child processes.

Python looks first in the folder of the script, and for `python -m` in the working folder. The packages of crashkit stand
in one folder, so whoever has found one knows where the others are.
"""

from __future__ import annotations

import os
import sys
import sysconfig
import warnings
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

HOME = str(Path(__file__).absolute().parents[1])
NAMES = ("data_schema", "evaluation", "surrogates")


def know_siblings() -> None:
    """From now on `import evaluation` and the like give our packages, whatever files the user's folder holds.

    Raises
    ------
    ImportError
        Where a module of that name was imported from elsewhere before: there is one place for a name in a process.
    """
    for name in NAMES:
        if name in sys.modules and (other := _file_of(sys.modules[name])) is not None:
            raise ImportError(
                f"{other}: was imported as `{name}`, the name of a package that comes with crashkit; rename it",
                name=name,
                path=other,
            )
    if not any(isinstance(finder, _Siblings) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Siblings())


def command(module: str, *arguments: str) -> list[str]:
    """The command line that runs a module of ours in a process of its own; give it `environment()`, too.

    -P: nothing in the working folder is taken for a package of ours or of those that we use.
    """
    return [sys.executable, "-P", "-m", module, *arguments]


def environment() -> dict[str, str]:
    """Variables for such a process, with which it finds crashkit also where that is not installed."""
    if HOME in (sysconfig.get_path("purelib"), sysconfig.get_path("platlib")):
        return dict(os.environ)
    path = os.pathsep.join(filter(None, [HOME, os.environ.get("PYTHONPATH", "")]))
    return {**os.environ, "PYTHONPATH": path}


def forget_working_folder() -> None:
    """Behind `python -m crashkit`: nothing more is imported from the working folder, unless crashkit is there itself."""
    if not sys.flags.safe_path and sys.path and sys.path[0] == str(Path.cwd()) != HOME:
        del sys.path[0]


class _Siblings:
    """Finds our packages beside this one; leaves all else alone."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name not in NAMES:
            return None
        if (other := _hidden(name)) is not None:
            text = f"not imported: `import {name}` gives a package of crashkit's; rename the file if you need both"
            warnings.warn_explicit(text, UserWarning, other, 0)
        return PathFinder.find_spec(name, [HOME], target)


def _hidden(name: str) -> str | None:
    """What a script in the user's folder would have got by that name; nobody's script runs behind our command line."""
    if not sys.path or sys.path[0] in (HOME, "") or _is_ours():
        return None
    script = getattr(sys.modules.get("__main__"), "__file__", None)
    folder = Path(sys.path[0])
    for path in (folder / f"{name}.py", folder / name / "__init__.py"):
        if path.is_file() and (script is None or Path(script).absolute() != path.absolute()):
            return str(path)
    return None


def _is_ours() -> bool:
    """Whether this is our command line, or a child process such as a worker, which has nothing to say to anybody."""
    processes = sys.modules.get("multiprocessing")
    return "crashkit.cli" in sys.modules or (processes is not None and processes.parent_process() is not None)


def _file_of(module: ModuleType) -> str | None:
    """Where a module is from, if not from beside us."""
    file = getattr(module, "__file__", None) or next(iter(getattr(module, "__path__", ())), None)
    if file is None:
        return f"a module {module.__name__}"
    return None if Path(file).resolve().is_relative_to(Path(HOME).resolve()) else str(Path(file).absolute())
