"""From a plan to trained models, one report and tables: everything in order, and nothing twice."""

from __future__ import annotations

import argparse
import fnmatch
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from study_driver.jobs import Job, Plan


@dataclass(frozen=True)
class Study:
    """A plan on its way.

    Attributes
    ----------
    plan
        What is trained.
    data
        The dataset with its hierarchy.
    home
        Folder of models, report and tables.
    seeds, short
        Trainings of each model of the table; whether they are the short ones for trials.
    """

    plan: Plan
    data: Path
    home: Path
    seeds: int
    short: bool = False

    def jobs(self) -> list[Job]:
        return self.plan.jobs(self.seeds, self.short)

    def compared(self) -> list[Job]:
        """The trainings of the report whose models are there."""
        return [job for job in self.plan.compared(self.seeds, self.short) if self.trained(job)]

    def trained(self, job: Job) -> bool:
        return (self.home / job.folder / "model.json").exists()

    def missing(self) -> list[Job]:
        """What has not been trained."""
        return [job for job in self.jobs() if not self.trained(job)]


Tables = Callable[[Study], Sequence[Path]]


def crashkit(*arguments: str | Path, log: Path | None = None, threads: int = 0) -> None:
    """Run one command of crashkit; its messages go to the terminal, or to `log`."""
    environment = dict(os.environ)
    if threads:
        environment |= {"OMP_NUM_THREADS": str(threads)}
    command = [sys.executable, "-m", "crashkit", *map(str, arguments)]
    with Path(log or os.devnull).open("a", encoding="utf-8") as out:
        to = {} if log is None else {"stdout": out, "stderr": out}
        code = subprocess.run(command, env=environment, check=False, **to).returncode
    if code:
        raise SystemExit(f"crashkit {arguments[0]} ended with code {code}" + (f"; see {log}" if log else ""))


def prepare(plan: Plan, source: Path, home: Path, coarse: Path | None = None) -> Path:
    """The dataset with its hierarchy, and beside it that of coarse runs; made once."""
    data, done = home / f"{plan.name}.zarr", home / "levels.png"
    if not done.exists():
        crashkit("ingest", source, "-o", data)
        crashkit("coarsen", data, "--nodes", plan.nodes, "--test", plan.test, "--picture", done)
    beside = home / f"{plan.coarse}.zarr"
    if coarse is not None and not beside.exists():
        crashkit("ingest", coarse, "-o", beside)
    return data


def train(job: Job, study: Study, threads: int) -> float:
    """Seconds one training took; 0 where the model was there already."""
    if study.trained(job):
        return 0.0
    folder = study.home / job.folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    begun = folder.with_name(f".{folder.name}.training").exists()
    start = time.perf_counter()
    crashkit(
        *study.plan.command(job, study.data, study.home), *(["--resume"] if begun else []),
        log=folder.with_suffix(".log"), threads=threads,
    )  # fmt: skip
    return time.perf_counter() - start


def train_all(todo: Sequence[Job], study: Study, at_once: int) -> None:
    """All trainings, `at_once` of them side by side, each on its share of the cores."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    threads = max(1, cores // at_once)
    with ThreadPoolExecutor(at_once) as pool:
        running = {pool.submit(train, job, study, threads): job for job in todo}
        try:
            for done, future in enumerate(as_completed(running), 1):
                took = f"{future.result():.0f} s" if future.result() else "done before"
                print(f"[{done}/{len(todo)}] {running[future].folder.name}: {took}", flush=True)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def report(study: Study) -> None:
    """One report over every model of the table and all its seeds; made again when models are newer."""
    models = [study.home / job.folder for job in study.compared()]
    written, folder = study.home / "report" / "report.json", study.home / "report"
    if written.exists() and written.stat().st_mtime > max((m / "model.json").stat().st_mtime for m in models):
        return
    again = ["--overwrite"] if folder.exists() else []
    crashkit("evaluate", study.data, *models, "-o", folder, "--test", study.plan.test, "--write-vtu", *again)


def wanted(jobs: Sequence[Job], only: str) -> list[Job]:
    """The jobs whose folder's name fits one of the patterns `only`, such as pod-gpr*,mh-seed-0; all of them without one."""
    patterns = [p.strip() for p in only.split(",") if p.strip()]
    return [j for j in jobs if not patterns or any(fnmatch.fnmatch(j.folder.name, p) for p in patterns)]


def main(plan: Plan, tables: Tables, about: str, arguments: Sequence[str] | None = None) -> None:
    """The command line of a study: `tables` writes what is special to it, `about` is its help."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, help="the campaign's HDF5 file")
    if plan.coarse:
        parser.add_argument(
            "--coarse", type=Path, help="HDF5 file of coarse runs; without it, no model learns from them"
        )
    parser.add_argument("-o", "--output", type=Path, default=Path("study"), help="folder for everything")
    parser.add_argument("--quick", action="store_true", help="one seed and an eighth of the epochs, in OUTPUT/quick")
    parser.add_argument("--seeds", type=int, default=3, help="trainings of each model (3)")
    parser.add_argument("--jobs", type=int, default=2, help="trainings side by side (2)")
    parser.add_argument(
        "--only", default="", help="train no others: names of model folders, such as 'pod-gpr*,mh-seed-0'"
    )
    parser.add_argument("--no-report", action="store_true", help="train only, and leave the test runs alone")
    given = parser.parse_args(arguments)
    given.output.mkdir(parents=True, exist_ok=True)
    coarse = given.coarse if plan.coarse else None
    data = prepare(plan, given.source, given.output, coarse)
    home = given.output / "quick" if given.quick else given.output
    study = Study(plan, data, home, 1 if given.quick else given.seeds, given.quick)
    home.mkdir(exist_ok=True)
    possible = [job for job in study.jobs() if coarse is not None or not job.kind.coarse]
    train_all(wanted(possible, given.only), study, given.jobs)
    if not given.quick:
        train_all(wanted(plan.timed(), given.only), study, at_once=1)
    if given.no_report:
        return
    if not study.compared():
        raise SystemExit(f"{home}: no model of the table is trained yet, so there is nothing to compare")
    report(study)
    for path in tables(study):
        print(f"  {path}")
    for job in study.missing():
        print(f"  not trained: {job.folder.name}")
