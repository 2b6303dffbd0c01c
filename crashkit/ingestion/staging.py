"""The folder `OUTPUT.partial`, where runs wait until all are there; what lies in it survives a killed process.

    lock            held while an ingest works here
    journal         one JSON line for every finished run and every hashed file, written last
    runs/KEY/       the arrays of one run, as a Zarr store of its own
    whole.zarr|nc   the dataset while it is put together

A run's key is made from everything its arrays depend on (files with size and date, options, times, mesh), so a later
start takes what still fits, whatever else has changed, and reads the rest again.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import TracebackType
from typing import Any

from crashkit.errors import OutputError


@dataclass(frozen=True)
class StagedRun:
    """One run whose arrays are in the staging folder.

    Attributes
    ----------
    digests
        Of its arrays, by name (`data_schema.checksum.array_digest`).
    error
        Estimated error of the change to the common time, m.
    displacement, speed
        The largest of any living node, m and m/s.
    quality
        What is known of how good the run is, as `crashkit.quality.Quality` has it.
    """

    key: str
    name: str
    digests: Mapping[str, str]
    error: float
    displacement: float
    speed: float
    quality: Mapping[str, Any]


class Staging:
    """The staging folder of `output`, locked for this process while it is open (`with Staging(output) as staging`).

    Raises OutputError if another ingest holds it, or if it cannot be written.
    """

    def __init__(self, output: Path) -> None:
        self.output = output
        self.folder = output.absolute().with_name(output.name + ".partial")
        self.whole = self.folder / f"whole{output.suffix}"
        self._journal = self.folder / "journal"
        self._lock: int | None = None
        self.runs: dict[str, StagedRun] = {}
        self.hashes: dict[tuple[str, int, int], str] = {}

    def __enter__(self) -> Staging:
        try:
            self.folder.mkdir(exist_ok=True)
            self._lock = os.open(self.folder / "lock", os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise OutputError(
                f"{self.folder}: cannot be written ({error.strerror}); it is needed beside the output while runs are read"
            ) from error
        if not _locked(self._lock) or not self._is_ours(self._lock):
            os.close(self._lock)
            raise OutputError(f"{self.output}: another ingest is writing it; wait for it to end")
        for line in self._lines():
            if "file" in line:
                self.hashes[(line["file"], line["bytes"], line["changed"])] = line["sha256"]
            elif set(line) == {f.name for f in fields(StagedRun)}:  # one of another version is read again
                self.runs[line["key"]] = StagedRun(**line)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self.runs and not any(self.folder.glob("replaced*")):
            self.discard()  # nothing in it is worth keeping
        if self._lock is not None:
            os.close(self._lock)

    def _is_ours(self, handle: int) -> bool:
        """Whether the locked file is still the one in the folder: its last owner may just have deleted that."""
        try:
            return (self.folder / "lock").stat().st_ino == os.fstat(handle).st_ino
        except FileNotFoundError:
            return False

    def _lines(self) -> list[dict[str, Any]]:
        """Lines of the journal; one that was cut off is ignored."""
        if not self._journal.exists():
            return []
        out = []
        for line in self._journal.read_text(encoding="utf-8").splitlines():
            try:
                out.append(json.loads(line))
            except ValueError:
                continue
        return out

    def place(self, key: str) -> Path:
        """Where the arrays of the run `key` lie once they are finished."""
        return self.folder / "runs" / key

    def finish(self, run: StagedRun) -> None:
        """Note that a run is finished."""
        self._note(asdict(run))
        self.runs[run.key] = run

    def _note(self, record: Mapping[str, Any]) -> None:
        # A line that was cut off by a kill must not swallow this one: begin a new line.
        with self._journal.open("ab") as stream:
            stream.write(b"\n" + json.dumps(dict(record)).encode() + b"\n")
            stream.flush()
            os.fsync(stream.fileno())

    def hash_of(self, file: Path) -> tuple[int, str]:
        """Bytes and SHA-256 of a source file; each file is read once, over all starts of this ingest."""
        status = file.stat()
        known = (str(file.absolute()), status.st_size, status.st_mtime_ns)
        if known not in self.hashes:
            self.hashes[known] = file_sha256(file)
            self._note({"file": known[0], "bytes": known[1], "changed": known[2], "sha256": self.hashes[known]})
        return status.st_size, self.hashes[known]

    def discard_unfinished(self) -> None:
        """Delete what a killed process left: runs without a line in the journal, half a dataset."""
        for path in (self.folder / "runs").glob("*"):
            if path.name not in self.runs:
                shutil.rmtree(path, ignore_errors=True)
        for path in self.folder.glob("whole*"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    def discard(self) -> None:
        """Delete the folder: everything in it is in the dataset."""
        shutil.rmtree(self.folder, ignore_errors=True)


class BackgroundHashes:
    """Hashes source files in a thread beside the reading; `result` waits for one."""

    def __init__(self, staging: Staging) -> None:
        self._staging = staging
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="sha256")
        self._pending: dict[Path, Future[tuple[int, str]]] = {}

    def ask(self, file: Path) -> None:
        if file not in self._pending:
            self._pending[file] = self._pool.submit(self._staging.hash_of, file)

    def result(self, file: Path) -> tuple[int, str]:
        """Bytes and SHA-256 of `file`."""
        self.ask(file)
        return self._pending[file].result()

    def close(self) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)


def file_sha256(file: Path) -> str:
    """SHA-256 of a file's content."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def key_of(parts: Mapping[str, Any]) -> str:
    """A short name for what a run's arrays depend on."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()[:24]


def _locked(handle: int) -> bool:
    """Take the lock, which the system lets go when the process ends however it ends; True where there are no locks."""
    try:
        import fcntl
    except ImportError:
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
