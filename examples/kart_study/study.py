"""The paper's experiment on a full campaign of kart crashes: from the solver's results to the report and its tables.

    python examples/kart_study/study.py kart.h5 -o study            about two hours on two cores
    python examples/kart_study/study.py kart.h5 -o study --quick    a quarter of an hour: one seed, an eighth of the epochs

`kart.h5` comes from `unpack.py` beside the campaign. The study can be stopped at any moment and started again with the
same command: what is finished is kept, an interrupted training goes on from its last checkpoint.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from plan import NETWORKS, NODES, RUNS, TABLE, TRAIN, Job, alone, jobs


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


def prepare(source: Path, home: Path) -> Path:
    """The dataset with its hierarchy; made once."""
    data, done = home / "kart.zarr", home / "levels.png"
    if not done.exists():
        crashkit("ingest", source, "-o", data)
        crashkit("coarsen", data, "--nodes", NODES, "--picture", done)
    return data


def train(job: Job, data: Path, home: Path, threads: int) -> float:
    """Seconds one training took; 0 where the model was there already."""
    folder = home / job.folder
    if (folder / "model.json").exists():
        return 0.0
    folder.parent.mkdir(parents=True, exist_ok=True)
    begun = folder.with_name(f".{folder.name}.training").exists()
    start = time.perf_counter()
    crashkit(
        *job.command(data, home), *(["--resume"] if begun else []), log=folder.with_suffix(".log"), threads=threads
    )
    return time.perf_counter() - start


def train_all(todo: list[Job], data: Path, home: Path, at_once: int) -> None:
    """All trainings, `at_once` of them side by side, each on its share of the cores."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    threads = max(1, cores // at_once)
    with ThreadPoolExecutor(at_once) as pool:
        running = {pool.submit(train, job, data, home, threads): job for job in todo}
        try:
            for done, future in enumerate(as_completed(running), 1):
                took = f"{future.result():.0f} s" if future.result() else "done before"
                print(f"[{done}/{len(todo)}] {running[future].folder.name}: {took}", flush=True)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def report(data: Path, home: Path, seeds: int) -> None:
    """One report over every model of the table and all its seeds; made again when models are newer."""
    models = [home / Job(kind, seed).folder for kind in TABLE for seed in range(seeds)]
    written = home / "report" / "report.json"
    if written.exists() and written.stat().st_mtime > max((m / "model.json").stat().st_mtime for m in models):
        return
    crashkit("evaluate", data, *models, "-o", home / "report", "--test", f"{TRAIN}:{RUNS}", "--write-vtu")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, help="the campaign's HDF5 file")
    parser.add_argument("-o", "--output", type=Path, default=Path("study"), help="folder for everything")
    parser.add_argument("--quick", action="store_true", help="one seed and an eighth of the epochs")
    parser.add_argument("--seeds", type=int, default=3, help="trainings of each model (3)")
    parser.add_argument("--jobs", type=int, default=2, help="trainings side by side (2)")
    given = parser.parse_args()
    seeds, home = (1 if given.quick else given.seeds), given.output
    home.mkdir(parents=True, exist_ok=True)
    data = prepare(given.source, home)
    train_all(jobs(seeds, given.quick), data, home, given.jobs)
    train_all([Job(alone(kind)) for kind in TABLE if kind.model in NETWORKS], data, home, at_once=1)
    report(data, home, seeds)
    from results import write_results

    for path in write_results(data, home, seeds, given.quick):
        print(f"  {path}")


if __name__ == "__main__":
    main()
