"""XDMF time series and numbered files, written by meshio."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import pytest

from crashkit.errors import CrashkitError, ReadError
from crashkit.readers import reader_for


@pytest.fixture(params=["XML", "HDF"])
def series(request, tmp_path, sample, monkeypatch) -> Path:
    path = tmp_path / "run.xdmf"
    monkeypatch.chdir(tmp_path)
    strain = np.arange(360.0).reshape(3, 120)
    with meshio.xdmf.TimeSeriesWriter(path, data_format=request.param) as writer:
        writer.write_points_cells(sample.points, [("triangle", sample.faces)])
        for state, time in enumerate(sample.time):
            writer.write_data(
                time,
                point_data={"displacement": sample.displacement[state]},
                cell_data={"plastic_strain": [strain[state]]},
            )
    return path


def test_an_xdmf_series_is_read_as_written(series, only_run, sample):
    run = only_run(series)
    np.testing.assert_allclose(run.time, sample.time)
    np.testing.assert_array_equal(run.mesh.position, sample.points)
    np.testing.assert_array_equal(run.mesh.face_nodes, sample.faces)
    np.testing.assert_allclose(run.displacement(1, 3), sample.displacement[1:], atol=1e-9)
    np.testing.assert_array_equal(run.field("plastic_strain", 2, 3), [np.arange(240.0, 360.0)])


def test_the_heavy_data_is_among_the_files(series, only_run):
    names = {f.name for f in only_run(series).files}
    assert names == ({"run.xdmf", "run.h5"} if (series.parent / "run.h5").exists() else {"run.xdmf"})


XDMF = """<Xdmf Version="3.0"><Domain>
<Grid Name="t" GridType="Collection" CollectionType="Temporal">{grids}</Grid>
</Domain></Xdmf>"""
GRID = """<Grid Name="mesh" GridType="Uniform"><Time Value="{time}"/>
<Topology TopologyType="Triangle" NumberOfElements="1">
<DataItem DataType="Int" Dimensions="1 3" Format="XML" Precision="8">0 1 2</DataItem></Topology>
<Geometry GeometryType="XYZ">
<DataItem DataType="Float" Dimensions="3 3" Format="XML" Precision="8">0 0 {z} 1 0 {z} 0 1 {z}</DataItem>
</Geometry></Grid>"""


def test_states_with_a_mesh_of_their_own_move(tmp_path, only_run):
    """meshio by itself takes the first state's points for all."""
    grids = "".join(GRID.format(time=t, z=z) for t, z in [(0, 0), (0.5, 0.25), (1, 2)])
    (tmp_path / "run.xdmf").write_text(XDMF.format(grids=grids))
    run = only_run(tmp_path)
    assert run.displacement(0, 3)[:, :, 2].tolist() == [[0] * 3, [0.25] * 3, [2] * 3]


def test_a_state_without_time_is_refused(tmp_path):
    grids = GRID.format(time=0, z=0) + GRID.format(time=1, z=1).replace('<Time Value="1"/>', "")
    (tmp_path / "run.xdmf").write_text(XDMF.format(grids=grids))
    with pytest.raises(ReadError, match="1 of its states have no time"):
        next(reader_for(tmp_path).runs(tmp_path))


@pytest.mark.parametrize("share", [0.2, 0.5, 0.95])
def test_a_truncated_series_is_refused(series, share):
    for file in series.parent.iterdir():
        file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    with pytest.raises(ReadError, match=r"run\.xdmf"):
        next(reader_for(series, "meshio").runs(series)).displacement(0, 3)


def test_missing_heavy_data_is_refused(series, sample):
    if (series.parent / "run.h5").exists():
        (series.parent / "run.h5").unlink()
    else:
        series.write_text(series.read_text().replace("</Domain>", ""))
    with pytest.raises(ReadError, match=r"run\.xdmf"):
        next(reader_for(series, "meshio").runs(series))


@pytest.mark.parametrize("suffix", [".ply", ".med", ".inp", ".msh"])
def test_numbered_files_of_other_formats_are_read_by_name(tmp_path, only_run, sample, suffix):
    for state in range(3):
        mesh = meshio.Mesh(sample.points + sample.displacement[state], [("triangle", sample.faces)])
        mesh.write(tmp_path / f"kart_{state}{suffix}")
    run = only_run(tmp_path, "meshio", time_step=0.015)
    np.testing.assert_allclose(run.time, [0, 0.015, 0.03])
    np.testing.assert_allclose(run.displacement(0, 3), sample.displacement, atol=1e-6)


def test_numbered_files_need_a_time_step(tmp_path, sample):
    for state in range(2):
        meshio.Mesh(sample.points, [("triangle", sample.faces)]).write(tmp_path / f"kart_{state}.ply")
    with pytest.raises(CrashkitError, match=r"hold no times; give the time between two of them \(--time-step\)"):
        reader_for(tmp_path, "meshio").runs(tmp_path)


def test_a_damaged_file_is_named(tmp_path, only_run, sample):
    for state in range(2):
        meshio.Mesh(sample.points + state, [("triangle", sample.faces)]).write(tmp_path / f"kart_{state}.ply")
    (tmp_path / "kart_1.ply").write_bytes((tmp_path / "kart_1.ply").read_bytes()[:500])
    with pytest.raises(ReadError, match=r"kart_1\.ply"):
        only_run(tmp_path, "meshio", time_step=1)


def test_states_without_times_are_read_with_a_time_step(tmp_path, only_run):
    grids = "".join(GRID.format(time=k, z=k).replace(f'<Time Value="{k}"/>', "") for k in range(3))
    (tmp_path / "run.xdmf").write_text(XDMF.format(grids=grids))
    assert only_run(tmp_path, time_step=0.5).time.tolist() == [0.0, 0.5, 1.0]
    with pytest.raises(ReadError, match=r"its 3 states have no time; give the time between two \(--time-step\)"):
        only_run(tmp_path)


def test_a_checkpoint_of_fenics_is_called_by_its_name(tmp_path, only_run):
    function = '<Attribute ItemType="FiniteElementFunction" ElementFamily="CG" ElementDegree="1" Name="u"/></Grid>'
    grids = "".join(GRID.format(time=k, z=k).replace("</Grid>", function) for k in range(2))
    (tmp_path / "u.xdmf").write_text(XDMF.format(grids=grids))
    with pytest.raises(ReadError, match="is a checkpoint of FEniCS") as caught:
        only_run(tmp_path)
    assert "damaged" not in str(caught.value)


def test_functions_in_time_series_of_their_own_are_taken_together(tmp_path, only_run, sample):
    """dolfinx writes the mesh once, and one time series for every function."""

    def rows(values: np.ndarray) -> str:
        return " ".join(f"{v:.9g}" for v in np.ravel(values))

    def item(values: np.ndarray, kind: str = "Float") -> str:
        shape = " ".join(map(str, values.shape))
        return f'<DataItem DataType="{kind}" Dimensions="{shape}" Format="XML">{rows(values)}</DataItem>'

    def series(name: str, kind: str, arrays: list[np.ndarray]) -> str:
        states = "".join(
            f'<Grid GridType="Uniform"><Time Value="{t}"/><Attribute Name="{name}" AttributeType="{kind}" Center="Node">'
            f"{item(values)}</Attribute></Grid>"
            for t, values in zip(sample.time, arrays, strict=True)
        )
        return f'<Grid GridType="Collection" CollectionType="Temporal">{states}</Grid>'

    mesh = (
        f'<Grid GridType="Uniform"><Topology TopologyType="Triangle">{item(sample.faces, "Int")}</Topology>'
        f'<Geometry GeometryType="XYZ">{item(sample.points)}</Geometry></Grid>'
    )
    heat = [np.full(162, float(k)) for k in range(3)]
    both = series("displacement", "Vector", list(sample.displacement)) + series("heat", "Scalar", heat)
    (tmp_path / "run.xdmf").write_text(f'<Xdmf Version="3.0"><Domain>{mesh}{both}</Domain></Xdmf>')
    run = only_run(tmp_path)
    np.testing.assert_allclose(run.displacement(0, 3), sample.displacement, atol=1e-8)
    assert run.field("heat", 2, 3)[0, 0] == 2
