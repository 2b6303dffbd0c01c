"""Source formats, behind one registry that knows no format by name.

A format registers itself at the foot of its file. Other packages add theirs with an entry point in the group
`crashkit.readers` that names a Reader object or a class without arguments.
"""

from __future__ import annotations

import importlib
import logging
import pkgutil
from importlib.metadata import entry_points
from pathlib import Path

from crashkit.errors import CrashkitError, ReadError
from crashkit.readers._foreign import name_of
from crashkit.readers.base import Reader, Runs
from crashkit.readers.checks import LIBRARY_ERRORS, is_damaged_hdf5

ENTRY_POINT_GROUP = "crashkit.readers"
_log = logging.getLogger(__name__)
_READERS: dict[str, Reader] = {}
_loaded = False


def register(reader: Reader) -> None:
    """Make a reader known under its name; a later one replaces an earlier one of the same name."""
    _READERS[reader.name] = reader


def readers() -> dict[str, Reader]:
    """All known readers by name: this folder's, then those of other packages."""
    global _loaded
    if not _loaded:
        for module in pkgutil.iter_modules(__path__):
            if module.name != "base" and not module.name.startswith("_"):
                importlib.import_module(f"{__name__}.{module.name}")
        for entry in entry_points(group=ENTRY_POINT_GROUP):
            try:
                found = entry.load()
                register(found() if isinstance(found, type) else found)
            except Exception as error:  # whatever it is, our own formats can be read without it
                _log.warning("reader %s (%s) cannot be loaded: %s", entry.name, entry.value, error)
        _loaded = True
    return dict(_READERS)


def reader_for(path: Path, name: str | None = None) -> Reader:
    """The reader called `name`, or the one that recognises the content of `path`.

    Raises
    ------
    CrashkitError
        For an unknown name.
    ReadError
        Where the path does not exist or nobody knows it.
    """
    known = readers()
    if name is not None:
        if name not in known:
            raise CrashkitError(f"reader {name!r} is not known; known are {', '.join(sorted(known))}")
        return known[name]
    if not path.exists():
        raise ReadError(f"{path}: no such file or folder")
    for reader in known.values():
        if reader.sniff(path):
            return reader
    what = name_of(path)
    if what is not None:
        raise ReadError(f"{path}: {what}")
    damaged = "it begins like an HDF5 file and cannot be opened as one, so it was cut short or damaged: copy it again"
    advice = damaged if is_damaged_hdf5(path) else "check the path, or name the format with --reader"
    raise ReadError(f"{path}: the content is none of the known formats ({', '.join(sorted(known))}); {advice}")


def passed_over(path: Path, taken: Reader) -> list[str]:
    """What the folder `path` holds for other readers than the one `taken`, in words."""
    out = []
    for reader in readers().values() if path.is_dir() else ():
        if reader is taken or not reader.sniff(path):
            continue
        try:
            runs = reader.runs(path)
            names = runs.names if isinstance(runs, Runs) else ()
        except (CrashkitError, *LIBRARY_ERRORS):
            names = ()
        told = f" ({', '.join(names[:3])}{', ...' if len(names) > 3 else ''})" if names else ""
        out.append(
            f"{path}: read as {taken.name}; what it also holds for {reader.name}{told} is passed over: name those files, or "
            f"say --reader {reader.name}"
        )
    return out
