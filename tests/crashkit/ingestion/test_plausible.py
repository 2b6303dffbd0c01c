"""What is said of units, times and speeds at the end of an ingest, and what is refused as impossible."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from memory_runs import MemoryRun, RunsInMemory, plate

from crashkit.dataset import open_dataset
from crashkit.errors import DataError
from crashkit.ingestion.ingest import IngestSummary, ingest
from crashkit.ingestion.scale import CampaignScale


@pytest.fixture(autouse=True)
def _no_synchronising(quick_disk: None) -> None:
    """Files need not survive a power cut here."""


def run_all(folder: Path, memory: RunsInMemory, *runs: MemoryRun, **options: object) -> IngestSummary:
    return ingest(memory.put(folder / "runs", *runs), folder / "o.zarr", reader="memory", **options)  # type: ignore[arg-type]


def test_size_duration_displacement_and_speed_are_the_largest(tmp_path: Path, memory: RunsInMemory) -> None:
    """Nodes move by 2 t along x and 0.01 x t^2 along z, mm and ms; the tip is at x = 40."""
    summary = run_all(tmp_path, memory, MemoryRun())
    assert summary.scale is not None
    assert summary.scale.size == pytest.approx((0.040, 0.020, 0.0))
    assert summary.scale.duration == pytest.approx(0.004)
    assert summary.scale.displacement == pytest.approx(np.hypot(8.0, 6.4) / 1e3, rel=1e-6)
    assert summary.scale.speed == pytest.approx(np.hypot(2.0, 0.4 * (16 - 9)), rel=1e-6)
    assert summary.question == ""


def test_a_dead_node_has_no_speed(tmp_path: Path, memory: RunsInMemory) -> None:
    alive = np.ones((5, len(plate().face_nodes)), bool)
    alive[3:, -2] = False  # the triangle at the tip; its node flies off
    run = MemoryRun(alive=alive)
    run.moved[3:, 12] = 1e9
    scale = run_all(tmp_path, memory, run).scale
    assert scale is not None
    assert scale.displacement < 0.02
    assert scale.speed < 10


@pytest.mark.parametrize(
    ("scale", "units", "told"),
    [
        (CampaignScale((1500, 900, 400), 30.0, 400, 20), "SI", "a structure of 1.5e+03 m and 30 s are unusual: is --units SI right? "
         "if not, the numbers fit mm-ms-kg"),
        (CampaignScale((1.5, 0.9, 0.4), 0.03, 0.4, 2e4), "SI", "a speed of 2e+04 m/s is unusual"),
        (CampaignScale((1500, 900, 400), 0.03, 400, 15000), "SI", "the numbers fit mm-s-t"),
        (CampaignScale((1.5e-3, 9e-4, 4e-4), 3e-5, 4e-4, 15), "mm-ms-kg", ""),
        (CampaignScale((1.5e-6, 9e-7, 4e-7), 3e-5, 4e-7, 15e-3), "mm-ms-kg", "a structure of 1.5e-06 m is unusual"),
        (CampaignScale((1.5, 0.9, 0.4), 0.03, 0.4, 15), "mm-ms-kg", ""),
        (CampaignScale((1.5, 0.9, 0.4), 0.0, 0.4, 0.0), "SI", ""),
    ],
)  # fmt: skip
def test_absurd_numbers_ask_for_the_units(scale: CampaignScale, units: str, told: str) -> None:
    question = scale.question(units)
    assert told in question if told else not question


@pytest.mark.parametrize("value", [1e30, 1e12, 3e4])
def test_a_leap_in_one_state_is_refused_with_its_place(tmp_path: Path, memory: RunsInMemory, value: float) -> None:
    run = MemoryRun(units="SI")
    run.moved[3, 5] = value
    with pytest.raises(DataError, match=r"state 3 \(time 3 s\), node 105: the displacement is .* m long, .* diverged"):
        run_all(tmp_path, memory, run)


def test_a_motion_that_ends_far_off_is_refused(tmp_path: Path, memory: RunsInMemory) -> None:
    run = MemoryRun(units="SI", speed=0.0)
    run.moved[:, :, 0] = np.array([0, 1e4, 1e6, 1e9, 1e12])[:, None]
    with pytest.raises(DataError, match=r"state 3 .* the displacement is 1e\+09 m long"):
        run_all(tmp_path, memory, run)


def _dead(*faces: int) -> np.ndarray:
    alive = np.ones((5, len(plate().face_nodes)), bool)
    alive[:, list(faces)] = False
    return alive


def test_nodes_that_live_in_no_run_are_left_out_and_counted(tmp_path: Path, memory: RunsInMemory) -> None:
    """The triangle at the tip is dead everywhere, the first face in one run only."""
    tip = len(plate().face_nodes) - 2
    runs = (MemoryRun("a", alive=_dead(tip)), MemoryRun("b", alive=_dead(0, tip)))
    summary = run_all(tmp_path, memory, *runs)
    assert "1 element that lives in no state of any run left out, and 1 node that nothing else uses" in summary.notes
    with open_dataset(tmp_path / "o.zarr", chunks=None) as dataset:
        assert dataset["node_id"].values.tolist() == list(range(100, 112))
        assert dataset.sizes["face"] == tip
        assert bool(dataset["displacement"].sel(sim="a").isnull().any()) is False
        assert dataset["alive"].sel(sim="b").values[0].tolist() == [False] + [True] * (tip - 1)
    memory.put(tmp_path / "more", MemoryRun("c", alive=_dead(tip)))
    more = ingest(tmp_path / "more", tmp_path / "o.zarr", reader="memory")
    assert more.runs == ("a", "b", "c"), "a run that is added leaves the same elements out"


def test_a_run_in_which_nothing_lives_at_first_is_refused(tmp_path: Path, memory: RunsInMemory) -> None:
    alive = np.zeros((5, len(plate().face_nodes)), bool)
    alive[:, -1] = True  # the wall is no structure
    with pytest.raises(DataError, match=r"no element lives in the first state \(time 0\)"):
        run_all(tmp_path, memory, MemoryRun(alive=alive))


@pytest.mark.parametrize(("speed", "told"), [(2.0, "the same result; is one a copy?"), (3.0, "different results")])
def test_runs_of_equal_parameters_are_said(tmp_path: Path, memory: RunsInMemory, speed: float, told: str) -> None:
    first = MemoryRun("a", parameters={"speed": (1.0, "m/s")})
    second = MemoryRun("b", parameters={"speed": (1.0, "m/s")}, speed=speed)
    third = MemoryRun("c", parameters={"speed": (2.0, "m/s")}, speed=4.0)
    notes = run_all(tmp_path, memory, first, second, third).notes
    assert [n for n in notes if "equal parameters" in n and "a and b" in n and told in n]
    assert not any("and c" in n for n in notes)


def test_the_notes_of_runs_arrive(tmp_path: Path, memory: RunsInMemory) -> None:
    run = MemoryRun()
    run.notes, run.withheld = ("states listed twice",), {"strain": "not told apart"}
    notes = run_all(tmp_path, memory, MemoryRun("x", fields=_field("strain")), run, fields=["strain"]).notes
    assert "states listed twice" in notes
    assert "run one has no strain; strain: not told apart" in notes


def _field(name: str):  # type: ignore[no-untyped-def]
    from crashkit.readers.base import FieldInfo

    return {name: (FieldInfo(name, "face"), np.zeros((5, len(plate().face_nodes)), np.float32))}


def _leaping(state: int = 2, nodes: list[int] | None = None, by: float = 900.0) -> MemoryRun:
    run = MemoryRun("a")
    run.moved[state, nodes or [5], 1] += by
    return run


def test_a_node_that_leaps_and_is_back_is_marked_with_run_node_state_and_length(
    tmp_path: Path, memory: RunsInMemory
) -> None:
    summary = run_all(tmp_path, memory, _leaping(), MemoryRun("b"))
    told = "node 105 leaps by 0.9 m in state 2 (time 0.002 s) and is back in the next one, without its neighbours"
    assert summary.marked == {"a": told}
    with open_dataset(tmp_path / "o.zarr") as runs:
        assert list(runs["quality_note"].values) == [told, ""]


def test_a_leap_is_refused_like_other_runs_that_are_no_good(tmp_path: Path, memory: RunsInMemory) -> None:
    with pytest.raises(DataError, match=r"run a: node 105 leaps by 0\.9 m in state 2"):
        run_all(tmp_path, memory, _leaping(), MemoryRun("b"), quality="refuse")


@pytest.mark.parametrize(
    ("state", "nodes", "by"),
    [
        (2, list(range(13)), 900.0),  # all of them: a structure that swings
        (2, [2, 5, 12], 900.0),  # several: no single node
        (4, [5], 900.0),  # in the last state nobody knows whether it comes back
        (2, [5], 3.0),  # less than a tenth of the structure
    ],
)
def test_what_may_be_real_is_no_leap(
    tmp_path: Path, memory: RunsInMemory, state: int, nodes: list[int], by: float
) -> None:
    assert run_all(tmp_path, memory, _leaping(state, nodes, by), MemoryRun("b")).marked == {}


def test_a_node_that_is_gone_does_not_leap(tmp_path: Path, memory: RunsInMemory) -> None:
    alive = np.ones((5, len(plate().face_nodes)), bool)
    alive[3:, -2] = False  # the triangle at the tip
    run = MemoryRun(alive=alive)
    run.moved[3, 12] = 900.0
    assert run_all(tmp_path, memory, run, MemoryRun("b")).marked == {}
