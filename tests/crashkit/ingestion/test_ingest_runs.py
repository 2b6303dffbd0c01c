"""What ingest makes of runs: units, order, erosion, fields, common times, and every reason to refuse one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from memory_runs import MemoryRun, RunsInMemory, plate, shuffled
from test_structure import block

from crashkit.dataset import demo_data, open_dataset
from crashkit.errors import CrashkitError, DataError, OutputError, ReadError
from crashkit.ingestion import transfer
from crashkit.ingestion.ingest import IngestSummary, ingest
from crashkit.readers.base import FieldInfo
from data_schema import validate

OUTPUTS = (".zarr", ".nc")
pytestmark = pytest.mark.usefixtures("quick_disk")


class Place:
    """A source and an output in a folder of their own."""

    def __init__(self, folder: Path, memory: RunsInMemory) -> None:
        self.folder, self.memory = folder, memory

    def ingest(self, *runs: MemoryRun | ReadError, suffix: str = ".zarr", **options: object) -> xr.Dataset:
        self.summary = self.try_ingest(*runs, suffix=suffix, **options)
        ds = open_dataset(self.folder / f"out{suffix}").load()
        ds.close()
        return ds

    def try_ingest(self, *runs: MemoryRun | ReadError, suffix: str = ".zarr", **options: object) -> IngestSummary:
        source = self.memory.put(self.folder / "runs.txt", *runs)
        return ingest(source, self.folder / f"out{suffix}", **options)  # type: ignore[arg-type]

    def left(self) -> set[str]:
        return {p.name for p in self.folder.iterdir()} - {"runs.txt"}


@pytest.fixture
def place(tmp_path: Path, memory: RunsInMemory) -> Place:
    return Place(tmp_path, memory)


# What comes out


@pytest.mark.parametrize("suffix", OUTPUTS)
def test_values_arrive_in_si_at_the_nodes_they_belong_to(place: Place, suffix: str) -> None:
    run = MemoryRun(parameters={"speed": (72.0, "km/h"), "yield": (300.0, "MPa")})
    ds = place.ingest(run, suffix=suffix)
    np.testing.assert_allclose(ds["displacement"][0], run.moved[:, :13] * 1e-3, rtol=1e-6)
    np.testing.assert_allclose(ds["reference_position"], plate().position[:13] * 1e-3)
    np.testing.assert_allclose(ds["time"], run.time * 1e-3)
    assert ds["node_id"].values.tolist() == list(range(100, 113))
    assert (float(ds["speed"][0]), ds["speed"].attrs["units"]) == (pytest.approx(20.0), "m s-1")
    assert (float(ds["yield"][0]), ds["yield"].attrs["units"]) == (3e8, "Pa")
    assert ds.attrs["units_read"] == "mm-ms-kg"
    assert place.summary.notes[0] == "rigid walls left out: wall"
    assert validate(ds) == []
    assert place.left() == {f"out{suffix}"}, "nothing is left beside the output"


def test_zarr_and_netcdf_hold_the_same(place: Place) -> None:
    runs = [MemoryRun(n, fields=strain_field(), alive=erosion(), speed=s) for n, s in (("a", 1.0), ("b", 2.0))]
    one, other = (place.ingest(*runs, suffix=s, fields=["strain"]) for s in OUTPUTS)
    xr.testing.assert_identical(one, other)


def test_run_in_another_node_order_gives_the_same_dataset(place: Place) -> None:
    mesh, order = shuffled(plate())
    other = MemoryRun("b", mesh=mesh, fields=strain_field(mesh), alive=erosion(mesh))
    one = MemoryRun("a", fields=strain_field(), alive=erosion())
    ds = place.ingest(one, other, fields=["strain"])
    assert len(order) == 17
    for name in ("displacement", "alive", "strain"):
        np.testing.assert_array_equal(ds[name][0], ds[name][1], err_msg=name)


def test_runs_of_different_shape_keep_their_own(place: Place) -> None:
    mesh = plate()
    thick = replace(mesh, position=mesh.position * [1.0, 1.1, 1.0])
    ds = place.ingest(MemoryRun("a"), MemoryRun("b", mesh=thick))
    assert ds["reference_position"].dims == ("sim", "node", "xyz")
    np.testing.assert_allclose(ds["reference_position"][1], thick.position[:13] * 1e-3)
    assert validate(ds) == []


def test_rounding_of_positions_is_no_other_shape(place: Place) -> None:
    mesh = plate()
    rounded = replace(mesh, position=mesh.position.astype(np.float32) + 1e-6)
    assert place.ingest(MemoryRun("a"), MemoryRun("b", mesh=rounded))["reference_position"].dims == ("node", "xyz")


def test_solids_keep_their_cells_and_lend_their_strain_to_the_skin(place: Place) -> None:
    mesh = block()
    values = np.arange(5 * 4, dtype=np.float32).reshape(5, 4)
    values[:, 3] = np.nan  # the beam has none
    fields = {"solid_strain": (FieldInfo("solid_strain", "cell"), values)}
    ds = place.ingest(MemoryRun(mesh=mesh, fields=fields), fields=["strain", "solid_strain"])
    assert ds.sizes["cell"] == 4
    assert ds["strain"].dims == ("sim", "time", "face")
    np.testing.assert_array_equal(ds["strain"][0], values[:, ds["face_id"].values - 10])
    np.testing.assert_array_equal(ds["solid_strain"][0], values)
    assert validate(ds) == []


def test_beams_alone_make_a_dataset(place: Place) -> None:
    for suffix in OUTPUTS:
        ds = place.ingest(MemoryRun(mesh=block()), parts=["beam"], suffix=suffix)
        assert (ds.sizes["face"], ds.sizes["cell"], ds.sizes["node"]) == (0, 1, 2)
        assert validate(ds) == []


def test_large_runs_go_through_a_file_with_the_same_result(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    run = MemoryRun(fields=strain_field(), alive=erosion())
    small = place.ingest(run, suffix=".nc", fields=["strain"])
    monkeypatch.setattr(transfer, "MEMORY_BYTES", 100)
    monkeypatch.setattr(transfer, "_PIECE_BYTES", 300)
    run.read_states.clear()
    large = place.ingest(run, suffix=".zarr", fields=["strain"])
    xr.testing.assert_identical(small, large)
    assert run.read_states == [(k, k + 1) for k in range(5)], "every state is read once"
    assert run.closed


# Erosion


def erosion(mesh=None) -> np.ndarray:  # type: ignore[no-untyped-def]
    """(state, face): the triangle at the tip (face 506) dies at state 3."""
    mesh = plate() if mesh is None else mesh
    alive = np.ones((5, len(mesh.face_id)), bool)
    alive[3:, mesh.face_id == 506] = False
    return alive


def strain_field(mesh=None) -> dict[str, tuple[FieldInfo, np.ndarray]]:  # type: ignore[no-untyped-def]
    mesh = plate() if mesh is None else mesh
    values = (mesh.face_id[None] * np.arange(5)[:, None] / 1e4).astype(np.float32)
    return {"strain": (FieldInfo("strain", "face"), values)}


def test_node_of_a_dead_element_is_nan_and_never_zero(place: Place) -> None:
    ds = place.ingest(MemoryRun("a", alive=erosion()), MemoryRun("b"))
    assert ds["alive"].dtype == bool
    tip = 12
    missing = np.isnan(ds["displacement"].values).any(axis=-1)
    assert missing.sum() == 2
    assert missing[0, 3:, tip].all()
    assert ds["alive"].values[1].all()
    assert validate(ds) == []


def test_no_alive_where_nothing_dies(place: Place) -> None:
    assert "alive" not in place.ingest(MemoryRun(alive=np.ones((5, 8), bool)))


def test_garbage_of_a_gone_node_is_no_reason_to_refuse(place: Place) -> None:
    run = MemoryRun(alive=erosion())
    run.moved[4, 12] = np.inf
    assert validate(place.ingest(run)) == []


def test_solid_that_dies_takes_its_skin_and_inner_nodes_along(place: Place) -> None:
    alive = np.ones((5, 4), bool)
    alive[2:, 0] = False  # the first hexahedron; its far corners are of no other cell
    ds = place.ingest(MemoryRun(mesh=block(), alive_cells=alive))
    np.testing.assert_array_equal(ds["cell_alive"][0], alive)
    np.testing.assert_array_equal(ds["alive"].values[0, 2], ds["face_id"].values != 10)
    assert np.isnan(ds["displacement"].values[0, 2:, :4]).all()
    assert np.isfinite(ds["displacement"].values[0, :, 4:]).all()
    assert validate(ds) == []


# Fields


def test_fields_in_si_with_missing_ones_missing(place: Place) -> None:
    stress = np.random.default_rng(0).normal(size=(5, 17)).astype(np.float32)
    fields = {"stress_zz": (FieldInfo("stress_zz", "node", 1, "stress"), stress)}
    ds = place.ingest(MemoryRun("a", fields=fields), MemoryRun("b"), fields=["stress_zz"])
    np.testing.assert_allclose(ds["stress_zz"][0], stress[:, :13] * 1e9, rtol=1e-6)
    assert ds["stress_zz"].attrs == {"units": "Pa", "role": "field"}
    assert np.isnan(ds["stress_zz"][1]).all()
    assert "run b has no stress_zz; it has no further field" in place.summary.notes
    assert validate(ds) == []


def test_field_of_unknown_unit_is_kept_and_labelled_so(place: Place) -> None:
    values = np.full((5, 17), 20.0, np.float32)
    ds = place.ingest(MemoryRun(fields={"heat": (FieldInfo("heat", "node", 1, "heat"), values)}), fields=["heat"])
    assert ds["heat"].attrs["units"] == "unknown"
    assert (ds["heat"] == 20).all()


def test_field_nobody_has_is_told_with_what_there_is(place: Place) -> None:
    with pytest.raises(DataError, match="no run has a field 'stress'; run one has no stress; it has strain"):
        place.try_ingest(MemoryRun(fields=strain_field()), fields=["stress"])


# Common times


def test_unequal_times_come_to_the_coarsest_with_their_error(place: Place) -> None:
    fine = MemoryRun("fine", time=np.linspace(0, 4, 13), alive=None)
    coarse = MemoryRun("coarse", fields=strain_field())
    ds = place.ingest(fine, coarse, fields=["strain"])
    np.testing.assert_allclose(ds["time"], coarse.time * 1e-3)
    np.testing.assert_allclose(ds["displacement"][0], ds["displacement"][1], atol=1e-7)  # parabolas: exact
    assert float(ds["alignment_error"][1]) == 0
    assert 0 <= float(ds["alignment_error"][0]) < 1e-6
    np.testing.assert_allclose(ds["source_time"][0], fine.time * 1e-3)
    assert np.isnan(ds["source_time"][1, 5:]).all()
    assert set(place.summary.alignment_error) == {"fine", "coarse"}
    assert validate(ds) == []


def test_error_of_kinked_motion_is_in_dataset_and_summary(place: Place) -> None:
    run = MemoryRun("kinked", time=np.arange(9.0) / 2)
    run.moved[5:, 3, 0] += 4.0
    ds = place.ingest(run, time=np.linspace(0, 4e-3, 8))
    assert 1e-3 < float(ds["alignment_error"][0]) < 8e-3
    assert place.summary.alignment_error["kinked"] == float(ds["alignment_error"][0])


def test_states_that_common_times_lose_at_the_end_are_told(place: Place) -> None:
    ds = place.ingest(MemoryRun("long"), MemoryRun("short", time=np.linspace(0, 3.4, 5)))
    np.testing.assert_allclose(ds["time"], [0, 1e-3, 2e-3, 3e-3])
    told = "the common times end at 0.003 s, since run short ends at 0.0034 s; run long goes on to 0.004 s"
    assert told in place.summary.notes


def test_ends_a_hair_apart_lose_no_state(place: Place) -> None:
    ds = place.ingest(MemoryRun("a"), MemoryRun("b", time=[0, 1, 2, 3, 3.999]))
    np.testing.assert_allclose(ds["time"], [0, 1e-3, 2e-3, 3e-3, 3.999e-3])
    assert not any("common times" in note for note in place.summary.notes)


def test_run_that_ends_a_hair_before_the_dataset_joins_it(tmp_path: Path, memory: RunsInMemory) -> None:
    first = memory.put(tmp_path / "first.txt", MemoryRun("a"))
    second = memory.put(tmp_path / "second.txt", MemoryRun("b", time=[0, 1, 2, 3, 3.999]))
    ingest(first, tmp_path / "out.zarr")
    summary = ingest(second, tmp_path / "out.zarr")
    assert summary.runs == ("a", "b")
    ds = open_dataset(tmp_path / "out.zarr")
    assert float(ds["displacement"][1, -1, 0, 0]) == pytest.approx(2.0 * 3.999e-3)
    assert 1e-6 < summary.alignment_error["b"] < 1e-5  # 1 us at some 5 m/s
    assert validate(ds) == []


def test_erosion_at_common_times_is_on_the_safe_side(place: Place) -> None:
    ds = place.ingest(MemoryRun(alive=erosion()), time=np.array([0, 2.0, 2.5, 3, 4]) * 1e-3)
    assert ds["alive"].values[0, :, 6].tolist() == [True, True, False, False, False]
    assert validate(ds) == []


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.floats(0.001, 3.999), min_size=1, max_size=6, unique=True))
def test_given_times_are_those_of_the_dataset(place: Place, inner: list[float]) -> None:
    wanted = np.array([0, *sorted(inner), 4.0]) * 1e-3
    if (np.diff(wanted) < 1e-7).any():
        return
    ds = place.ingest(MemoryRun(), time=wanted, overwrite=True)
    np.testing.assert_array_equal(ds["time"], wanted)
    x = plate().position[:13, 0]
    exact = 0.01 * x * (wanted[:, None] * 1e3) ** 2 * 1e-3
    np.testing.assert_allclose(ds["displacement"][0, :, :, 2], exact, rtol=1e-4, atol=1e-9)


def test_field_of_unknown_unit_stays_as_it_is_and_says_so(place: Place) -> None:
    values = np.arange(5 * 17, dtype=np.float32).reshape(5, 17)
    field = {"temperature": (FieldInfo("temperature", "node", quantity="temperature"), values)}
    ds = place.ingest(MemoryRun(fields=field), fields=["temperature"])
    assert ds["temperature"].attrs["units"] == "unknown"
    np.testing.assert_array_equal(ds["temperature"][0], values[:, :13])
    assert any(note.startswith("field temperature: no source says its unit") for note in place.summary.notes)


# Reasons to refuse


def nan_at(state: int, node: int) -> MemoryRun:
    run = MemoryRun("bad")
    run.moved[state, node, 1] = np.nan
    return run


def positions() -> MemoryRun:
    run = MemoryRun("bad")
    run.moved += run.mesh.position.astype(np.float32)
    return run


def other_mesh() -> MemoryRun:
    mesh = plate()
    return MemoryRun("bad", mesh=replace(mesh, node_id=mesh.node_id + 1))


REFUSED = {
    "not finite": (lambda: nan_at(3, 5), r"run bad: .*runs.txt: state 3 \(time 0.003 s\), node 105: the displacement is"),
    "positions": (positions, r"run bad: .*in the first state \(time 0 s\) node 112 is displaced by 0.04 m"),
    "time turns back": (lambda: MemoryRun("bad", time=[0, 1, 1, 3, 4]), "state 2 has time 1, the one before 1"),
    "time no number": (lambda: MemoryRun("bad", time=[0, 1, np.nan, 3, 4]), "state 2 has time nan"),
    "no state": (lambda: MemoryRun("bad", time=[]), "holds no state"),
    "no units": (lambda: MemoryRun("bad", units=None), "its files state no units; say them, for example --units"),
    "unknown units": (lambda: MemoryRun("bad", units="mm-h-kg"), "time unit 'h'"),
    "problem": (lambda: MemoryRun("bad", problems=("file 3 is missing",)), "file 3 is missing; mend the run, or take"),
    "end not reached": (lambda: MemoryRun("bad", end_time=8.0), "ends at time 4, its control data asks for 8"),
    "shorter": (lambda: MemoryRun("bad", time=[0, 0.5, 1.0, 1.5, 2.0]), "ends at 0.002 s, run good at 0.004 s"),
    "another mesh": (other_mesh, r"13 nodes, that of the first run 13 \(number 100 is missing\)"),
    "same name": (lambda: MemoryRun("good"), "a run of this name was given already; rename its folder or file"),
    "other parameters": (
        lambda: MemoryRun("bad", parameters={"v": (1.0, "s")}), r"has the parameters v \[s\], run good has none",
    ),
    "name taken": (lambda: MemoryRun("bad", parameters={"time": (1.0, "s")}), "a parameter cannot be called 'time'"),
    "unreadable": (lambda: ReadError("bad.txt: byte 3 is odd"), "byte 3 is odd"),
}  # fmt: skip


@pytest.mark.parametrize("reason", REFUSED)
def test_run_is_refused_with_its_name_and_place(place: Place, reason: str) -> None:
    make, told = REFUSED[reason]
    with pytest.raises(CrashkitError, match=told):
        place.try_ingest(MemoryRun("good"), make())
    assert "out.zarr" not in place.left()


@pytest.mark.parametrize("reason", [r for r in REFUSED if r != "same name"])
def test_refused_run_is_skipped_and_the_rest_goes_on(place: Place, reason: str) -> None:
    make, told = REFUSED[reason]
    ds = place.ingest(MemoryRun("good"), make(), MemoryRun("last"), on_error="skip")
    assert ds["sim"].values.tolist() == ["good", "last"]
    assert len(place.summary.skipped) == 1
    with pytest.raises(DataError, match=told):
        raise DataError("run bad: " + next(iter(place.summary.skipped.values())))
    assert place.left() == {"out.zarr"}


def test_nothing_usable_is_an_error_and_leaves_nothing(place: Place) -> None:
    with pytest.raises(DataError, match=r"no run can be used \(bad: "):
        place.try_ingest(nan_at(2, 2), on_error="skip")
    assert place.left() == set()


def test_incomplete_run_is_taken_if_allowed_and_never_called_good(place: Place) -> None:
    short = MemoryRun("short", time=[0, 1.0, 2.0])
    ds = place.ingest(MemoryRun("whole"), short, allow_incomplete=True)
    assert ds["complete"].values.tolist() == [True, False]
    assert np.isnan(ds["displacement"].values[1, 3:]).all()
    assert np.isfinite(ds["displacement"].values[1, :3]).all()
    assert any("run short is incomplete" in note for note in place.summary.notes)
    assert "run short: found an incomplete run" in "\n".join(map(str, validate(ds)))


def test_times_beyond_a_run_refuse_that_run(place: Place) -> None:
    long = MemoryRun("long", time=np.arange(9.0))
    other = MemoryRun("other", time=np.arange(5.0), end_time=4.0)
    with pytest.raises(DataError, match=r"run other: .*covers 0 to 0.004 s, the dataset's times are 0 to 0.006 s"):
        place.try_ingest(long, other, time=[0, 0.003, 0.006])
    ds = place.ingest(long, other, time=[0, 0.003, 0.006], on_error="skip")
    assert ds["sim"].values.tolist() == ["long"]


def test_names_tell_runs_of_several_sources_apart(tmp_path: Path, memory: RunsInMemory) -> None:
    sources = [memory.put(tmp_path / f"{n}.txt", MemoryRun("run")) for n in ("x", "y")]
    summary = ingest(sources, tmp_path / "out.nc", names="{source}-{run}")
    assert summary.runs == ("x-run", "y-run")
    with pytest.raises(DataError, match=r"names '\{place\}' not understood"):
        ingest(sources, tmp_path / "other.nc", names="{place}")


# Parameter tables


def test_table_gives_parameters_in_dataset_units(place: Place) -> None:
    table = place.folder / "params.csv"
    table.write_text("run,speed [km/h],angle\na,36,1\nb,72,2\nlate,1,1\n")
    own = {"speed": (20.0, "m/s")}
    ds = place.ingest(MemoryRun("a", parameters=own), MemoryRun("b", parameters=own), params=table)
    np.testing.assert_allclose(ds["speed"], [10, 20])
    assert ds["angle"].attrs["units"] == "1"
    told = "\n".join(place.summary.notes)
    assert "run late in the table, but no such run was given" in told
    assert "speed of the table taken instead of the source's own" in told
    assert "angle has no unit and is taken for a plain number" in told


def test_run_without_a_row_is_refused_by_name(place: Place) -> None:
    table = place.folder / "params.csv"
    table.write_text("run,speed [km/h]\na,36\n")
    with pytest.raises(DataError, match=r"run b: .*params.csv: has no row for run b"):
        place.try_ingest(MemoryRun("a"), MemoryRun("b"), params=table)
    assert place.ingest(MemoryRun("a"), MemoryRun("b"), params=table, on_error="skip")["sim"].values.tolist() == ["a"]


# Outputs that cannot be


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("out.txt", "a dataset is called NAME.zarr or NAME.nc"),
        ("nowhere/out.zarr", "does not exist; make it first"),
    ],
)
def test_impossible_output_is_told_before_anything_is_read(place: Place, name: str, told: str) -> None:
    source = place.memory.put(place.folder / "runs.txt", run := MemoryRun())
    with pytest.raises(OutputError, match=told):
        ingest(source, place.folder / name)
    assert run.read_states == []


@pytest.mark.parametrize("suffix", OUTPUTS)
def test_something_else_under_the_name_is_not_touched(place: Place, suffix: str) -> None:
    there = place.folder / f"out{suffix}"
    there.write_text("mine") if suffix == ".nc" else there.mkdir()
    with pytest.raises(OutputError, match="choose another name for the output"):
        place.try_ingest(MemoryRun(), suffix=suffix, overwrite=True)
    assert place.left() == {f"out{suffix}"}


def test_missing_source_is_told(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match="no such file or folder"):
        ingest(tmp_path / "nothing", tmp_path / "out.zarr")


# Readers at fault


class Faulty(MemoryRun):
    """A run whose reader breaks down, or gives something else than it promised."""

    def __init__(self, answer: object) -> None:
        super().__init__("bad")
        self._answer = answer

    def displacement(self, first: int, last: int) -> np.ndarray:
        if isinstance(self._answer, Exception):
            raise self._answer
        return self.moved[first:last, : self._answer]  # type: ignore[misc]


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (
            IndexError("list index out of range"),
            "run bad, displacement of states 0 to 4: cannot be read .*out of range",
        ),
        (OSError(5, "Input/output error"), "run bad, displacement of states 0 to 4: cannot be read"),
        (9, r"run bad: its reader gave displacement of shape \(5, 9, 3\), expected \(5, 17, 3\)"),
    ],
)
def test_reader_at_fault_costs_its_run_only(place: Place, answer: object, told: str) -> None:
    with pytest.raises(ReadError, match=told):
        place.try_ingest(MemoryRun("good"), Faulty(answer))
    assert place.ingest(MemoryRun("good"), Faulty(answer), on_error="skip")["sim"].values.tolist() == ["good"]


def test_two_runs_of_one_row_and_units_nobody_knows_are_refused(place: Place) -> None:
    table = place.folder / "p.csv"
    table.write_text("run,speed [km/h]\n1,36\n")
    with pytest.raises(DataError, match="row 1 could be that of run a_1 and of run b_1; name the rows as the runs"):
        place.ingest(MemoryRun("a_1"), MemoryRun("b_1"), params=table)
    table.write_text("run,speed [m/ss]\n1,36\n")
    with pytest.raises(DataError, match=r"parameter speed: unit 'm/ss' is not known; write one such as m/s, km/h"):
        place.ingest(MemoryRun("1"), params=table)


def test_units_of_a_table_become_si_and_a_negative_speed_is_said(place: Place) -> None:
    table = place.folder / "p.csv"
    table.write_text("run,speed [ft/s],pressure [psi],pulse [m/s^2]\n1,-10,1000,2\n")
    summary = place.try_ingest(MemoryRun("run_001"), params=table)
    assert any("speed is negative in some rows" in n for n in summary.notes)
    assert any("run run_001 has row 1" in n for n in summary.notes)
    with open_dataset(summary.output, chunks=None) as dataset:
        assert float(dataset["speed"][0]) == pytest.approx(-3.048)
        assert float(dataset["pressure"][0]) == pytest.approx(6894757.293)
        assert [dataset[n].attrs["units"] for n in ("speed", "pressure", "pulse")] == ["m s-1", "Pa", "m s-2"]


def test_a_mesh_that_is_no_file_is_refused_even_where_no_mesh_is_needed(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"--mesh is nowhere\.vtp, which is no file"):
        ingest(demo_data(), tmp_path / "out.zarr", mesh="nowhere.vtp")


@pytest.mark.parametrize("names", ["{run.__class__}", "{run:>1000000000}", "{run!r}", "{foo}"])
def test_names_hold_run_and_source_alone(tmp_path: Path, names: str) -> None:
    with pytest.raises(DataError, match=r"not understood .*; expected text with \{run\} and \{source\}"):
        ingest(demo_data(), tmp_path / "out.zarr", names=names)
