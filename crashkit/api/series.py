"""What is written of a series of predictions, so that one that was interrupted goes on.

The note lies beside the files: a first line with the model and what all runs are asked alike, then a line for each run
that is whole. Files that a series was going to write belong to it; all others are somebody's, and are never replaced.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from crashkit.errors import OutputError
from data_schema.replace import beside

_NAME = "series.jsonl"


@dataclass
class SeriesNote:
    """The note of the series in `output`, a folder, or a name to which that of the run is added.

    Attributes
    ----------
    identity
        The model and what all runs are asked alike: what must be the same for a series to go on.
    files
        Names of the files it writes, from the folder of the note.
    done
        Runs that are whole: their parameters, files and summary.
    """

    output: Path
    identity: Mapping[str, Any]
    files: set[str] = field(default_factory=set)
    done: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def path(self) -> Path:
        if self.output.suffix:
            return self.output.with_name(f".{self.output.name}.{_NAME}")
        return self.output / f".{_NAME}"

    def read(self) -> bool:
        """Take in what is noted; False where nothing is. A last line that was cut off counts as not written.

        Raises
        ------
        OutputError
            Where the series is that of another model or was asked for something else, naming it.
        """
        lines = list(self._lines())
        if not lines:
            return False
        begun = lines[0].get("identity", {})
        for what, now in self.identity.items():
            before = begun.get(what) if isinstance(begun, dict) else None
            if before != now:
                told = "by another model, or the model was trained again" if what == "model" else _differs(what, before)
                raise OutputError(
                    f"{self.output}: the series there was begun {told}; finish it as it was begun, replace it with "
                    "--overwrite, or choose another place with -o"
                )
        self.files = set(map(str, lines[0].get("files", ())))
        self.done = {str(line["run"]): line for line in lines[1:] if "run" in line}
        return True

    def is_there(self) -> bool:
        """Whether a series was begun there, whichever, and one of its files is left."""
        first = next(self._lines(), {})
        names = first.get("files", ())
        return isinstance(names, list) and any((self.path.parent / str(name)).exists() for name in names)

    def owns(self, file: Path) -> bool:
        return self._name(file) in self.files

    def whole(self, run: str, parameters: Mapping[str, Any]) -> dict[str, Any] | None:
        """The summary of `run` where it was written with these parameters and its files are there."""
        found = self.done.get(run)
        if found is None or found.get("parameters") != dict(parameters):
            return None
        files = [self.path.parent / name for name in found.get("files", ())]
        if not files or not all(file.exists() for file in files):
            return None
        return {**found.get("summary", {}), "files": files}

    def begin(self, files: Iterable[Path]) -> None:
        """Note that the series writes `files`; what is done stays."""
        self.files |= {self._name(file) for file in files}
        first = {"identity": dict(self.identity), "files": sorted(self.files)}
        with self._written(), beside(self.path) as new:
            new.write_text("".join(json.dumps(line) + "\n" for line in (first, *self.done.values())), encoding="utf-8")

    def add(self, run: str, parameters: Mapping[str, Any], files: Iterable[Path], summary: Mapping[str, Any]) -> None:
        """Note that `run` is whole."""
        line = {
            "run": run, "parameters": dict(parameters), "files": [self._name(file) for file in files],
            "summary": dict(summary),
        }  # fmt: skip
        self.done[run] = line
        with self._written(), self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def _name(self, file: Path) -> str:
        return os.path.relpath(file, self.path.parent).replace(os.sep, "/")

    def _lines(self) -> Iterator[dict[str, Any]]:
        try:
            text = self.path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError):
            return
        for line in text.splitlines():
            try:
                found = json.loads(line)
            except (ValueError, RecursionError):
                return
            if not isinstance(found, dict):
                return
            yield found

    @contextmanager
    def _written(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputError(
                f"{self.path}: cannot be written ({error.strerror or error}); check permissions and free space, then go on "
                "with --resume"
            ) from error


def _differs(what: str, before: Any) -> str:
    if before in (None, False, ()):
        return f"without --{what.replace('_', '-')}"
    return f"with --{what.replace('_', '-')}{'' if before is True else f' {before}'}"


def stored_model(folder: Path) -> str:
    """SHA-256 of what is stored of a model: of its description, which holds those of its files."""
    return hashlib.sha256((folder / "model.json").read_bytes()).hexdigest()
