"""One job a run, here or on Dask workers, with the results in the order of the runs.

A worker holds one run at a time, so memory is bounded by one run a worker; nothing is summed across runs on the
way, so the result does not depend on how many workers there are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from evaluation.errors import EvaluationError

Result = TypeVar("Result")


def over_runs(
    job: Callable[[int], Result],
    runs: Sequence[int],
    workers: int = 1,
    scheduler: str | None = None,
    done: Callable[[int], None] | None = None,
    patience: float = 10.0,
) -> list[Result]:
    """`job(run)` for every one of `runs`, in their order.

    workers    1 computes here; more start as many processes with one thread each
    scheduler  address of a Dask scheduler whose workers do it instead; they must see the same files
    done       called with the run number as each run is finished
    patience   seconds after which a scheduler that does not answer is given up

    Raises what a job raised, at the first that fails; EvaluationError where Dask is wanted and missing or out of
    reach.
    """
    if workers < 1:
        raise EvaluationError(f"{workers} workers asked for; expected at least 1")
    if scheduler is None and (workers == 1 or len(runs) < 2):
        results = []
        for run in runs:
            results.append(job(run))
            if done:
                done(run)
        return results
    return _with_dask(job, runs, min(workers, len(runs)), scheduler, done, patience)


def _with_dask(
    job: Callable[[int], Result],
    runs: Sequence[int],
    workers: int,
    scheduler: str | None,
    done: Callable[[int], None] | None,
    patience: float,
) -> list[Result]:
    try:
        from distributed import Client, LocalCluster, as_completed
    except ImportError as error:
        raise EvaluationError(
            "Dask is not installed, which --workers and --scheduler need; install crashkit[distributed], or leave the "
            "options out"
        ) from error
    import contextlib

    with contextlib.ExitStack() as stack:
        if scheduler is None:
            cluster = stack.enter_context(
                LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address="127.0.0.1:0",
                    memory_limit=0,
                )
            )
            client = stack.enter_context(Client(cluster))
        else:
            try:
                client = stack.enter_context(Client(scheduler, timeout=patience))
            except (OSError, ValueError) as error:
                raise EvaluationError(
                    f"no Dask scheduler answers at {scheduler} ({error}); start one with `dask scheduler`, or use "
                    f"--workers"
                ) from error
        futures = client.map(job, runs, pure=False, retries=0)
        number = {future.key: run for future, run in zip(futures, runs, strict=True)}
        results: dict[int, Result] = {}
        for future in as_completed(futures):
            run = number[future.key]
            results[run] = future.result()
            future.release()
            if done:
                done(run)
    return [results[run] for run in runs]
