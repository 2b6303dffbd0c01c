"""Runs in files and folders, collected and named the same way for every format.

No file takes another's place: where two runs would get the same name, they are called by their whole file names, and
where that does not help, both are named in a refusal. Only regular files are looked at: a pipe or a device in the
folder would never end.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, TypeVar

from crashkit.errors import ReadError

Family = TypeVar("Family")


@dataclass
class Collected(Generic[Family]):
    """Run name -> its files, and what lies beside them and is left aside, in words."""

    runs: dict[str, Family] = field(default_factory=dict)
    aside: list[str] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.runs)


def files_in(folder: Path) -> Iterator[Path]:
    """The regular files of a folder by name, links to such files included, hidden ones left out."""
    return (p for p in sorted(folder.iterdir()) if p.is_file() and not hidden(p))


def hidden(path: Path) -> bool:
    """Whether a system or a program keeps it for itself: `.snapshot`, `._out.pvd` of macOS, `__MACOSX`."""
    return path.name.startswith(".") or path.name == "__MACOSX"


def named(families: Iterable[tuple[str, str, Family]]) -> dict[str, Family]:
    """Name -> family, from (short name, whole name, family): the short name where no other has it, else the whole one.

    Raises
    ------
    ReadError
        Where two would still be called alike.
    """
    listed = list(families)
    times = Counter(short for short, _, _ in listed)
    out: dict[str, Family] = {}
    for short, whole, family in listed:
        name = short if short and times[short] == 1 else whole
        if name in out:
            others = [w for s, w, _ in listed if name in (s, w)]
            raise ReadError(f"{' and '.join(others)} would both be run {name!r}; rename one of them")
        out[name] = family
    return out


def runs_in(
    path: Path, find: Callable[[Path], Collected[Family]], *, own_name_at_top: bool = False
) -> Collected[Family]:
    """The runs of the folder `path` and of the folders in it; `find` looks into one folder.

    A family alone in its folder is called as the folder (in `path` itself by its own name with `own_name_at_top`),
    several in one folder by their own names.

    Raises
    ------
    ReadError
        Where two runs would be called alike.
    """
    out: Collected[Family] = Collected()
    for folder in (path, *sorted(p for p in path.iterdir() if p.is_dir())):
        if folder is not path and hidden(folder):
            if recognises(find, folder):
                out.aside.append(f"{folder} is a hidden folder and is left aside; name it to read it")
            continue
        found = find(folder)
        out.aside += found.aside
        for own, family in found.runs.items():
            inside = own if folder is path else f"{folder.name}/{own}"
            alone = len(found.runs) == 1 and not (folder is path and own_name_at_top)
            # A link to a folder is called by its own name, so that two links to one run differ.
            name = (folder if folder is not path else folder.resolve()).name if alone else inside
            name = f"{folder.name}/{own}" if name in out.runs else name
            if name in out.runs:
                raise ReadError(f"{folder / own}: another run of {path} is called {name!r} as well; rename one of them")
            out.runs[name] = family
    return out


def one_file_each(path: Path, is_run: Callable[[Path], bool]) -> Collected[Path]:
    """The runs of a format that keeps a run in one file (or one store), at `path` or in the folders there."""
    if is_run(path):
        return Collected({path.stem: path})
    if not path.is_dir():
        return Collected()

    def find(folder: Path) -> Collected[Path]:
        return Collected(named((p.stem, p.name, p) for p in sorted(folder.iterdir()) if not hidden(p) and is_run(p)))

    return runs_in(path, find, own_name_at_top=True)


def recognises(find: Callable[[Path], Collected[Family]], path: Path) -> bool:
    """Whether `find` knows what is at `path`; also where it has to refuse it, since it then can say why."""
    try:
        return bool(find(path))
    except ReadError:
        return True
    except OSError:
        return False
