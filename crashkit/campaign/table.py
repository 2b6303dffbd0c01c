"""The runs of a campaign in one SQLite table: each change of state is one transaction, so a kill loses none.

States: waiting, running, done, failed (the solver or its command), refused (ended well, but its quality is beyond a limit).
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from crashkit.campaign.box import CampaignError

STATES = ("waiting", "running", "done", "failed", "refused")
FILE = "campaign.sqlite"

_TABLES = """
CREATE TABLE IF NOT EXISTS run (
    number INTEGER PRIMARY KEY, name TEXT UNIQUE NOT NULL, parameters TEXT NOT NULL, origin TEXT NOT NULL,
    state TEXT NOT NULL, reason TEXT NOT NULL DEFAULT '', attempts INTEGER NOT NULL DEFAULT 0,
    handle TEXT NOT NULL DEFAULT '', seconds REAL, quality TEXT NOT NULL DEFAULT '{}', started REAL, ended REAL
);
CREATE TABLE IF NOT EXISTS round (
    number INTEGER PRIMARY KEY, runs INTEGER NOT NULL, about TEXT NOT NULL, at REAL NOT NULL
);
CREATE TABLE IF NOT EXISTS about (key TEXT PRIMARY KEY, value TEXT NOT NULL);
"""


@dataclass(frozen=True)
class RunRow:
    """One row: parameters by name in the units of the box, its state, and how it went."""

    number: int
    name: str
    parameters: dict[str, float]
    origin: str
    state: str
    reason: str = ""
    attempts: int = 0
    handle: dict[str, Any] = field(default_factory=dict)
    seconds: float | None = None
    quality: dict[str, float] = field(default_factory=dict)
    started: float | None = None
    ended: float | None = None


class Table:
    """The runs in `folder`/campaign.sqlite."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / FILE
        try:
            self._db = sqlite3.connect(self.path, isolation_level=None, timeout=30)
            self._db.row_factory = sqlite3.Row
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=FULL")
            self._db.executescript(_TABLES)
        except sqlite3.Error as error:
            raise CampaignError(
                f"{self.path}: cannot be used as the table of runs ({error}); move it away, or free space"
            ) from error

    def close(self) -> None:
        self._db.close()

    def runs(self, *states: str) -> list[RunRow]:
        """All runs by number, or those in one of `states`."""
        rows = self._db.execute("SELECT * FROM run ORDER BY number").fetchall()
        out = [
            RunRow(**{**dict(row), **{k: json.loads(row[k] or "{}") for k in ("parameters", "handle", "quality")}})
            for row in rows
        ]
        return [r for r in out if not states or r.state in states]

    def add(self, points: Sequence[Mapping[str, float]], origin: str) -> list[str]:
        """Append waiting runs; returns their names."""
        names = []
        with self._transaction():
            first = self._db.execute("SELECT COALESCE(MAX(number) + 1, 0) FROM run").fetchone()[0]
            for number, point in enumerate(points, first):
                names.append(f"run_{number:03d}")
                self._db.execute(
                    "INSERT INTO run (number, name, parameters, origin, state) VALUES (?, ?, ?, ?, 'waiting')",
                    (number, names[-1], json.dumps(dict(point)), origin),
                )
        return names

    def change(self, name: str, state: str, **values: Any) -> None:
        """Put run `name` into `state`, with further columns."""
        texts = {k: json.dumps(v) if isinstance(v, dict) else v for k, v in values.items()}
        columns = ", ".join(f"{k} = ?" for k in ("state", *texts))
        with self._transaction():
            self._db.execute(f"UPDATE run SET {columns} WHERE name = ?", (state, *texts.values(), name))

    def note_round(self, about: Mapping[str, Any], runs: int) -> None:
        with self._transaction():
            number = self._db.execute("SELECT COALESCE(MAX(number) + 1, 0) FROM round").fetchone()[0]
            self._db.execute(
                "INSERT INTO round VALUES (?, ?, ?, ?)", (number, runs, json.dumps(dict(about)), time.time())
            )

    def rounds(self) -> list[dict[str, Any]]:
        """What each round said: runs, error with its interval, gain, seconds."""
        rows = self._db.execute("SELECT * FROM round ORDER BY number").fetchall()
        return [{"round": r["number"], "runs": r["runs"], "at": r["at"], **json.loads(r["about"])} for r in rows]

    def about(self, key: str, value: str | None = None) -> str | None:
        """The note called `key`; with `value`, it is written."""
        if value is not None:
            with self._transaction():
                self._db.execute("INSERT OR REPLACE INTO about VALUES (?, ?)", (key, value))
            return value
        row = self._db.execute("SELECT value FROM about WHERE key = ?", (key,)).fetchone()
        return None if row is None else str(row[0])

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        try:
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
            except BaseException:
                self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")
        except sqlite3.Error as error:
            raise CampaignError(
                f"{self.path}: cannot be written ({error}); free space, then start the campaign again"
            ) from error
