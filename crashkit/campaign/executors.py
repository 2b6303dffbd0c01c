"""Where runs are computed: processes of this machine, Slurm through submitit, or a Dask scheduler.

Each starts `python -m crashkit.campaign.job FOLDER` and says later whether that job is still alive. How a job ended is
read from its folder, never from the executor, so a campaign that was killed can pick up what went on without it.
"""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path
from typing import Any, Protocol, Self

from crashkit.campaign import job
from crashkit.campaign.box import CampaignError


class Executor(Protocol):
    """`start` gives a handle of plain texts and numbers, from which `alive` and `stop` work in a later process, too."""

    def start(self, folder: Path) -> dict[str, Any]: ...

    def alive(self, handle: dict[str, Any]) -> bool: ...

    def stop(self, handle: dict[str, Any]) -> None: ...


class Local:
    """Processes of this machine. A process is known by its number and the moment it began, since numbers come again."""

    def __init__(self) -> None:
        self._children: dict[int, subprocess.Popen[bytes]] = {}

    def start(self, folder: Path) -> dict[str, Any]:
        child = subprocess.Popen(
            job.start_command(folder), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL, start_new_session=True, cwd=folder,
        )  # fmt: skip
        self._children[child.pid] = child
        return {"pid": child.pid, "began": _began(child.pid)}

    def alive(self, handle: dict[str, Any]) -> bool:
        pid = int(handle.get("pid", 0))
        if pid in self._children:
            return self._children[pid].poll() is None
        began = _began(pid)
        return began is not None and began == handle.get("began")

    def stop(self, handle: dict[str, Any]) -> None:
        if not self.alive(handle):
            return
        pid = int(handle["pid"])
        try:
            os.kill(pid, signal.SIGTERM)  # the job ends the solver, which has a session of its own
        except ProcessLookupError:
            return
        if pid in self._children:
            try:
                self._children[pid].wait(timeout=10)
            except subprocess.TimeoutExpired:
                self._children[pid].kill()


def _began(pid: int) -> float | None:
    """When process `pid` began; None where it is no more."""
    import psutil

    try:
        process = psutil.Process(pid)
        return None if process.status() == psutil.STATUS_ZOMBIE else float(process.create_time())
    except psutil.Error:
        return None


class Slurm:
    """Jobs of a Slurm cluster through submitit; `options` go to its executor (slurm_partition, cpus_per_task, ...)."""

    def __init__(self, folder: Path, options: dict[str, Any], timeout: float, cluster: str | None = None) -> None:
        try:
            import submitit
        except ImportError as error:
            raise CampaignError(
                "executor slurm needs the package submitit; pip install 'crashkit[campaign]'"
            ) from error
        self._submitit = submitit
        self._executor = submitit.AutoExecutor(folder=folder / "slurm", cluster=cluster)
        self._executor.update_parameters(timeout_min=max(1, round(timeout / 60 + 1)), **options)
        self._jobs: dict[str, Any] = {}

    def start(self, folder: Path) -> dict[str, Any]:
        command = self._submitit.helpers.CommandFunction(job.start_command(folder))
        submitted = self._executor.submit(command)
        self._jobs[submitted.job_id] = submitted
        return {"job": submitted.job_id}

    def alive(self, handle: dict[str, Any]) -> bool:
        found = self._job(handle)
        return found is not None and not found.done()

    def stop(self, handle: dict[str, Any]) -> None:
        found = self._job(handle)
        if found is not None:
            found.cancel()

    def _job(self, handle: dict[str, Any]) -> Any:
        number = str(handle.get("job", ""))
        if number and number not in self._jobs:
            self._jobs[number] = self._executor.job_class(folder=self._executor.folder, job_id=number)
        return self._jobs.get(number)


class Dask:
    """Workers of a Dask scheduler that see the same files; `with Dask(address) as executor` lets the scheduler go again."""

    def __init__(self, scheduler: str) -> None:
        try:
            from distributed import Client
        except ImportError as error:
            raise CampaignError("a Dask scheduler needs dask; pip install 'crashkit[distributed]'") from error
        try:
            # Not everybody's default: what else runs in this process has nothing to ask of that scheduler.
            self._client = Client(scheduler, timeout=5, set_as_default=False)
        except OSError as error:
            raise CampaignError(f"{scheduler}: no Dask scheduler answers there ({error})") from error
        self._futures: dict[str, Any] = {}

    def start(self, folder: Path) -> dict[str, Any]:
        future = self._client.submit(_call, job.start_command(folder), pure=False)
        self._futures[str(future.key)] = future
        return {"key": str(future.key)}

    def alive(self, handle: dict[str, Any]) -> bool:
        future = self._futures.get(str(handle.get("key", "")))
        return future is not None and not future.done()

    def stop(self, handle: dict[str, Any]) -> None:
        future = self._futures.get(str(handle.get("key", "")))
        if future is not None:
            future.cancel()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the connection; jobs that run go on until the scheduler notices that nobody waits for them."""
        self._client.close()


def _call(command: list[str]) -> int:
    return subprocess.run(command, check=False).returncode
