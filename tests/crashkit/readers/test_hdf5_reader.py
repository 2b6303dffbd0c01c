"""The HDF5 layout of the public kart data: what is read is what stands in the file, and what cannot be is named."""

from __future__ import annotations

import os
import shutil
from importlib.resources import files
from pathlib import Path

import h5py
import numpy as np
import pytest
import pyvista as pv

from crashkit.errors import ReadError
from crashkit.readers import reader_for
from crashkit.readers._mesh_file import faces_of
from crashkit.readers.base import Parameter

DEMO = Path(str(files("crashkit") / "data" / "kart_demo.h5"))


@pytest.fixture
def campaign(tmp_path, sample):
    """A writable file in the layout, two runs of the sample."""
    path = tmp_path / "runs.h5"
    with h5py.File(path, "w") as file:
        file["kart/displacements"] = np.stack([sample.displacement, 2 * sample.displacement])
        file["kart/displacements"].attrs["units"] = "m"
        file["kart/reference_configuration"] = np.stack([sample.points] * 2)
        file["kart/faces"] = sample.faces
        file["time"] = sample.time
        file["parameter"] = np.array([[10.0, 5.0, 300.0], [20.0, -5.0, 400.0]])
    return path


def read(path: Path, **options):
    return list(reader_for(path).runs(path, **options))


def test_the_embedded_campaign_is_read_as_it_stands():
    runs = read(DEMO)
    with h5py.File(DEMO) as file:
        assert [r.name for r in runs[:2]] == ["run_000", "run_001"]
        assert len(runs) == 36
        run = runs[7]
        np.testing.assert_array_equal(run.displacement(2, 5), file["kart/displacements"][7, 2:5])
        np.testing.assert_array_equal(run.mesh.position, file["kart/reference_configuration"][7].astype(float))
        np.testing.assert_array_equal(run.mesh.face_nodes, file["kart/faces"][:])
        np.testing.assert_array_equal(run.time, file["time"][:])
        speed, angle, stress = file["parameter"][7]
    assert run.parameters == {
        "impact_speed": Parameter(speed, "m s-1"),
        "impact_angle": Parameter(angle, "degree"),
        "yield_stress": Parameter(stress, "MPa"),
    }
    assert run.units == "SI"
    assert run.problems == ()


def test_unnamed_parameters_of_the_kart_group_have_the_documented_names(campaign):
    first, second = read(campaign)
    assert first.parameters["impact_speed"] == Parameter(10.0, "m s-1")
    assert second.parameters["yield_stress"] == Parameter(400.0, "MPa")


def test_unnamed_parameters_of_another_group_are_left_out(campaign):
    with h5py.File(campaign, "a") as file:
        file.move("kart", "car")
    assert read(campaign)[0].parameters == {}


def test_without_units_in_the_file_the_user_must_say(campaign):
    with h5py.File(campaign, "a") as file:
        del file["kart/displacements"].attrs["units"]
    assert read(campaign)[0].units is None


def test_further_fields_are_found_by_their_shape(campaign, sample):
    strain = np.random.default_rng(0).random((2, 3, len(sample.faces)), np.float32)
    velocity = np.random.default_rng(1).random((2, 3, len(sample.points), 3), np.float32)
    with h5py.File(campaign, "a") as file:
        file["kart/plastic_strain"], file["kart/velocity"] = strain, velocity
    run = read(campaign)[1]
    assert (run.fields["plastic_strain"].location, run.fields["velocity"].quantity) == ("face", "velocity")
    np.testing.assert_array_equal(run.field("plastic_strain", 1, 3), strain[1, 1:3])
    np.testing.assert_array_equal(run.field("velocity", 0, 1), velocity[1, :1])


@pytest.mark.parametrize("suffix", [".vtp", ".vtk", ".stl", ".obj"])
def test_faces_come_from_a_mesh_file_beside_the_data(campaign, sample, tmp_path, suffix):
    with h5py.File(campaign, "a") as file:
        del file["kart/faces"]
    mesh = tmp_path / f"mesh{suffix}"
    # In millimetres and turned: only how the nodes are joined is taken from the file.
    turned = (1000 * sample.points) @ np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]])
    pv.PolyData.from_regular_faces(turned, sample.faces).save(mesh)
    np.testing.assert_array_equal(read(campaign, mesh=mesh)[0].mesh.face_nodes, sample.faces)
    assert mesh in read(campaign, mesh=mesh)[0].files


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
@pytest.mark.parametrize("suffix", [".vtp", ".stl"])
def test_a_pipe_in_the_place_of_the_mesh_is_not_opened(sample, tmp_path, suffix):
    os.mkfifo(tmp_path / f"mesh{suffix}")
    with pytest.raises(ReadError, match="no such mesh file"):
        faces_of(tmp_path / f"mesh{suffix}", sample.points)


def test_a_mesh_whose_nodes_stand_in_another_order_is_refused(campaign, sample, tmp_path):
    with h5py.File(campaign, "a") as file:
        del file["kart/faces"]
    shuffled = sample.points[np.random.default_rng(0).permutation(len(sample.points))]
    pv.PolyData.from_regular_faces(shuffled, sample.faces).save(tmp_path / "mesh.vtp")
    with pytest.raises(ReadError, match="nodes stand in another order"):
        read(campaign, mesh=tmp_path / "mesh.vtp")


def test_missing_faces_are_asked_for(campaign):
    with h5py.File(campaign, "a") as file:
        del file["kart/faces"]
    with pytest.raises(ReadError, match=r"no dataset kart/faces.*--mesh FILE"):
        read(campaign)


@pytest.mark.parametrize(
    ("dataset", "value", "message"),
    [
        ("kart/reference_configuration", np.zeros((2, 5, 3)), r"shape \(2, 5, 3\), expected \(2, 162, 3\)"),
        ("time", np.zeros(7), r"/time has shape \(7,\), expected \(3,\) or \(2, 3\)"),
        ("kart/faces", np.full((4, 3), 162), r"face 0 names node 162; expected -1 to 161"),
        ("kart/faces", np.zeros((4, 5), int), r"\(face, 3\) or \(face, 4\)"),
        ("parameter", np.zeros((3, 3)), r"shape \(3, 3\), expected \(2, any\)"),
    ],
)
def test_shapes_that_do_not_fit_are_named(campaign, dataset, value, message):
    with h5py.File(campaign, "a") as file:
        del file[dataset]
        file[dataset] = value
    with pytest.raises(ReadError, match=message):
        read(campaign)


def test_names_that_do_not_fit_the_columns_are_named(campaign):
    with h5py.File(campaign, "a") as file:
        file["parameter"].attrs["names"] = ["speed", "angle"]
    with pytest.raises(ReadError, match="3 columns, 2 names"):
        read(campaign)


def test_a_value_that_is_not_finite_is_found_with_run_state_and_node(campaign):
    with h5py.File(campaign, "a") as file:
        file["kart/displacements"][1, 2, 17, 0] = np.nan
    first, second = read(campaign)
    first.displacement(0, 3)
    with pytest.raises(ReadError, match=r"kart/displacements, run_001, state 2: .* of entry 17 is not a finite number"):
        second.displacement(1, 3)


def test_times_that_do_not_increase_are_a_problem(campaign):
    with h5py.File(campaign, "a") as file:
        file["time"][2] = file["time"][1]
    assert "run_000, state 2: its time 0.015001 is not after" in read(campaign)[0].problems[0]


@pytest.mark.parametrize("share", [0.001, 0.3, 0.999])
def test_a_truncated_file_is_refused(tmp_path, share):
    cut = tmp_path / "cut.h5"
    shutil.copy(DEMO, cut)
    with cut.open("r+b") as stream:
        stream.truncate(int(share * DEMO.stat().st_size))
    with pytest.raises(ReadError, match=r"cut\.h5.*not readable as HDF5.*copy the file again"):
        list(reader_for(cut, "kart-hdf5").runs(cut))
    with pytest.raises(ReadError, match=r"cut\.h5.*cut short or damaged: copy it again"):
        reader_for(cut)


@pytest.fixture
def whole(campaign, sample):
    """The same file with parts, the solver's numbers, erosion, curves, and something nobody reads."""
    faces, states = len(sample.faces), len(sample.time)
    with h5py.File(campaign, "a") as file:
        home = file["kart"]
        home["part"] = np.where(np.arange(faces) % 2, 7, 3)
        home["part_id"] = np.array([7, 3])
        home["part_name"] = np.array(["beam", "box"], dtype=h5py.string_dtype())
        home["node_id"] = np.arange(len(sample.points)) + 1000
        home["element_id"] = np.arange(faces) + 500
        alive = np.ones((2, states, faces), np.uint8)
        alive[1, -1, 0] = 0
        home["alive"] = alive
        file["run"] = np.array([12, 96])
        file["history/time"] = np.linspace(0, 0.01, 5)
        file["history/internal_energy"] = np.arange(10.0).reshape(2, 5)
        file["history/wall_force_x"] = -np.arange(10.0).reshape(2, 5)
        file["pole_x"] = np.zeros(2)
    return campaign


def test_parts_numbers_and_erosion_of_the_file_are_read(whole, sample):
    first, second = read(whole)
    assert (first.name, second.name) == ("run_012", "run_096")
    assert [(p.id, p.name) for p in first.mesh.parts] == [(7, "beam"), (3, "box")]
    assert first.mesh.face_part.tolist()[:2] == [1, 0]
    assert first.mesh.node_id[0] == 1000
    assert first.mesh.face_id[0] == 500
    assert first.alive(0, len(sample.time)).all()
    assert not second.alive(len(sample.time) - 1, len(sample.time))[0, 0]
    assert "alive" not in second.fields


def test_curves_of_the_file_have_what_they_measure(whole):
    history = read(whole)[1].history()
    assert history.time.tolist() == np.linspace(0, 0.01, 5).tolist()
    assert {c.name: c.quantity for c in history.channels} == {"internal_energy": "energy", "wall_force_x": "force"}
    energy = [c.name for c in history.channels].index("internal_energy")
    assert history.values[:, energy].tolist() == [5.0, 6.0, 7.0, 8.0, 9.0]


def test_a_curve_with_a_unit_of_its_own_comes_in_the_unit_of_the_file(whole):
    with h5py.File(whole, "a") as file:
        file["kart/displacements"].attrs["units"] = "m"
        file["history/wall_force_x"].attrs["units"] = "kN"
        file["history/sled_intrusion"] = np.ones((2, 5))
        file["history/sled_intrusion"].attrs["units"] = "mm"
    history = read(whole)[1].history()
    assert {c.name: c.quantity for c in history.channels} == {
        "internal_energy": "energy", "wall_force_x": "force", "sled_intrusion": "length",
    }  # fmt: skip
    force, intrusion = ([c.name for c in history.channels].index(n) for n in ("wall_force_x", "sled_intrusion"))
    assert history.values[:, force].tolist() == [-5000.0, -6000.0, -7000.0, -8000.0, -9000.0]
    assert history.values[0, intrusion] == 0.001


def test_a_curve_in_a_unit_that_is_not_known_is_refused(whole):
    with h5py.File(whole, "a") as file:
        file["kart/displacements"].attrs["units"] = "m"
        file["history/wall_force_x"].attrs["units"] = "blah"
    with pytest.raises(ReadError, match="history/wall_force_x: unit 'blah' is not known"):
        read(whole)[1].history()


def test_what_is_not_read_is_named(whole):
    assert read(whole)[0].left_out == ("pole_x",)


def test_runs_numbered_twice_are_refused(whole):
    with h5py.File(whole, "a") as file:
        file["run"][...] = [5, 5]
    with pytest.raises(ReadError, match="twice"):
        read(whole)


def table(path: Path, names: list[str], units: list[str] | None = None) -> None:
    with h5py.File(path, "a") as file:
        del file["parameter"]
        file["parameter"] = np.arange(2.0 * len(names)).reshape(2, -1)
        file["parameter"].attrs["names"] = names
        if units is not None:
            file["parameter"].attrs["units"] = units


def test_names_of_parameters_are_cleaned_and_their_units_read(campaign):
    table(campaign, ["speed [km/h]", "v/v0", "t (front)", " angle "], ["", "1", "mm", "degree"])
    assert read(campaign)[1].parameters == {
        "speed": Parameter(4.0, "km/h"),
        "v_v0": Parameter(5.0, "1"),
        "t_front": Parameter(6.0, "mm"),
        "angle": Parameter(7.0, "degree"),
    }


@pytest.mark.parametrize(
    ("names", "told"),
    [
        (["speed", "speed"], "columns 'speed' and 'speed' would both be parameter speed"),
        (["v/v0", "v v0"], "columns 'v/v0' and 'v v0' would both be parameter v_v0"),
        (["speed", ""], "'' is no name of a parameter"),
        (["..", "b"], "'..' is no name of a parameter"),
        (["a" * 300, "b"], "has 300 letters; expected at most 100"),
    ],
)
def test_names_of_parameters_that_cannot_be_are_refused(campaign, names, told):
    table(campaign, names)
    with pytest.raises(ReadError, match=told):
        read(campaign)


def test_times_come_from_the_option_where_the_file_has_none(campaign):
    with h5py.File(campaign, "a") as file:
        del file["time"]
    with pytest.raises(ReadError, match="no dataset time; give the time between two states"):
        read(campaign)
    assert read(campaign, time_step=0.5)[1].time.tolist() == [0.0, 0.5, 1.0]


def _unwritten(file: h5py.File) -> None:
    del file["kart/displacements"]
    file.create_dataset("kart/displacements", (2, 3, 162, 3), "f4", chunks=(1, 1, 162, 3))[0] = 1.0


def _never(file: h5py.File) -> None:
    del file["kart/displacements"]
    file.create_dataset("kart/displacements", (2, 3, 162, 3), "f4")


def _virtual(name: str):
    def make(file: h5py.File) -> None:
        del file["kart/displacements"]
        layout = h5py.VirtualLayout((2, 3, 162, 3), "f4")
        layout[0] = h5py.VirtualSource(name, "u", (3, 162, 3))
        if "half" not in name:
            layout[1] = h5py.VirtualSource(name, "u", (3, 162, 3))
        file.create_virtual_dataset("kart/displacements", layout)

    return make


def _raw(file: h5py.File) -> None:
    del file["kart/displacements"]
    file.create_dataset("kart/displacements", (2, 3, 162, 3), "f4", external=[("raw.bin", 0, h5py.h5f.UNLIMITED)])


def _outside(file: h5py.File) -> None:
    del file["kart/displacements"]
    file["kart/displacements"] = h5py.ExternalLink("../elsewhere.h5", "both")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (_unwritten, "3 of its 6 chunks were never written"),
        (_never, "its values were never written"),
        (_virtual("nowhere.h5"), "takes values from nowhere.h5, which is not there"),
        (_virtual("half.h5"), "of its 2916 values are in none of its sources"),
        (_raw, "as raw bytes, which is not read; repack it"),
        (_outside, "outside the folder of the file; copy it there"),
    ],
)
def test_values_that_are_absent_are_refused_instead_of_zero(campaign, sample, tmp_path, change, told):
    folder = tmp_path / "source"
    folder.mkdir()
    path = campaign.rename(folder / "runs.h5")
    for name in ("elsewhere.h5", "source/half.h5"):
        with h5py.File(tmp_path / name, "w") as file:
            file["u"], file["both"] = sample.displacement, np.stack([sample.displacement] * 2)
    with h5py.File(path, "a") as file:
        change(file)
    with pytest.raises(ReadError, match=told):
        read(path)


@pytest.mark.parametrize("link", [True, False])
def test_files_behind_links_and_virtual_datasets_are_sources(campaign, sample, tmp_path, link):
    beside = tmp_path / "values.h5"
    with h5py.File(beside, "w") as file:
        file["u"], file["both"] = sample.displacement, np.stack([sample.displacement] * 2)
    with h5py.File(campaign, "a") as file:
        if link:
            del file["kart/displacements"]
            file["kart/displacements"] = h5py.ExternalLink("values.h5", "both")
        else:
            _virtual("values.h5")(file)
    run = read(campaign)[1]
    np.testing.assert_array_equal(run.displacement(0, 3), sample.displacement)
    assert {f.name for f in run.files} == {"runs.h5", "values.h5"}
