"""Jobs in this process or on Dask workers: the one way to several processes.

Nothing depends on who does the work: a job gets an item and what all jobs share, and gives a result.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from multiprocessing import active_children, resource_tracker
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from crashkit.errors import CrashkitError
from crashkit.extras import need
from data_schema.memory import one_heap

Item = TypeVar("Item")
Shared = TypeVar("Shared")
Result = TypeVar("Result")


def as_finished(
    job: Callable[[Item, Shared], Result],
    items: Sequence[Item],
    shared: Shared,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    label: Callable[[Item], str] = str,
    patience: float = 30.0,
) -> Iterator[tuple[int, Result]]:
    """Do one job an item and give (place of the item, result) as they finish.

    Parameters
    ----------
    job
        A function of a module, so that it can be sent to other processes.
    items
        One a job.
    shared
        What every job needs besides. It is sent to a worker once, and all jobs there get the same object.
    workers
        1 works here; more start as many processes, with one thread each, which end with the last job.
    scheduler
        Address of a Dask scheduler whose workers do it instead; they must see the same files.
    label
        What an item is called in an error.
    patience
        Seconds after which a scheduler that does not answer is given up.

    Raises
    ------
    CrashkitError
        For fewer than one worker, a scheduler out of reach, or a worker that died; MissingExtraError without Dask.
        What a job raises is passed on.
    """
    if workers < 1:
        raise CrashkitError(f"{workers} workers were asked for; expected at least 1")
    if scheduler is None and (workers == 1 or len(items) < 2):
        return ((place, job(item, shared)) for place, item in enumerate(items))
    need("working in several processes", "distributed")
    return _on_workers(job, items, shared, min(workers, len(items)), scheduler, label, patience)


def _on_workers(
    job: Callable[[Item, Shared], Result],
    items: Sequence[Item],
    shared: Shared,
    workers: int,
    scheduler: str | None,
    label: Callable[[Item], str],
    patience: float,
) -> Iterator[tuple[int, Result]]:
    from concurrent.futures import CancelledError

    from distributed import as_completed
    from distributed.comm.core import CommClosedError
    from distributed.scheduler import KilledWorker

    with _client(workers, scheduler, patience) as client:
        (there,) = client.scatter([shared], broadcast=True, hash=False)
        places = {client.submit(job, item, there, pure=False, retries=0): k for k, item in enumerate(items)}
        for future in as_completed(list(places), loop=client.loop):
            place = places[future]
            try:
                result = future.result()
            except (KilledWorker, CommClosedError, CancelledError) as error:
                raise CrashkitError(
                    f"{label(items[place])}: its worker died ({error}); see that it has memory enough, or use fewer workers"
                ) from error
            future.release()
            yield place, result


@contextlib.contextmanager
def _later_interrupted() -> Iterator[None]:
    """Ctrl-C waits until the block ends, and never reaches processes that begin in it: they end with this one.

    A terminal sends it to all of them at once. A process that begins while it is held back holds it back, too.
    """
    if os.name != "posix" or threading.current_thread() is not threading.main_thread():
        yield
        return
    resource_tracker.ensure_running()  # its own start lets Ctrl-C through again
    pressed: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, _: pressed.append(number))
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        signal.signal(signal.SIGINT, handler)
    if pressed:
        raise KeyboardInterrupt


def _ends_at_once(processes: Sequence[BaseProcess]) -> Callable[..., None]:
    """At the end of a block that was interrupted, `processes` are not waited for: a job may take minutes."""

    def end(kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and issubclass(kind, KeyboardInterrupt):
            for process in processes:
                process.kill()
            for process in processes:
                process.join(1.0)

    return end


@contextlib.contextmanager
def _client(workers: int, scheduler: str | None, patience: float) -> Iterator[Any]:
    """A client of the scheduler at that address, or of processes of our own."""
    import dask
    from distributed import Client, LocalCluster

    with contextlib.ExitStack() as stack:
        if scheduler is None:
            scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="crashkit-", ignore_cleanup_errors=True))
            stack.enter_context(dask.config.set({"temporary-directory": scratch}))  # the scheduler's, too
            with _later_interrupted():
                before = active_children()
                cluster = LocalCluster(
                    n_workers=workers, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0",
                    memory_limit=0, silence_logs=logging.CRITICAL,
                )  # fmt: skip
                address: Any = stack.enter_context(cluster)
                # Of lines that break as workers go it tells at times once the cluster, and its silence, have ended.
                logging.getLogger("distributed.batched").setLevel(logging.CRITICAL)
                stack.push(_ends_at_once([child for child in active_children() if child not in before]))
        else:
            address = scheduler
        try:
            # Nobody's default: what this process reads and writes besides asks nothing of these workers, also once they are gone.
            client = stack.enter_context(Client(address, timeout=patience, set_as_default=False))
        except (OSError, ValueError) as error:
            if scheduler is None:
                raise CrashkitError(f"the processes on this machine do not answer ({error}); use one worker") from error
            raise CrashkitError(
                f"{scheduler}: no Dask scheduler answers there ({error}); start one with `dask scheduler`, or take workers of "
                "this machine"
            ) from error
        # A worker in the user's folder must know crashkit before it meets a class of our other packages.
        client.run(importlib.import_module, "crashkit")
        if scheduler is None:
            client.run(one_heap)
        yield client
