"""ParaView files are read back with VTK's own readers: what comes out is what went in, in every state."""

from __future__ import annotations

import ast
import gc
import resource
import subprocess
import sys
import weakref
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

import h5py
import numpy as np
import pytest
import pyvista as pv
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from vtkmodules.vtkCommonCore import vtkDataArray
from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline
from vtkmodules.vtkIOHDF import vtkHDFReader

from crashkit.errors import DataError, OutputError, ReadError
from crashkit.writers.paraview import State, read_state, write_paraview, write_states

# A square and a triangle on one edge, and two lone edges: everything a mesh of ours can hold.
POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0.5, 0], [3, 0.5, 1]], float)
FACES = np.array([[0, 1, 2, 3], [1, 4, 2, -1]])
LINES = np.array([[4, 5], [3, 0]])
TIME = np.array([0.0, 0.0003, 0.1])


def read(path: Path) -> tuple[list[float], Iterator[pv.DataSet]]:
    """Times, and the mesh of every state, through VTK's readers alone."""
    if path.suffix == ".pvd":
        reader = pv.PVDReader(str(path))

        def pvd_states() -> Iterator[pv.DataSet]:
            for k in range(len(reader.time_values)):
                reader.set_active_time_point(k)
                yield reader.read()[0]

        return list(reader.time_values), pvd_states()
    hdf = vtkHDFReader()
    hdf.SetFileName(str(path))
    hdf.UpdateInformation()
    times = hdf.GetOutputInformation(0).Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS())

    def hdf_states() -> Iterator[pv.DataSet]:
        for time in times:
            hdf.UpdateTimeStep(time)
            yield pv.wrap(hdf.GetOutputDataObject(0)).copy()

    return list(times), hdf_states()


@pytest.fixture(scope="module")
def kart() -> dict[str, np.ndarray]:
    with h5py.File(str(files("crashkit") / "data" / "kart_demo.h5")) as file:
        return {
            "points": file["kart/reference_configuration"][3],
            "faces": file["kart/faces"][:],
            "displacement": file["kart/displacements"][3],
            "time": file["time"][:],
        }


@pytest.mark.parametrize("deform", [False, True])
@pytest.mark.parametrize("suffix", [".pvd", ".vtkhdf"])
def test_every_state_of_a_crash_comes_back(tmp_path, kart, suffix, deform):
    u, kept = kart["displacement"], np.arange(len(kart["points"])) % 8 == 0
    strain = np.linalg.norm(u[:, kart["faces"][:, 0]], axis=-1)
    written = write_paraview(
        tmp_path / f"run{suffix}", kart["points"], kart["faces"], kart["time"],
        {"displacement": u, "kept": kept}, {"strain": strain}, deform=deform,
    )  # fmt: skip
    times, states = read(written[0])
    assert times == kart["time"].tolist()
    for k, state in enumerate(states):
        np.testing.assert_array_equal(state["displacement"], u[k])
        np.testing.assert_array_equal(state["kept"], kept)
        np.testing.assert_array_equal(state.cell_data["strain"], strain[k])
        np.testing.assert_array_equal(state.cells_dict[pv.CellType.TRIANGLE], kart["faces"])
        np.testing.assert_array_equal(state.points, kart["points"] + u[k] if deform else kart["points"])
    assert k == len(times) - 1


numbers = st.sampled_from([np.float32, np.float64, np.int32, np.int64, np.uint8, np.bool_])


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    dtype=numbers,
    over_time=st.booleans(),
    components=st.sampled_from([(), (1,), (3,), (6,)]),
    on_cells=st.booleans(),
    suffix=st.sampled_from([".pvd", ".vtkhdf"]),
    seed=st.integers(0, 99),
)
def test_any_array_on_a_mixed_mesh_comes_back(tmp_path, dtype, over_time, components, on_cells, suffix, seed):
    size = 4 if on_cells else len(POINTS)
    shape = ((3,) if over_time else ()) + (size, *components)
    values = (np.random.default_rng(seed).normal(size=shape) * 100).astype(np.int8).astype(dtype)
    where = {"cell_data" if on_cells else "point_data": {"some field": values}}
    path = write_paraview(tmp_path / f"mixed{suffix}", POINTS, FACES, TIME, lines=LINES, **where)[0]
    _, states = read(path)
    for k, state in enumerate(states):
        expected = values[k] if over_time else values
        found = (state.cell_data if on_cells else state.point_data)["some field"]
        np.testing.assert_array_equal(found.reshape(expected.shape), expected)
        assert state.celltypes.tolist() == [pv.CellType.QUAD, pv.CellType.TRIANGLE, pv.CellType.LINE, pv.CellType.LINE]
        assert state.cell_connectivity.tolist() == [0, 1, 2, 3, 1, 4, 2, 4, 5, 3, 0]


def test_vtkhdf_keeps_mesh_and_constant_arrays_once(tmp_path, kart):
    n, m = len(kart["points"]), len(kart["faces"])
    write_paraview(
        tmp_path / "run.vtkhdf", kart["points"], kart["faces"], kart["time"],
        {"displacement": kart["displacement"], "kept": np.zeros(n)}, units={"displacement": "m"},
    )  # fmt: skip
    with h5py.File(tmp_path / "run.vtkhdf") as file:
        root = file["VTKHDF"]
        assert root["Points"].shape == (n, 3)
        assert root["Connectivity"].shape == (3 * m,)
        assert root["PointData/kept"].shape == (n,)
        assert root["PointData/displacement"].shape == (len(kart["time"]) * n, 3)
        assert root["PointData/displacement"].attrs["units"] == "m"


@pytest.mark.parametrize("suffix", [".vtu", ".vtp"])
def test_one_state_keeps_cells_units_and_time(tmp_path, suffix):
    length = np.array([4.0, 3.0, 2.0, 1.0])
    write_paraview(
        tmp_path / f"one{suffix}", POINTS, FACES, [0.02], {"error": np.arange(6.0)}, {"length": length},
        lines=LINES, units={"error": "m"},
    )  # fmt: skip
    mesh = pv.read(tmp_path / f"one{suffix}")
    by_corners = {tuple(mesh.get_cell(i).point_ids): mesh.cell_data["length"][i] for i in range(4)}
    assert by_corners == {(0, 1, 2, 3): 4.0, (1, 4, 2): 3.0, (4, 5): 2.0, (3, 0): 1.0}
    assert mesh.field_data["TimeValue"].tolist() == [0.02]
    unit = mesh.GetPointData().GetArray("error").GetInformation().Get(vtkDataArray.UNITS_LABEL())
    assert unit == "m"


@pytest.mark.parametrize("suffix", [".pvd", ".vtkhdf"])
def test_eroded_faces_are_hidden_and_their_nodes_stay_where_they_were(tmp_path, suffix):
    u = np.zeros((3, 6, 3))
    u[:, :, 0] = np.array([0.0, 0.1, 0.2])[:, None]
    u[2, 4] = np.nan
    alive = np.array([[True, True], [True, True], [True, False]])
    written = write_paraview(
        tmp_path / f"run{suffix}", POINTS, FACES, TIME, {"displacement": u}, alive=alive, deform=True, lines=LINES
    )
    _, states = read(written[0])
    last = list(states)[-1]
    assert last.cell_data["alive"].tolist() == [1, 0, 1, 1]
    assert last.extract_surface(algorithm="dataset_surface").n_cells == 3
    np.testing.assert_allclose(last.points[4], POINTS[4] + [0.1, 0, 0])
    assert np.isnan(last["displacement"][4]).all()


def test_states_are_taken_one_after_the_other(tmp_path):
    living: list[weakref.ref] = []

    def states() -> Iterator[State]:
        for k in range(len(TIME)):
            gc.collect()
            assert sum(ref() is not None for ref in living) <= 1
            values = np.full(len(POINTS), float(k))
            living.append(weakref.ref(values))
            yield State({"level": values})

    path = write_states(tmp_path / "run.vtkhdf", POINTS, FACES, TIME, states(), State({"number": np.arange(6)}))[0]
    _, read_back = read(path)
    assert [state["level"][0] for state in read_back] == [0.0, 1.0, 2.0]


@pytest.mark.parametrize("suffix", [".pvd", ".vtkhdf"])
@pytest.mark.parametrize(
    ("levels", "message"),
    [([1, 1], "2 states for 3 times"), ([1, 1, 1, 1], "more states than the 3 times"), ([1, 1, 2], "state 2 changes")],
)
def test_states_that_do_not_fit_leave_the_old_file_alone(tmp_path, suffix, levels, message):
    path = tmp_path / f"run{suffix}"
    write_paraview(path, POINTS, FACES, TIME, {"level": np.zeros((3, 6))})
    before = sorted(p.name for p in tmp_path.rglob("*"))
    content = path.read_bytes()
    with pytest.raises(DataError, match=message):
        write_states(path, POINTS, FACES, TIME, (State({"level": np.zeros((6, k))}) for k in levels))
    assert path.read_bytes() == content
    assert sorted(p.name for p in tmp_path.rglob("*")) == before


@pytest.mark.parametrize("suffix", [".pvd", ".vtkhdf"])
def test_one_state_can_be_asked_for(tmp_path, suffix):
    path = write_paraview(tmp_path / f"run{suffix}", POINTS, FACES, TIME, {"level": np.arange(18.0).reshape(3, 6)})[0]
    for state in (0, 1, -1):
        time, mesh = read_state(path, state)
        assert time == TIME[state]
        np.testing.assert_array_equal(mesh["level"], np.arange(18.0).reshape(3, 6)[state])
    with pytest.raises(ReadError, match="state 3 asked for; it has 3 states"):
        read_state(path, 3)
    with pytest.raises(ReadError, match=r"expected a \.pvd or \.vtkhdf file that is there"):
        read_state(tmp_path / "missing.pvd")


def test_a_shorter_run_replaces_all_states_of_the_longer_one(tmp_path):
    write_paraview(tmp_path / "run.pvd", POINTS, FACES, TIME)
    write_paraview(tmp_path / "run.pvd", POINTS, FACES, TIME[:2])
    assert sorted(p.name for p in (tmp_path / "run_states").iterdir()) == ["run_000.vtu", "run_001.vtu"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": POINTS[:, :2]}, r"points have shape \(6, 2\): expected \(n, 3\)"),
        ({"points": np.where(POINTS == 3, np.nan, POINTS)}, "point 5 is not finite"),
        ({"points": POINTS[:0], "faces": FACES[:0]}, "no points"),
        ({"faces": FACES + 3}, r"faces name the nodes 2 to 7: expected 0 to 5"),
        ({"faces": np.array([[0, -1, 1]])}, "-1 only in the last of four corners"),
        ({"faces": FACES.astype(float)}, "expected integers"),
        ({"lines": np.array([[0, -1]])}, "lines name the nodes -1 to 0"),
        ({"time": [0.0, 0.2, 0.1]}, "expected a row of increasing times"),
        ({"point_data": {"u": np.zeros((4, 6))}}, r"array 'u' has shape \(4, 6\): expected 3 states x 6 points"),
        ({"time": [0, 1], "cell_data": {"s": np.zeros((2, 2))}}, r"'s' has shape \(2, 2\): .* Give it a third axis"),
        ({"cell_data": {"s": np.zeros((3, 6))}}, "expected 3 states x 2 cells"),
        ({"point_data": {"u/v": np.zeros(6)}}, "expected a name without '/'"),
        ({"point_data": {"u": np.array(["a"] * 6)}}, "expected numbers"),
        ({"alive": np.ones((3, 3), bool)}, "expected 3 states and 2 faces"),
        ({"deform": True}, "deform asked for without a point array 'displacement'"),
    ],
)
def test_arrays_that_do_not_belong_together_are_refused(tmp_path, change, message):
    arguments = {"points": POINTS, "faces": FACES, "time": TIME} | change
    with pytest.raises(DataError, match=message) as refused:
        write_paraview(tmp_path / "run.vtkhdf", **arguments)
    assert "\n" not in str(refused.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("file/run.pvd", "file/run.pvd: cannot be written: .*; choose another place"),
        ("folder.pvd", "is a folder: expected the name of a file"),
        ("run.vtk", r"suffix '.vtk': expected one of .pvd, .vtkhdf, .vtu, .vtp"),
        ("run", "suffix 'missing'"),
        ("run.vtu", "3 states: a .vtu file holds one; take .pvd or .vtkhdf"),
        ("taken.pvd", "holds letter.txt, which is no state of taken: choose another name"),
    ],
)
def test_places_that_cannot_be_written_are_named(tmp_path, name, message):
    (tmp_path / "file").write_text("a file")
    (tmp_path / "folder.pvd").mkdir()
    (tmp_path / "taken_states").mkdir()
    (tmp_path / "taken_states" / "letter.txt").write_text("not ours")
    with pytest.raises(OutputError, match=message):
        write_paraview(tmp_path / name, POINTS, FACES, TIME)
    assert (tmp_path / "taken_states" / "letter.txt").read_text() == "not ours"


@pytest.mark.parametrize("suffix", [".pvd", ".vtkhdf"])
def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path, suffix):
    script = (
        "import numpy as np, sys\n"
        "from crashkit.errors import OutputError\n"
        "from crashkit.writers.paraview import write_paraview\n"
        "points = np.random.default_rng(0).normal(size=(20000, 3))\n"
        "try:\n"
        "    write_paraview(sys.argv[1], points, np.array([[0, 1, 2]]), [0.0, 1.0])\n"
        "except OutputError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path / f"run{suffix}")],
        capture_output=True, text=True, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000)),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "cannot be written" in done.stdout
    assert done.stdout.count("\n") == 1
    assert done.stderr == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".pvd", ".vtkhdf", ".vtu"])
def test_what_belongs_to_the_whole_file_comes_back_in_every_state(tmp_path, suffix):
    about = {"impact_speed": 22.0, "model": "MH1 of mh", "part_name": ["floor", "Längsträger"], "part_ids": [7, 9]}
    time = TIME[:1] if suffix == ".vtu" else TIME
    u = np.zeros((len(time), 6, 3))
    file = write_paraview(tmp_path / f"run{suffix}", POINTS, FACES, time, {"displacement": u}, field_data=about)[0]
    states = [pv.read(file)] if suffix == ".vtu" else read(file)[1]
    for mesh in states:
        assert mesh.field_data["impact_speed"].tolist() == [22.0]
        assert list(mesh.field_data["model"]) == ["MH1 of mh"]
        assert list(mesh.field_data["part_name"]) == ["floor", "Längsträger"]
        assert mesh.field_data["part_ids"].tolist() == [7, 9]


class _Recorder:
    """Stands in for paraview.simple: everything can be called, and calls are noted."""

    def __init__(self, calls, name=""):
        self._calls, self._name = calls, name

    def __call__(self, *args, **named):
        self._calls.append((self._name, args, named))
        return _Recorder(self._calls, self._name)

    def __getattr__(self, name):
        return _Recorder(self._calls, name)


@pytest.mark.parametrize("suffix", [".pvd", ".vtkhdf"])
def test_the_script_beside_a_run_shows_it_in_colours_that_hold_for_all_states(tmp_path, suffix):
    rng = np.random.default_rng(0)
    u, error = rng.normal(size=(3, 6, 3)), rng.uniform(size=(3, 6))
    error[1, 2] = np.nan
    files = write_paraview(
        tmp_path / f"run{suffix}", POINTS, FACES, TIME, {"displacement": u, "error": error, "node_id": np.arange(6)},
        units={"error": "m"},
    )  # fmt: skip
    script = tmp_path / "run_view.py"
    assert script in files
    calls = []
    names = "OpenDataFile WarpByVector GetActiveViewOrCreate Show ColorBy GetColorTransferFunction GetScalarBar"
    names += " GetAnimationScene ResetCamera Render"
    stand_in = {n: _Recorder(calls, n) for n in names.split()}
    code = script.read_text(encoding="utf-8").replace("from paraview.simple import *", "")
    exec(compile(code, str(script), "exec"), {**stand_in, "__file__": str(script)})
    asked = {name: (args, named) for name, args, named in calls}
    assert asked["OpenDataFile"][0] == (str(tmp_path / f"run{suffix}"),)
    assert asked["WarpByVector"][1]["Vectors"] == ["POINTS", "displacement"]
    assert asked["ColorBy"][0][1] == ("POINTS", "error")
    low, high = asked["RescaleTransferFunction"][0]
    assert (low, high) == (pytest.approx(np.nanmin(error)), pytest.approx(np.nanmax(error)))


def test_names_of_strangers_do_nothing_in_the_script():
    from crashkit.writers.paraview_view import ValueRanges, view_script

    evil = "x'\nimport os; os.abort() #"
    ranges = ValueRanges()
    ranges.note({evil: np.ones((2, 3))}, {})
    code = view_script(evil, ranges, {evil: evil})
    names = [node.names[0].name for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Import)]
    assert names == ["os"]


def test_points_far_from_the_origin_keep_their_precision(tmp_path):
    far = POINTS + 1e6
    for points, expected in ((POINTS, np.float32), (far, np.float64)):
        file = write_paraview(tmp_path / "one.vtu", points, FACES, [0.0], {})[0]
        assert pv.read(file).points.dtype == expected
