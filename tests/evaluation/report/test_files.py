"""ParaView files of an evaluation, read back with VTK: all states, truth, prediction, error, levels."""

from __future__ import annotations

import numpy as np
import pytest
import pyvista as pv

from data_schema.edges import without_sides
from evaluation.report.files import coarsest_level, default_runs, write_run

# The toy structure is 1 m long: predictions are rounded to less than 5e-5 of it.
ROUNDED = 5e-5


@pytest.fixture(scope="module")
def written(evaluation, tmp_path_factory):
    folder = tmp_path_factory.mktemp("vtk")
    return folder, write_run(evaluation, 9, folder, (".pvd", ".vtkhdf"))


def test_the_run_and_each_coarse_mesh_has_both_formats(written):
    folder, files = written
    assert sorted(p.name for p in files) == sorted(
        f"run_09{name}.{suffix}"
        for name in ("", "_mh_level1", "_mh_level2", "_mh_level3")
        for suffix in ("pvd", "vtkhdf")
    )
    assert all(p.parent == folder and p.exists() for p in files)


def test_all_states_come_back_from_pvd(written, reference, models):
    reader = pv.get_reader(str(written[0] / "run_09.pvd"))
    np.testing.assert_allclose(reader.time_values, reference.time)
    finest = models[0].predictors[0].predict(reference.parameters[9], reference.time)
    for state, time in enumerate(reader.time_values):
        reader.set_active_time_value(time)
        mesh = reader.read()[0]
        np.testing.assert_array_equal(mesh["displacement"], reference.displacement(9)[state])
        predicted = mesh["predicted_MH1"]
        np.testing.assert_allclose(predicted[reference.level(1).kept], finest[state], atol=ROUNDED)
        distance = np.linalg.norm(predicted - mesh["displacement"], axis=1)
        np.testing.assert_allclose(mesh["error_MH1"], distance, atol=2 * ROUNDED)
        coarsest = predicted - mesh["contribution_MH2"] - mesh["contribution_MH1"]
        expected = models[0].predictors[2].predict(reference.parameters[9], reference.time)[state]
        np.testing.assert_allclose(coarsest[reference.level(3).kept], expected, atol=3 * ROUNDED)
        assert {"predicted_PODNN", "error_PODNN", "predicted_POD-GPR", "error_POD-GPR"} <= set(mesh.point_data)
        np.testing.assert_array_equal(mesh["node_id"], reference.node_id)
        np.testing.assert_array_equal(mesh["part_id"], reference.part_id[reference.face_part])
        assert list(mesh.field_data["run"]) == [reference.runs[9]]
        assert list(mesh.field_data["part_name"]) == list(reference.part_names)
        assert np.unique(mesh["coarsest_level"]).tolist() == [0, 1, 2, 3]


def test_all_states_come_back_from_vtkhdf(written, reference):
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOHDF import vtkHDFReader

    reader = vtkHDFReader()
    reader.SetFileName(str(written[0] / "run_09.vtkhdf"))
    reader.UpdateInformation()
    assert reader.GetNumberOfSteps() == len(reference.time)
    for state in range(reader.GetNumberOfSteps()):
        reader.SetStep(state)
        reader.Update()
        values = vtk_to_numpy(reader.GetOutputDataObject(0).GetPointData().GetArray("displacement"))
        np.testing.assert_array_equal(values, reference.displacement(9)[state])


def test_the_coarse_mesh_stands_alone(written, reference, models):
    reader = pv.get_reader(str(written[0] / "run_09_mh_level2.pvd"))
    reader.set_active_time_value(reader.time_values[-1])
    mesh = reader.read()[0]
    level = reference.level(2)
    np.testing.assert_allclose(mesh.points, reference.position[level.kept], atol=1e-6)
    np.testing.assert_array_equal(mesh["node_id"], reference.node_id[level.kept])
    assert mesh.n_cells == len(level.faces) + len(without_sides(level.edges, level.faces))
    expected = models[0].predictors[1].predict(reference.parameters[9], reference.time)[-1]
    np.testing.assert_allclose(mesh["predicted"], expected, atol=ROUNDED)


def test_levels_are_nested_in_the_marked_nodes(reference):
    marked = coarsest_level(reference)
    for level in reference.levels:
        assert (marked >= level.index).sum() == level.n_nodes


def test_the_worst_and_the_median_run_of_the_best_model_are_written(evaluation):
    errors = evaluation.scores[evaluation.ranked[0].label].of_runs
    order = np.argsort(errors)
    assert default_runs(evaluation) == (9 + order[2], 9 + order[1])
