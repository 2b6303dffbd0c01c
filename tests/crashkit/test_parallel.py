"""Jobs over workers: what comes back does not depend on who did the work."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from crashkit.errors import CrashkitError
from crashkit.extras import MissingExtraError
from crashkit.parallel import as_finished


def times(item: int, factor: int) -> int:
    return item * factor


def die(item: int, shared: None) -> None:
    os._exit(1)


def fail(item: int, shared: None) -> None:
    raise ZeroDivisionError(f"item {item}")


@dataclass
class Counter:
    """Counts the jobs that saw this very object."""

    seen: list[int] = field(default_factory=list)

    def __getstate__(self):
        return {"seen": []}


def count(item: int, counter: Counter) -> int:
    counter.seen.append(item)
    return len(counter.seen)


def test_here_results_come_one_after_the_other():
    assert list(as_finished(times, [5, 3, 4], 2)) == [(0, 10), (1, 6), (2, 8)]


def test_here_a_job_is_done_when_its_result_is_asked_for():
    counter = Counter()
    results = as_finished(count, [7, 8], counter)
    next(results)
    assert counter.seen == [7]


def test_workers_give_the_same():
    assert dict(as_finished(times, [5, 3, 4], 2, workers=2)) == {0: 10, 1: 6, 2: 8}


def test_all_jobs_of_a_worker_share_one_object():
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0") as cluster:
        found = dict(as_finished(count, [7, 8, 9], Counter(), scheduler=cluster.scheduler_address))
    assert sorted(found.values()) == [1, 2, 3]


def test_what_a_job_raises_is_passed_on():
    with pytest.raises(ZeroDivisionError, match=r"item [23]"):
        list(as_finished(fail, [2, 3], None, workers=2))


def test_a_worker_that_dies_is_named_by_its_item():
    with pytest.raises(CrashkitError, match=r"run [12]: its worker died"):
        list(as_finished(die, [1, 2], None, workers=2, label=lambda item: f"run {item}"))


def test_a_scheduler_out_of_reach_is_an_error_that_says_what_to_do():
    with pytest.raises(CrashkitError, match="no Dask scheduler answers there"):
        list(as_finished(times, [1, 2], 2, scheduler="tcp://127.0.0.1:1", patience=0.5))


def test_no_worker_is_an_error():
    with pytest.raises(CrashkitError, match="0 workers"):
        as_finished(times, [1], 2, workers=0)


def test_without_dask_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"crashkit\[distributed\]"):
        as_finished(times, [1, 2], 2, workers=2)


def note_and_sleep(item: int, folder: str) -> None:
    Path(folder, str(item)).touch()
    time.sleep(60)


@pytest.mark.skipif(os.name != "posix", reason="a group of processes gets the signal of Ctrl-C")
def test_ctrl_c_ends_workers_at_once_and_without_a_word_of_theirs(tmp_path):
    work = (
        "from crashkit.parallel import as_finished\nfrom test_parallel import note_and_sleep\n"
        "if __name__ == '__main__':\n"
        "    try:\n"
        f"        list(as_finished(note_and_sleep, [1, 2], {str(tmp_path)!r}, workers=2))\n"
        "    except KeyboardInterrupt:\n"
        "        print('interrupted')\n"
    )
    (tmp_path / "work.py").write_text(work)
    paths = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
    told = subprocess.Popen(
        [sys.executable, str(tmp_path / "work.py")], env={**os.environ, "PYTHONPATH": paths, "TMPDIR": str(tmp_path)},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        while not (tmp_path / "2").exists():
            assert told.poll() is None
            time.sleep(0.1)
        os.killpg(told.pid, signal.SIGINT)
        assert told.communicate(timeout=40)[0] == "interrupted\n"
    finally:
        if told.poll() is None:
            os.killpg(told.pid, signal.SIGKILL)


def test_nothing_stays_in_the_temporary_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.chdir(tmp_path)
    assert dict(as_finished(times, [1, 2], 2, workers=2)) == {0: 2, 1: 4}
    assert not list(tmp_path.iterdir())
