"""One run into the staging folder: what is written, hashed, refused, and given back of scratch files."""

from __future__ import annotations

import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import zarr
from memory_runs import MemoryRun, RunsInMemory, plate
from test_structure import block

from crashkit.errors import DataError
from crashkit.ingestion import transfer as room
from crashkit.ingestion.staging import StagedRun
from crashkit.ingestion.store import ArraySpec
from crashkit.ingestion.survey import Choice, survey
from crashkit.ingestion.transfer import Layout, is_whole, let_memory_go, transfer
from crashkit.readers.base import FieldInfo
from data_schema.checksum import array_digest, block_digest


class Desk:
    """A source of one run and the folder into which it goes."""

    def __init__(self, folder: Path, memory: RunsInMemory) -> None:
        self.folder, self.memory = folder, memory
        self.place = folder / "staged" / "KEY"

    def send(
        self, run: MemoryRun, time: np.ndarray | None = None, one_shape: bool = True, fields: tuple[str, ...] = ()
    ) -> StagedRun:
        source = self.memory.put(self.folder / "runs.txt", run)
        choice = Choice(fields=fields, units="mm-ms-kg", allow_incomplete=True)
        seen = survey([source], choice)
        assert seen.structure is not None
        self.layout = Layout(
            choice, seen.structure, seen.found[0].time if time is None else time, dict(seen.found[0].fields), one_shape
        )
        return transfer(seen.found[0], self.layout, "KEY", self.place)

    def array(self, name: str) -> np.ndarray:
        return np.asarray(zarr.open_array(str(self.place / name), mode="r")[0])

    def names(self) -> set[str]:
        return {p.name for p in self.place.iterdir() if p.is_dir()}

    def left(self) -> set[str]:
        return {p.name for p in (self.folder / "staged").iterdir()}


@pytest.fixture
def desk(tmp_path: Path, memory: RunsInMemory) -> Desk:
    return Desk(tmp_path, memory)


def strain(values: np.ndarray) -> dict[str, tuple[FieldInfo, np.ndarray]]:
    return {"strain": (FieldInfo("strain", "face"), values)}


# What is written


def test_a_run_is_written_in_metres_with_the_digests_of_what_it_says(desk: Desk) -> None:
    run = MemoryRun()
    staged = desk.send(run)
    moved = (run.moved[:, :13] * np.float32(1e-3)).astype(np.float32)
    np.testing.assert_array_equal(desk.array("displacement"), moved)
    assert (staged.key, staged.name, staged.error) == ("KEY", "one", 0.0)
    assert staged.digests == {"displacement": array_digest([block_digest(moved)])}
    assert desk.names() == {"displacement"}
    assert desk.left() == {"KEY"}, "nothing but the finished run is left"
    assert run.closed


def test_what_was_there_under_the_name_is_replaced(desk: Desk) -> None:
    (desk.place / "old").mkdir(parents=True)
    desk.send(MemoryRun())
    assert desk.names() == {"displacement"}


def test_a_failure_leaves_nothing_and_closes_the_run(desk: Desk) -> None:
    run = MemoryRun()
    run.moved[3, 5, 1] = np.nan
    with pytest.raises(DataError):
        desk.send(run)
    assert desk.left() == set()
    assert run.closed


def test_runs_that_differ_in_shape_bring_their_own_positions_in_metres(desk: Desk) -> None:
    desk.send(MemoryRun(), one_shape=False)
    np.testing.assert_allclose(desk.array("reference_position"), plate().position[:13] * 1e-3, rtol=1e-12)


def test_erosion_of_shells_and_fields_are_written_and_hashed(desk: Desk) -> None:
    alive = np.ones((5, 8), bool)
    alive[3:, 6] = False
    values = np.random.default_rng(0).normal(size=(5, 8)).astype(np.float32)
    staged = desk.send(MemoryRun(alive=alive, fields=strain(values)), fields=("strain",))
    np.testing.assert_array_equal(desk.array("alive"), alive[:, :7])
    np.testing.assert_array_equal(desk.array("strain"), values[:, :7])
    assert staged.digests.keys() == {"displacement", "alive", "strain"}
    assert staged.digests["strain"] == array_digest([block_digest(values[:, :7])])
    assert np.isnan(desk.array("displacement")[3:, 12]).all()
    assert np.isfinite(desk.array("displacement")[:, :12]).all()


def test_erosion_of_solids_is_written_where_there_are_solids(desk: Desk) -> None:
    cells = np.ones((5, 4), bool)
    cells[2:, 0] = False
    staged = desk.send(MemoryRun(mesh=block(), alive_cells=cells))
    np.testing.assert_array_equal(desk.array("cell_alive"), cells)
    assert staged.digests.keys() == {"displacement", "alive", "cell_alive"}


def test_nothing_is_written_of_erosion_where_nothing_dies(desk: Desk) -> None:
    desk.send(MemoryRun(mesh=block(), alive_cells=np.ones((5, 4), bool)))
    assert desk.names() == {"displacement"}


def test_at_other_times_values_flags_and_fields_are_those_between_with_the_error_told(desk: Desk) -> None:
    alive = np.ones((5, 8), bool)
    alive[3:, 6] = False
    values = np.outer(np.arange(5), np.arange(8)).astype(np.float32) ** 2
    run = MemoryRun(alive=alive, fields=strain(values))
    run.moved[2:, 3, 1] += 4.0  # mm, a jump that no interpolation knows
    time = np.array([0.0, 0.001, 0.0025, 0.004])
    staged = desk.send(run, time, fields=("strain",))
    assert desk.array("displacement").shape == (4, 13, 3)
    np.testing.assert_allclose(desk.array("displacement")[:, 0, 0], 2e-3 * np.array([0, 1, 2.5, 4]), rtol=1e-5)
    np.testing.assert_allclose(desk.array("strain")[2], (values[2] + values[3])[:7] / 2, rtol=1e-6)
    assert desk.array("alive")[:, 6].tolist() == [True, True, False, False]
    assert np.isnan(desk.array("displacement")[2:, 12]).all(), "gone as soon as the element may be"
    assert 1e-3 < staged.error < 8e-3


def test_a_field_that_the_run_lacks_is_not_written(desk: Desk) -> None:
    source = desk.memory.put(
        desk.folder / "runs.txt", MemoryRun(fields=strain(np.ones((5, 8), np.float32))), MemoryRun("two")
    )
    seen = survey([source], Choice(fields=("strain",), units="mm-ms-kg"))
    assert seen.structure is not None
    fields = dict(seen.found[0].fields)
    layout = Layout(Choice(fields=("strain",), units="mm-ms-kg"), seen.structure, seen.found[0].time, fields, True)
    staged = transfer(seen.found[1], layout, "KEY", desk.place)
    assert staged.digests.keys() == {"displacement"}
    assert desk.names() == {"displacement"}


@pytest.mark.parametrize("aligned", [True, False])
def test_a_large_run_goes_through_a_file_with_the_same_result(
    desk: Desk, monkeypatch: pytest.MonkeyPatch, aligned: bool
) -> None:
    values = np.random.default_rng(1).normal(size=(5, 8)).astype(np.float32)
    time = None if aligned else np.array([0.0, 0.0015, 0.004])
    run = MemoryRun(fields=strain(values))
    small = desk.send(run, time, fields=("strain",))
    expected = {name: desk.array(name) for name in desk.names()}
    monkeypatch.setattr(room, "MEMORY_BYTES", 100)
    monkeypatch.setattr(room, "_PIECE_BYTES", 500)  # two states of 17 nodes
    run.read_states.clear()
    large = desk.send(run, time, fields=("strain",))
    assert {name: desk.array(name).tobytes() for name in desk.names()} == {n: a.tobytes() for n, a in expected.items()}
    assert (large.digests, large.error) == (small.digests, small.error)
    assert (large.displacement, large.speed) == (small.displacement, small.speed)
    assert run.read_states == [(0, 2), (2, 4), (4, 5)], "every state once, as many at a time as the budget allows"
    assert desk.left() == {"KEY"}


# What is refused


def test_a_value_that_is_no_number_is_told_with_file_state_time_and_node(desk: Desk) -> None:
    files = tuple(desk.folder / f"d3plot{k:02d}" for k in range(5))
    for file in files:
        file.write_text("")
    run = MemoryRun(files=files)
    run.moved[3, 5] = [0.5, np.nan, 0.0]
    with pytest.raises(
        DataError, match=r"d3plot03: state 3 \(time 0.003 s\), node 105: the displacement is \[0.0005.*, nan"
    ):
        desk.send(run)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_with_fewer_files_than_states_the_first_or_the_source_is_told(desk: Desk, count: int) -> None:
    files = tuple(desk.folder / f"part{k}" for k in range(count))
    for file in files:
        file.write_text("")
    run = MemoryRun(files=files)
    run.moved[3, 5] = np.inf
    with pytest.raises(DataError, match=r"(part0|runs\.txt): state 3") as caught:
        desk.send(run)
    assert ("part0" in str(caught.value)) == (count > 0)


def test_a_late_state_is_counted_from_the_first_though_states_are_read_in_pieces(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(room, "_PIECE_BYTES", 500)
    run = MemoryRun()
    run.moved[4, 2] = np.nan
    with pytest.raises(DataError, match=r"state 4 \(time 0.004 s\), node 102"):
        desk.send(run)


def test_the_first_state_must_be_the_reference(desk: Desk) -> None:
    run = MemoryRun()
    run.moved[0, 4] = [0.02, -0.5, 0.1]
    run.moved[0, 6] = [0.3, 0.0, 0.0]
    with pytest.raises(DataError, match=r"first state \(time 0 s\) node 104 is displaced by 0.0005 m; expected zero"):
        desk.send(run)
    run.moved[0] = 0.005  # mm: rounding of positions in single precision
    desk.send(run)


def test_a_node_missing_in_the_first_state_is_told_as_missing(desk: Desk) -> None:
    run = MemoryRun()
    run.moved[0, 4] = np.nan
    with pytest.raises(DataError, match=r"state 0 \(time 0 s\), node 104: the displacement is \[nan"):
        desk.send(run)


def test_garbage_on_nodes_that_are_gone_is_no_reason_to_refuse_but_on_others_is(desk: Desk) -> None:
    alive = np.ones((5, 8), bool)
    alive[3:, 6] = False
    run = MemoryRun(alive=alive)
    run.moved[3:, 12] = np.inf
    desk.send(run)
    run.moved[2, 12] = np.inf  # one state before its element dies
    with pytest.raises(DataError, match=r"state 2 .*node 112"):
        desk.send(run)


@pytest.mark.parametrize(
    ("before", "then", "refused"), [(0.1, 900.0, False), (0.1, 1100.0, True), (2.0, 1900.0, False), (2.0, 2100.0, True)]
)
def test_a_displacement_may_reach_a_thousand_times_the_structure_or_the_displacements_before(
    desk: Desk, before: float, then: float, refused: bool
) -> None:
    """In diagonals of the plate, 40 mm by 20 mm."""
    run = MemoryRun(speed=0.0)
    run.moved[:] = 0.0
    run.moved[2:, 5, 0] = before * np.hypot(40.0, 20.0)
    run.moved[3:, 5, 0] = then * np.hypot(40.0, 20.0)
    if not refused:
        assert desk.send(run).displacement == pytest.approx(then * np.hypot(0.04, 0.02))
        return
    with pytest.raises(DataError, match=r"state 3 \(time 0\.003 s\), node 105: the displacement is .* m long"):
        desk.send(run)


# Whether it still is what was written


def test_a_finished_run_is_whole_until_something_of_it_changes_or_is_lost(desk: Desk) -> None:
    staged = desk.send(MemoryRun(), one_shape=False)
    assert is_whole(staged, desk.place)
    assert not is_whole(replace(staged, digests={**staged.digests, "strain": "0" * 64}), desk.place)
    array = zarr.open_array(str(desk.place / "displacement"), mode="r+")
    before = array[0, 4, 12, 2]
    array[0, 4, 12, 2] = before + np.float32(1e-6)
    assert not is_whole(staged, desk.place)
    array[0, 4, 12, 2] = before
    assert is_whole(staged, desk.place)
    zarr.open_array(str(desk.place / "reference_position"), mode="r+")[0, 3, 1] = np.nan
    assert not is_whole(staged, desk.place)


def test_a_run_in_several_blocks_is_whole_too(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("data_schema.checksum.BLOCK_BYTES", 5 * 12 * 4)  # four nodes of five states
    staged = desk.send(MemoryRun())
    assert zarr.open_array(str(desk.place / "displacement"), mode="r").chunks == (1, 5, 4, 3)
    assert is_whole(staged, desk.place)
    array = zarr.open_array(str(desk.place / "displacement"), mode="r+")
    array[0, 0, 12, 0] = 1.0
    assert not is_whole(staged, desk.place)


@pytest.mark.parametrize("what", ["array", "chunk", "metadata"])
def test_a_damaged_run_is_not_whole_and_raises_nothing(desk: Desk, what: str) -> None:
    staged = desk.send(MemoryRun())
    folder = desk.place / "displacement"
    if what == "array":
        shutil.rmtree(folder)
    elif what == "chunk":
        next(folder.glob("c.*")).write_bytes(b"rubbish")
    else:
        (folder / "zarr.json").write_text("{")
    assert not is_whole(staged, desk.place)


# What a layout says of a run's arrays


def test_the_arrays_of_a_run_have_the_sizes_of_the_structure(desk: Desk) -> None:
    fields = {
        "stress": (FieldInfo("stress", "cell", 6, "stress"), np.zeros((5, 4, 6), np.float32)),
        "heat": (FieldInfo("heat", "node"), np.zeros((5, 16), np.float32)),
        "flow": (FieldInfo("flow", "node", 3, "velocity"), np.zeros((5, 16, 3), np.float32)),
        "pair": (FieldInfo("pair", "node", 2), np.zeros((5, 16, 2), np.float32)),
    }
    desk.send(MemoryRun(mesh=block(), fields=fields), fields=tuple(fields), one_shape=False)
    specs = {s.name: s for s in desk.layout.specs()}
    sizes = {name: (spec.dims, spec.shape, spec.dtype) for name, spec in specs.items()}
    assert sizes == {
        "displacement": (("time", "node", "xyz"), (5, 15, 3), "float32"),
        "reference_position": (("node", "xyz"), (15, 3), "float64"),
        "alive": (("time", "face"), (5, 13), "bool"),
        "cell_alive": (("time", "cell"), (5, 4), "bool"),
        "stress": (("time", "cell", "tensor"), (5, 4, 6), "float32"),
        "heat": (("time", "node"), (5, 15), "float32"),
        "flow": (("time", "node", "xyz"), (5, 15, 3), "float32"),
        "pair": (("time", "node", "pair_component"), (5, 15, 2), "float32"),
    }
    assert specs["displacement"].attributes["units"] == "m"
    assert specs["reference_position"].attributes["units"] == "m"
    assert specs["stress"].attributes == {"units": "Pa", "role": "field"}
    assert {s.name for s in desk.layout.specs(alive=False, cell_alive=False)} == specs.keys() - {"alive", "cell_alive"}


def test_without_solids_none_can_die(desk: Desk) -> None:
    desk.send(MemoryRun())
    assert {s.name for s in desk.layout.specs()} == {"displacement", "alive"}


# The turn from states to nodes


@pytest.mark.parametrize("limit", [1 << 20, 0])
@pytest.mark.parametrize("rest", [(), (3,)])
def test_what_is_put_by_states_comes_out_by_nodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: int, rest: tuple[int, ...]
) -> None:
    monkeypatch.setattr(room, "MEMORY_BYTES", limit)
    values = np.random.default_rng(0).normal(size=(6, 9, *rest)).astype(np.float32)
    scratch = tmp_path / "scratch"
    with room._Turn(values.shape, scratch) as turn:
        for first, last in ((4, 6), (0, 1), (1, 4)):
            turn.put(first, values[first:last])
        assert scratch.exists() == (limit == 0)
        parts = [slice(0, 4), slice(4, 8), slice(8, 9)] * 5
        with ThreadPoolExecutor(4) as pool:
            found = list(pool.map(turn.nodes, parts))
        for part, block_ in zip(parts, found, strict=True):
            np.testing.assert_array_equal(block_, values[:, part])
            assert block_.flags["C_CONTIGUOUS"]
    assert not scratch.exists()


def test_exactly_as_much_as_memory_allows_needs_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for more, needed in ((0, False), (-1, True)):
        monkeypatch.setattr(room, "MEMORY_BYTES", 6 * 9 * 3 * 4 + more)
        with room._Turn((6, 9, 3), tmp_path / "scratch"):
            assert (tmp_path / "scratch").exists() == needed


def test_memory_is_used_again_until_it_is_let_go() -> None:
    let_memory_go()
    first = room._memory((2, 3))
    assert (first.shape, first.dtype) == ((2, 3), np.float32)
    assert np.shares_memory(first, room._memory((5,)))
    assert not np.shares_memory(first, room._memory((4, 3)))
    second = room._memory((4, 3))
    let_memory_go()
    assert not np.shares_memory(second, room._memory((4, 3)))
    let_memory_go()


def test_nodes_are_written_in_blocks_that_cover_all() -> None:
    spec = ArraySpec("displacement", ("time", "node", "xyz"), (7, 1 << 20, 3), "float32")
    parts = room._parts(spec)
    assert parts[0].start == 0
    assert parts[-1].stop == 1 << 20
    assert all(a.stop == b.start for a, b in pairwise(parts))
    assert {p.stop - p.start for p in parts[:-1]} == {spec.chunks[1]}
