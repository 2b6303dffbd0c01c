"""A campaign in its folder: add runs, compute what waits, and hand what is done to ingest.

FOLDER/campaign.sqlite   the table of runs, the one thing that must not be lost
FOLDER/runs/run_000/     deck, log and results of a run
FOLDER/runs.csv          parameters of the runs that are done, as ingest reads them
FOLDER/crash.zarr        the dataset; FOLDER/model/ the surrogate; FOLDER/status.html
"""

from __future__ import annotations

import contextlib
import csv
import fcntl
import hashlib
import json
import shutil
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crashkit import quality
from crashkit.campaign import job
from crashkit.campaign.box import CampaignError
from crashkit.campaign.deck import arguments, check_template, program_of, template_files, write_deck
from crashkit.campaign.executors import Executor, Local, Slurm
from crashkit.campaign.plan import Plan, read_plan
from crashkit.campaign.table import RunRow, Table
from data_schema.progress import Progress, silent
from data_schema.replace import beside

_STARTING = 10.0  # seconds in which a job that was started has its lock
_POLL = 0.2  # seconds between two looks at the jobs
_DIGITS = 7  # of a parameter, so that deck, command and table say the same number
_LOCK = ".lock"


class Campaign:
    """The campaign of `plan_file` in `folder`; a context manager, since one process at a time may run it.

    Raises CampaignError where another campaign or another process has the folder, or what the file names is not there.
    """

    def __init__(
        self, plan_file: str | Path, folder: str | Path | None = None, executor: Executor | None = None
    ) -> None:
        self.file = Path(plan_file)
        self.plan: Plan = read_plan(self.file)
        self.home = self.file.resolve().parent
        self.folder = Path(folder) if folder is not None else self.home / self.file.stem
        plan = self.plan
        self._templates = template_files(self.home, plan.template)
        self._files = template_files(self.home, plan.files)
        for template in self._templates:
            check_template(template, plan.names)
        trial = self._values(dict(zip(plan.names, plan.low.tolist(), strict=True)), "run_000")
        for command in filter(None, (plan.prepare, plan.command)):
            arguments(command, trial)
            program_of(command, self.home)
        try:
            (self.folder / "runs").mkdir(parents=True, exist_ok=True)
            self._lock = (self.folder / _LOCK).open("w")
        except OSError as error:
            raise CampaignError(f"{self.folder}: no campaign can be kept there ({error.strerror or error})") from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._lock.close()
            raise CampaignError(
                f"{self.folder}: another process runs a campaign there; wait for it, or stop it"
            ) from error
        with contextlib.ExitStack() as undo:
            undo.callback(self._lock.close)
            self.table = Table(self.folder)
            undo.callback(self.table.close)
            self._claim()
            self.executor = executor or (
                Slurm(self.folder, plan.slurm, plan.timeout) if plan.executor == "slurm" else Local()
            )
            undo.pop_all()

    def __enter__(self) -> Campaign:
        return self

    def __exit__(self, *_: object) -> None:
        self.table.close()
        self._lock.close()

    @property
    def dataset(self) -> Path:
        return self.folder / "crash.zarr"

    def points(self, *states: str) -> NDArray[np.float64]:
        """Parameters (run, parameter) of the runs in `states` (all without), in the units of the box."""
        rows = [[r.parameters[n] for n in self.plan.names] for r in self.table.runs(*states)]
        return np.array(rows, np.float64).reshape(-1, len(self.plan.names))

    def add(self, points: NDArray[np.float64], origin: str) -> list[str]:
        """Append runs at `points` (run, parameter); what is there already is left out. Returns the names."""
        known = {tuple(p) for p in self.points().tolist()}
        rows = [[float(f"{v:.{_DIGITS}g}") for v in point] for point in np.atleast_2d(points)]
        new = [row for k, row in enumerate(rows) if tuple(row) not in known and row not in rows[:k]]
        return self.table.add([dict(zip(self.plan.names, row, strict=True)) for row in new], origin)

    def compute(self, report: Progress | None = None) -> list[RunRow]:
        """Compute all waiting runs, a limited number at a time, and return the runs that were decided on the way.

        Runs that a killed campaign left running are picked up. Ctrl-C stops the jobs; their runs wait again.
        """
        tell = report or silent
        before = {r.name for r in self.table.runs("done", "failed", "refused")}
        try:
            while True:
                running = self._settle()
                waiting = self.table.runs("waiting")
                for run in waiting[: max(0, self.plan.at_a_time - len(running))]:
                    self._start(run)
                running = self.table.runs("running")
                decided = [r for r in self.table.runs("done", "failed", "refused") if r.name not in before]
                left = self.table.runs("waiting")
                tell("runs", len(decided), len(decided) + len(running) + len(left), ", ".join(r.name for r in running))
                if not running and not left:
                    return decided
                time.sleep(_POLL)
        except KeyboardInterrupt:
            for run in self.table.runs("running"):
                self.executor.stop(run.handle)
                if job.how_it_ended(self._place(run)) is None:
                    self.table.change(run.name, "waiting", reason="interrupted", handle={})
            raise

    def retry(self) -> list[str]:
        """Let failed runs wait again; returns their names."""
        names = [r.name for r in self.table.runs("failed")]
        for name in names:
            self.table.change(name, "waiting", reason="", attempts=0)
        return names

    def results(self) -> list[Path]:
        """What ingest reads of the runs that are done."""
        return [self._result(r) for r in self.table.runs("done")]

    def write_parameters(self) -> Path:
        """Write runs.csv: one row per run that is done, units in the heads."""
        path = self.folder / "runs.csv"
        plan = self.plan
        try:
            with beside(path) as new, new.open("w", newline="", encoding="utf-8") as file:
                rows = csv.writer(file)
                rows.writerow(
                    [
                        "run",
                        *(n if u in ("", "1") else f"{n} ({u})" for n, u in zip(plan.names, plan.units, strict=True)),
                    ]
                )
                for run in self.table.runs("done"):
                    rows.writerow([run.name, *(repr(run.parameters[n]) for n in plan.names)])
        except OSError as error:
            raise CampaignError(
                f"{path}: cannot be written ({error.strerror or error}); free space, then start again"
            ) from error
        return path

    # ------------------------------------------------------------------------------------------------- one run

    def _start(self, run: RunRow) -> None:
        """Make the run's folder and deck, and start its job."""
        place = self._place(run)
        try:
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir(parents=True)
            values = self._values(run.parameters, run.name)
            write_deck(place, self._templates, self._files, run.parameters)
            commands = [
                [program_of(command, self.home), *arguments(command, values)[1:]]
                for command in filter(None, (self.plan.prepare, self.plan.command))
            ]
            job.give_order(place, commands, self.plan.timeout)
            # Noted before it is started: killed in between, the next start finds the job by its lock and does not start another.
            self.table.change(run.name, "running", handle={}, attempts=run.attempts + 1, started=time.time(), reason="")
            handle = self.executor.start(place)
        except OSError as error:
            self.table.change(run.name, "waiting", handle={}, attempts=run.attempts)
            raise CampaignError(
                f"{place}: run {run.name} cannot be started ({error.strerror or error}); free space, then start the campaign again"
            ) from error
        self.table.change(run.name, "running", handle=handle)

    def _settle(self) -> list[RunRow]:
        """Decide on running runs that have ended; returns those that go on."""
        going = []
        for run in self.table.runs("running"):
            ended = job.how_it_ended(self._place(run))
            if ended is None and (self.executor.alive(run.handle) or job.is_running(self._place(run))):
                going.append(run)
                continue
            if ended is None and not run.handle:  # the campaign was killed while it started this run
                if time.time() - (run.started or 0.0) < _STARTING:
                    going.append(run)
                else:
                    self.table.change(run.name, "waiting", attempts=max(0, run.attempts - 1))
                continue
            ended = ended or job.how_it_ended(self._place(run))  # it may have ended between the two looks
            state, reason, found = self._judged(run, ended)
            if state == "failed" and run.attempts <= self.plan.retries:
                state = "waiting"
            seconds = None if ended is None else ended.seconds
            self.table.change(
                run.name, state, reason=reason, seconds=seconds, ended=time.time(), quality=found, handle={}
            )
        return going

    def _judged(self, run: RunRow, ended: job.Ended | None) -> tuple[str, str, dict[str, float]]:
        """State, reason and quality of a run that is over."""
        place = self._place(run)
        if ended is None:
            return "failed", "its process is gone and left no result; the machine or somebody ended it", {}
        if ended.reason or ended.code:
            log = job.last_lines(place)
            return "failed", (ended.reason or f"ended with {ended.code}") + (f": {log}" if log else ""), {}
        verdict = self._quality(run)
        found = verdict.values
        finished = self.plan.finished
        if finished is not None and not quality.says(place, finished.file, finished.text):
            return (
                "failed",
                f"ended with 0, but {finished.text!r} is not in {finished.file}: {job.last_lines(place)}",
                found,
            )
        if finished is None and verdict.ended is False:
            return "failed", f"ended with 0, but not normally: {job.last_lines(place)}", found
        if not self._wrote(run):
            return (
                "failed",
                f"ended with 0, but wrote no results ({self.plan.results or 'any file'}): {job.last_lines(place)}",
                found,
            )
        wrong = replace(verdict, ended=None).beyond(self.plan.quality.model_dump())
        return ("refused", wrong[0], found) if wrong else ("done", "", found)

    def _quality(self, run: RunRow) -> quality.Quality:
        """What the solver printed, and what its time histories know better where they can be read."""
        from crashkit.errors import ReadError
        from crashkit.readers import reader_for

        printed = quality.look(self._place(run))
        result = self._result(run)
        try:
            with closing(next(iter(reader_for(result).runs(result)))) as read:
                return quality.measured(read.history(), printed)
        except (ReadError, StopIteration):
            return printed

    def _wrote(self, run: RunRow) -> bool:
        """Whether the solver left something that ingest can read."""
        place = self._place(run)
        if self.plan.results:
            return any(p.exists() and (p.is_dir() or p.stat().st_size) for p in place.glob(self.plan.results))
        from crashkit.errors import ReadError
        from crashkit.readers import reader_for

        try:
            reader_for(place)
        except ReadError:
            return False
        return True

    def _result(self, run: RunRow) -> Path:
        place = self._place(run)
        found = sorted(place.glob(self.plan.results)) if self.plan.results else []
        return found[0] if len(found) == 1 and found[0].is_dir() else place

    def _place(self, run: RunRow) -> Path:
        return self.folder.resolve() / "runs" / run.name

    def _values(self, parameters: Mapping[str, float], name: str) -> dict[str, Any]:
        return {**parameters, "study": str(self.home), "name": name, "run": str(self.folder.resolve() / "runs" / name)}

    def _claim(self) -> None:
        """Note whose folder this is: what decides on a run's result may not change under runs that are there."""
        plan = self.plan
        deciding: dict[str, Any] = {
            "names": plan.names, "units": plan.units, "command": plan.command, "prepare": plan.prepare,
            "template": {p.name: _hash(p) for p in self._templates}, "files": {p.name: _hash(p) for p in self._files},
        }  # fmt: skip
        text = json.dumps(deciding, sort_keys=True)
        known = self.table.about("study")
        if known is not None and known != text and self.table.runs():
            old = json.loads(known)
            changed = next(k for k in deciding if json.dumps(old.get(k)) != json.dumps(json.loads(text)[k]))
            raise CampaignError(
                f"{self.folder}: its {len(self.table.runs())} runs were computed with another {changed}; "
                f"choose a new folder with -o, or put the {changed} back"
            )
        self.table.about("study", text)


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
