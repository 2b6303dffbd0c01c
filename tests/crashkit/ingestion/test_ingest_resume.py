"""Killed, continued, appended to, replaced, shared among workers: the same bytes, and never a broken dataset."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
from memory_runs import MemoryRun, RunsInMemory

from crashkit.dataset import demo_data, open_dataset
from crashkit.errors import DataError, OutputError, ReadError
from crashkit.ingestion import assembly, transfer
from crashkit.ingestion.ingest import ingest
from crashkit.ingestion.staging import Staging
from data_schema import replace as replacing
from data_schema import validate

OUTPUTS = (".zarr", ".nc")


def contents(path: Path) -> dict[str, bytes]:
    """Every file of a dataset, byte by byte."""
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    return {str(f.relative_to(path)): f.read_bytes() for f in files}


def campaign(path: Path, runs: slice, factor: float = 1.0) -> Path:
    """Some runs of the embedded campaign as a campaign of their own."""
    with h5py.File(demo_data()) as source, h5py.File(path, "w") as target:
        for name in ("kart/displacements", "kart/reference_configuration", "parameter"):
            target[name] = source[name][runs]
            for key, value in source[name].attrs.items():
                target[name].attrs[key] = value
        target["kart/displacements"][...] = source["kart/displacements"][runs] * np.float32(factor)
        target["kart/faces"], target["time"] = source["kart/faces"][:], source["time"][:]
    return path


def start(output: Path, *sources: Path) -> subprocess.Popen[str]:
    code = "import sys; from crashkit.ingestion.ingest import ingest; ingest(sys.argv[2:], sys.argv[1], names='{source}-{run}')"
    return subprocess.Popen([sys.executable, "-c", code, str(output), *map(str, sources)])


@pytest.mark.parametrize("suffix", OUTPUTS)
def test_killed_at_random_moments_it_goes_on_to_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    source = campaign(tmp_path / "kart.h5", slice(0, 8))
    expected = tmp_path / f"whole{suffix}"
    ingest(source, expected, names="{source}-{run}")
    output = tmp_path / f"crash{suffix}"
    staging = tmp_path / f"crash{suffix}.partial"
    chance = random.Random(7)
    for _ in range(3):
        process = start(output, source)
        goal = chance.randint(0, 8)  # runs finished when the kill comes, and a little later
        while process.poll() is None and len(list(staging.glob("runs/*"))) < goal:
            time.sleep(0.005)
        time.sleep(chance.uniform(0, 0.05))
        process.send_signal(signal.SIGKILL)
        process.wait()
        if output.exists():
            assert contents(output) == contents(expected)
    process = start(output, source)
    assert process.wait() == 0
    assert contents(output) == contents(expected)
    assert not staging.exists()


class Killed(BaseException):
    """As good as SIGKILL: nothing in the library catches it."""


def kill_at(monkeypatch: pytest.MonkeyPatch, module: object, name: str, after: bool) -> None:
    real = getattr(module, name)

    def die(*args: object, **kwargs: object) -> object:
        if after:
            real(*args, **kwargs)
        raise Killed

    monkeypatch.setattr(module, name, die)


@pytest.mark.usefixtures("quick_disk")
@pytest.mark.parametrize("after", [False, True], ids=["before", "after"])
@pytest.mark.parametrize("step", ["put_in_place", "_exchange", "remove"])
@pytest.mark.parametrize("suffix", OUTPUTS)
def test_appending_leaves_a_whole_dataset_at_every_step(tmp_path: Path, suffix: str, step: str, after: bool) -> None:
    one, other = campaign(tmp_path / "one.h5", slice(0, 3)), campaign(tmp_path / "other.h5", slice(3, 5))
    output, expected = tmp_path / f"crash{suffix}", tmp_path / f"whole{suffix}"
    for target in (output, expected):
        ingest(one, target, names="{source}-{run}")
    before = contents(output)
    ingest(other, expected, names="{source}-{run}")
    with pytest.MonkeyPatch.context() as patch:
        kill_at(patch, assembly if step == "put_in_place" else replacing, step, after)
        try:
            ingest(other, output, names="{source}-{run}")
        except Killed:
            assert contents(output) in (before, contents(expected))
    ingest(other, output, names="{source}-{run}")
    assert contents(output) == contents(expected)
    assert not (tmp_path / f"crash{suffix}.partial").exists()


@pytest.mark.usefixtures("quick_disk")
@pytest.mark.parametrize("after", [False, True], ids=["set aside", "replaced"])
def test_where_folders_cannot_be_exchanged_the_old_one_comes_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, after: bool
) -> None:
    one, other = campaign(tmp_path / "one.h5", slice(0, 3)), campaign(tmp_path / "other.h5", slice(3, 5))
    output, expected = tmp_path / "crash.zarr", tmp_path / "whole.zarr"
    for target in (output, expected):
        ingest(one, target, names="{source}-{run}")
    ingest(other, expected, names="{source}-{run}")
    monkeypatch.setattr(replacing, "_exchange", lambda one, other: False)
    real = Path.replace
    count = 0

    def replace(self: Path, target: Path) -> Path:
        nonlocal count
        if target == output:
            if after:
                real(self, target)
            raise Killed
        count += 1
        return real(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", replace)
        with pytest.raises(Killed):
            ingest(other, output, names="{source}-{run}")
    assert output.exists() == after
    ingest(other, output, names="{source}-{run}")
    assert contents(output) == contents(expected)
    assert {p.name for p in tmp_path.iterdir()} == {"one.h5", "other.h5", "crash.zarr", "whole.zarr"}


@pytest.mark.usefixtures("quick_disk")
def test_finished_runs_are_not_read_again(tmp_path: Path, memory: RunsInMemory) -> None:
    runs = [MemoryRun(name) for name in "abc"]
    source = memory.put(tmp_path / "runs.txt", *runs)
    runs[2].moved[1, 1] = np.nan
    with pytest.raises(DataError, match="run c"):
        ingest(source, tmp_path / "out.zarr")
    assert (tmp_path / "out.zarr.partial").is_dir()
    runs[2].moved[1, 1] = 0
    for run in runs:
        run.read_states.clear()
    summary = ingest(source, tmp_path / "out.zarr")
    assert summary.resumed == 2
    assert [bool(run.read_states) for run in runs] == [False, False, True]
    assert not (tmp_path / "out.zarr.partial").exists()


@pytest.mark.usefixtures("quick_disk")
def test_what_was_read_with_other_options_is_read_again(tmp_path: Path, memory: RunsInMemory) -> None:
    runs = [MemoryRun("a"), MemoryRun("b")]
    source = memory.put(tmp_path / "runs.txt", *runs)
    runs[1].moved[1, 1] = np.nan
    with pytest.raises(DataError):
        ingest(source, tmp_path / "out.zarr")
    runs[1].moved[1, 1] = 0
    summary = ingest(source, tmp_path / "out.zarr", units="mm-s-t")
    assert summary.resumed == 0
    assert float(open_dataset(tmp_path / "out.zarr")["time"][-1]) == 4.0


@pytest.mark.usefixtures("quick_disk")
def test_torn_journal_line_costs_one_run_only(tmp_path: Path, memory: RunsInMemory) -> None:
    runs = [MemoryRun("a"), MemoryRun("b"), MemoryRun("c")]
    source = memory.put(tmp_path / "runs.txt", *runs)
    runs[2].moved[1, 1] = np.nan
    with pytest.raises(DataError):
        ingest(source, tmp_path / "out.zarr")
    journal = tmp_path / "out.zarr.partial" / "journal"
    journal.write_bytes(journal.read_bytes()[:-20])
    runs[2].moved[1, 1] = 0
    assert ingest(source, tmp_path / "out.zarr").resumed == 1
    assert validate(open_dataset(tmp_path / "out.zarr")) == []


@pytest.mark.usefixtures("quick_disk")
def test_damaged_staged_run_is_read_again(tmp_path: Path, memory: RunsInMemory) -> None:
    """After a power cut the journal may know of chunks that never reached the disk."""
    runs = [MemoryRun("a"), MemoryRun("b")]
    source = memory.put(tmp_path / "runs.txt", *runs)
    runs[1].moved[1, 1] = np.nan
    with pytest.raises(DataError):
        ingest(source, tmp_path / "out.zarr")
    (chunk,) = (tmp_path / "out.zarr.partial").glob("runs/*/displacement/c.*")
    chunk.write_bytes(b"")
    runs[1].moved[1, 1] = 0
    assert ingest(source, tmp_path / "out.zarr").resumed == 0
    assert validate(open_dataset(tmp_path / "out.zarr")) == []


# Appending and replacing


@pytest.mark.usefixtures("quick_disk")
@pytest.mark.parametrize("suffix", OUTPUTS)
class TestSecondIngest:
    @pytest.fixture
    def sources(self, tmp_path: Path) -> tuple[Path, Path]:
        return campaign(tmp_path / "one.h5", slice(0, 3)), campaign(tmp_path / "other.h5", slice(3, 5))

    def ingest(self, tmp_path: Path, suffix: str, *sources: Path, **options: object):  # type: ignore[no-untyped-def]
        return ingest(sources, tmp_path / f"crash{suffix}", names="{source}-{run}", **options)  # type: ignore[arg-type]

    def test_new_runs_are_added_as_if_read_together(self, tmp_path: Path, sources, suffix: str) -> None:  # type: ignore[no-untyped-def]
        self.ingest(tmp_path, suffix, sources[0])
        summary = self.ingest(tmp_path, suffix, sources[1])
        assert summary.added == ("other-run_000", "other-run_001")
        assert len(summary.runs) == 5
        ingest(sources, tmp_path / "both.zarr", names="{source}-{run}")
        added, together = (open_dataset(tmp_path / n).load() for n in (f"crash{suffix}", "both.zarr"))
        assert added.attrs.pop("history") == "\n".join(
            f"crashkit 0.1.0 ingest: {n} runs from {f}" for n, f in ((3, "one.h5"), (2, "other.h5"))
        )
        together.attrs.pop("history")
        xr.testing.assert_identical(added, together)

    def test_same_runs_again_change_nothing(self, tmp_path: Path, sources, suffix: str) -> None:  # type: ignore[no-untyped-def]
        self.ingest(tmp_path, suffix, *sources)
        before = contents(tmp_path / f"crash{suffix}")
        summary = self.ingest(tmp_path, suffix, *sources)
        assert (len(summary.unchanged), summary.added) == (5, ())
        assert contents(tmp_path / f"crash{suffix}") == before

    def test_changed_run_is_refused_and_replaced_if_asked_for(self, tmp_path: Path, sources, suffix: str) -> None:  # type: ignore[no-untyped-def]
        self.ingest(tmp_path, suffix, *sources)
        before = contents(tmp_path / f"crash{suffix}")
        campaign(sources[1], slice(3, 5), factor=1.5)
        with pytest.raises(DataError, match=r"run other-run_000: .* holds it already, read from another other.h5"):
            self.ingest(tmp_path, suffix, sources[1])
        assert contents(tmp_path / f"crash{suffix}") == before
        old = open_dataset(tmp_path / f"crash{suffix}").load()
        old.close()
        summary = self.ingest(tmp_path, suffix, sources[1], overwrite=True)
        assert summary.replaced == ("other-run_000", "other-run_001")
        new = open_dataset(tmp_path / f"crash{suffix}").load()
        np.testing.assert_array_equal(new["displacement"][:3], old["displacement"][:3])
        np.testing.assert_allclose(new["displacement"][3:], 1.5 * old["displacement"][3:], rtol=1e-5)
        assert validate(new) == []

    def test_changed_parameter_is_a_changed_run(self, tmp_path: Path, sources, suffix: str) -> None:  # type: ignore[no-untyped-def]
        table = tmp_path / "params.csv"
        rows = [f"one-run_00{k},{k + 5}\n" for k in range(3)]
        table.write_text("run,impact_speed [m/s]\n" + "".join(rows))
        self.ingest(tmp_path, suffix, sources[0], params=table)
        table.write_text("run,impact_speed [m/s]\n" + "".join(rows).replace(",6", ",6.5"))
        with pytest.raises(DataError, match=r"run one-run_001: .*with impact_speed 6 m s-1, here it is 6.5"):
            self.ingest(tmp_path, suffix, sources[0], params=table)

    def test_replacing_all_runs_binds_to_nothing_old(self, tmp_path: Path, sources, suffix: str) -> None:  # type: ignore[no-untyped-def]
        self.ingest(tmp_path, suffix, sources[0])
        self.ingest(tmp_path, suffix, sources[0], overwrite=True, time=[0, 0.01, 0.02])
        assert open_dataset(tmp_path / f"crash{suffix}").sizes["time"] == 3

    def test_the_hierarchy_goes_on_with_the_new_runs(self, tmp_path: Path, sources, suffix: str) -> None:  # type: ignore[no-untyped-def]
        from crashkit.api.coarsen import coarsen
        from crashkit.mesh.store import level_displacement, open_hierarchy

        output = tmp_path / f"crash{suffix}"
        self.ingest(tmp_path, suffix, sources[0])
        coarsen(output, [300])
        before = open_hierarchy(output)
        summary = self.ingest(tmp_path, suffix, sources[1])
        after = open_hierarchy(output)
        assert np.array_equal(after[1].kept, before[1].kept)
        assert any("hierarchy (300 nodes) goes on with the new runs" in note for note in summary.notes)
        runs = open_dataset(output, chunks=None)
        kept = runs["displacement"].values[:, :, after[1].kept]
        assert np.array_equal(level_displacement(output, 1), kept)


@pytest.mark.usefixtures("quick_disk")
class TestAppendedRuns:
    @pytest.fixture
    def output(self, tmp_path: Path, memory: RunsInMemory) -> Path:
        ingest(memory.put(tmp_path / "old.txt", MemoryRun("old")), tmp_path / "out.zarr")
        return tmp_path / "out.zarr"

    def add(self, output: Path, memory: RunsInMemory, run: MemoryRun, **options: object) -> xr.Dataset:
        ingest(memory.put(output.parent / "new.txt", run), output, **options)  # type: ignore[arg-type]
        return open_dataset(output).load()

    def test_they_come_to_the_times_of_the_dataset(self, output: Path, memory: RunsInMemory) -> None:
        run = MemoryRun("new", time=np.linspace(0, 6, 7) * 0.7)
        run.moved[3:, 5, 1] += 2.0
        ds = self.add(output, memory, run)
        np.testing.assert_allclose(ds["time"], np.arange(5) * 1e-3)
        assert float(ds["alignment_error"][1]) > 0 == float(ds["alignment_error"][0])
        np.testing.assert_allclose(ds["source_time"][0], [*ds["time"].values, np.nan, np.nan])
        assert validate(ds) == []

    def test_erosion_of_a_new_run_leaves_old_ones_alive(self, output: Path, memory: RunsInMemory) -> None:
        alive = np.ones((5, 8), bool)
        alive[4:, 6] = False
        ds = self.add(output, memory, MemoryRun("new", alive=alive))
        assert ds["alive"][0].all()
        assert not ds["alive"][1].all()
        assert validate(ds) == []

    def test_new_shape_gives_every_run_its_own(self, output: Path, memory: RunsInMemory) -> None:
        run = MemoryRun("new")
        run.mesh.position[:, 1] *= 1.2
        ds = self.add(output, memory, run)
        assert ds["reference_position"].dims == ("sim", "node", "xyz")
        np.testing.assert_allclose(ds["reference_position"][1, :, 1], 1.2 * ds["reference_position"][0, :, 1])
        assert validate(ds) == []

    @pytest.mark.parametrize(
        ("run", "options", "told"),
        [
            (MemoryRun("new", time=[0, 1, 2]), {}, r"covers 0 to 0.002 s, the dataset's times are 0 to 0.004 s"),
            (MemoryRun("new"), {"time": [0, 0.001]}, "has 5 states from 0 to 0.004 s, other times were asked for"),
            (MemoryRun("new"), {"keep_rigid_walls": True}, r"17 nodes, that of the first run 13 \(number 113 is new\)"),
            (MemoryRun("new", parameters={"v": (1, "s")}), {}, r"has the parameters none, the new runs have v \[s\]"),
        ],
        ids=["too short", "other times", "other mesh", "other parameters"],
    )
    def test_what_does_not_fit_is_refused(self, output, memory, run, options, told) -> None:  # type: ignore[no-untyped-def]
        before = contents(output)
        with pytest.raises(DataError, match=told):
            self.add(output, memory, run, **options)
        assert contents(output) == before
        assert not output.with_name("out.zarr.partial").exists()

    def test_dataset_of_older_chunks_is_copied_anew(self, output: Path, memory: RunsInMemory) -> None:
        old = open_dataset(output).load()
        old.close()
        shutil.rmtree(output)
        chunks = {"displacement": {"chunks": (1, 2, 5, 3)}}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the format of text
            old.chunk().drop_encoding().to_zarr(output, encoding=chunks, consolidated=False)
        ds = self.add(output, memory, MemoryRun("new"))
        np.testing.assert_array_equal(ds["displacement"][0], old["displacement"][0])
        assert validate(ds) == []


# Others at work


def test_second_ingest_into_the_same_output_is_told_to_wait(tmp_path: Path, memory: RunsInMemory) -> None:
    source = memory.put(tmp_path / "runs.txt", MemoryRun())
    with Staging(tmp_path / "out.zarr"), pytest.raises(OutputError, match="another ingest is writing it"):
        ingest(source, tmp_path / "out.zarr")


def test_full_disk_keeps_what_is_finished(
    tmp_path: Path, memory: RunsInMemory, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = memory.put(tmp_path / "runs.txt", MemoryRun("a"), MemoryRun("b"))
    real, calls = transfer.create_arrays, 0

    def full(*args: object, **kwargs: object) -> object:
        nonlocal calls
        calls += 1
        if calls == 2:
            raise OSError(28, "No space left on device", "chunk")
        return real(*args, **kwargs)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(transfer, "create_arrays", full)
        with pytest.raises(OutputError, match=r"No space left on device.*1 finished run is kept in out.zarr.partial"):
            ingest(source, tmp_path / "out.zarr")
    assert not (tmp_path / "out.zarr").exists()
    assert ingest(source, tmp_path / "out.zarr").resumed == 1


def test_workers_give_the_same_bytes_as_one(tmp_path: Path) -> None:
    from distributed import LocalCluster

    source = campaign(tmp_path / "kart.h5", slice(0, 5))
    ingest(source, tmp_path / "one.zarr")
    ingest(source, tmp_path / "two.zarr", workers=2)
    assert contents(tmp_path / "two.zarr") == contents(tmp_path / "one.zarr")
    with LocalCluster(n_workers=1, processes=False, dashboard_address=":0") as cluster:
        ingest(source, tmp_path / "elsewhere.zarr", scheduler=cluster.scheduler_address)
    assert contents(tmp_path / "elsewhere.zarr") == contents(tmp_path / "one.zarr")


def test_error_in_a_worker_is_that_of_the_run(tmp_path: Path) -> None:
    from distributed import LocalCluster

    source = campaign(tmp_path / "kart.h5", slice(0, 3))
    with h5py.File(source, "a") as file:
        file["kart/displacements"][1, 4, 7, 0] = np.nan
    with LocalCluster(n_workers=1, processes=False, dashboard_address=":0") as cluster:
        with pytest.raises(ReadError, match=r"run run_001: .*state 4"):
            ingest(source, tmp_path / "out.zarr", scheduler=cluster.scheduler_address)
        summary = ingest(source, tmp_path / "out.zarr", scheduler=cluster.scheduler_address, on_error="skip")
    assert summary.runs == ("run_000", "run_002")


def test_interrupt_leaves_what_is_finished(tmp_path: Path, memory: RunsInMemory) -> None:
    runs = [MemoryRun("a"), MemoryRun("b")]
    source = memory.put(tmp_path / "runs.txt", *runs)

    def stop(what: str, done: int, total: int, note: str) -> None:
        if done == 1:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        ingest(source, tmp_path / "out.zarr", report=stop)
    assert ingest(source, tmp_path / "out.zarr").resumed == 1


def test_source_files_are_recorded_with_their_checksums(tmp_path: Path) -> None:
    import hashlib

    source = campaign(tmp_path / "kart.h5", slice(0, 2))
    ingest(source, tmp_path / "out.nc")
    files = json.loads(open_dataset(tmp_path / "out.nc").attrs["source_files"])
    sha256 = hashlib.sha256(source.read_bytes()).hexdigest()
    assert files == [
        {"run": run, "file": "kart.h5", "bytes": source.stat().st_size, "sha256": sha256}
        for run in ("run_000", "run_001")
    ]  # fmt: skip
    assert assembly.__version__ in open_dataset(tmp_path / "out.nc").attrs["history"]


@pytest.mark.usefixtures("quick_disk")
def test_full_disk_under_a_netcdf_file_is_one_line_and_keeps_the_runs(
    tmp_path: Path, memory: RunsInMemory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """HDF5 says "HDF error" where the system says that the disk is full."""
    source = memory.put(tmp_path / "runs", MemoryRun("a"), MemoryRun("b", speed=3.0))

    def full(*_: object, **__: object) -> None:
        raise RuntimeError("NetCDF: HDF error")

    with monkeypatch.context() as patch:
        patch.setattr("crashkit.ingestion.store._create", full)
        with pytest.raises(
            OutputError, match=r"HDF error\); is the disk full\? \d+ MB are free in .*2 finished runs are kept"
        ):
            ingest(source, tmp_path / "o.nc", reader="memory")
    assert not (tmp_path / "o.nc").exists()
    assert ingest(source, tmp_path / "o.nc", reader="memory").resumed == 2
