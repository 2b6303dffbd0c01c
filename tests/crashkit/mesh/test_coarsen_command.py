"""`crashkit coarsen` on a small dataset: the table, JSON, picture, VTP, and every wrong use in one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
from test_hierarchy_store import campaign, write
from typer.testing import CliRunner

import crashkit
from crashkit.cli import app
from crashkit.errors import MeshError
from crashkit.mesh import open_hierarchy


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write(campaign(), tmp_path / "crash.nc")
    return tmp_path / "crash.nc"


def run(*arguments: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, ["coarsen", *map(str, arguments)])
    return result.exit_code, result.stdout, result.stderr


def test_levels_are_stored_and_told_with_their_lifting_errors(path: Path) -> None:
    code, out, _ = run(path, "--nodes", "120,30")
    assert code == 0
    assert [level.n_nodes for level in open_hierarchy(path).levels] == [120, 30]
    assert f"interpolation errors over all {campaign().sizes['sim']} runs" in out.replace("\n", " ")


def test_interpolation_errors_leave_test_runs_out(path: Path) -> None:
    runs = campaign().sizes["sim"]
    errors = {}
    for test in ("", "0:1", f"1:{runs}"):
        code, out, _ = run(path, "--nodes", "120", *(("--test", test) if test else ()), "--json")
        assert code == 0
        told = json.loads(out)
        errors[test] = told["levels"][0]["lifting_error_mean"]
    assert told["interpolation_errors_over"] == "1 training run"
    assert errors[""] == pytest.approx(((runs - 1) * errors["0:1"] + errors[f"1:{runs}"]) / runs, rel=1e-5)
    code, _, err = run(path, "--nodes", "120", "--test", "nobody")
    assert code == 1
    assert "nobody" in err


def test_the_default_keeps_an_eighth_a_quarter_and_a_quarter(path: Path) -> None:
    assert run(path)[0] == 0
    assert [level.n_nodes for level in open_hierarchy(path).levels] == [300, 75, 19]


def test_ratios_and_json(path: Path) -> None:
    code, out, _ = run(path, "--ratios", "20,4", "--selection", "vtk", "--pair-distance", "0.01", "--json")
    assert code == 0
    told = json.loads(out)
    assert [row["nodes"] for row in told["levels"]] == [120, 30]
    assert told["settings"] == {"selection": "vtk", "pair_distance": 0.01, "counts": [120, 30]}
    assert 0 < told["levels"][0]["lifting_error_mean"] < told["levels"][1]["lifting_error_mean"]


def test_a_picture_shows_all_levels_side_by_side(path: Path, tmp_path: Path) -> None:
    from PIL import Image

    assert run(path, "--nodes", "120,30", "--picture", tmp_path / "new" / "levels.png")[0] == 0
    image = np.asarray(Image.open(tmp_path / "new" / "levels.png").convert("RGB")).astype(int)
    red = (image[..., 0] > 150) & (image[..., 1] < 80)
    thirds = np.array_split(red, 3, axis=1)
    assert thirds[0].sum() == 0  # the full mesh has no marks
    assert thirds[1].sum() > thirds[2].sum() > 0


def test_every_level_is_a_vtp_with_node_ids_and_probe_weights(path: Path, tmp_path: Path) -> None:
    assert run(path, "--nodes", "120,30", "--vtp", tmp_path / "levels")[0] == 0
    hierarchy = open_hierarchy(path)
    full, one, two = (pv.read(tmp_path / "levels" / f"level_{k}.vtp") for k in range(3))
    assert [m.n_points for m in (full, one, two)] == [2400, 120, 30]
    assert (one["node_id"] == hierarchy[1].kept + 1).all()
    assert (two.points == full.points[two["node"]]).all()
    assert set(np.unique(full["coarsest_level"])) == {0, 1, 2}
    for fine in (full, one):
        nodes, weights = fine["level_2_nodes"], fine["level_2_weights"]
        assert weights.sum(axis=1) == pytest.approx(1.0)
        closest = np.einsum("nk,nkx->nx", weights, two.points[nodes])
        distance = np.linalg.norm(closest - fine.points, axis=1)
        assert distance == pytest.approx(fine["level_2_distance"], abs=1e-6)
    assert two.n_lines > 0
    assert two.n_cells == len(hierarchy[2].faces) + two.n_lines


def test_the_python_function_does_the_same(path: Path) -> None:
    hierarchy = crashkit.coarsen(path, nodes=[120, 30])
    assert (hierarchy[2].kept == open_hierarchy(path)[2].kept).all()
    with pytest.raises(MeshError, match="both node counts and ratios were given"):
        crashkit.coarsen(path, nodes=[120], ratios=[8])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--nodes", "2401"], "2401 nodes were asked for, but only 2400 nodes lie on faces; ask for fewer"),
        (["--nodes", "100,100"], "node counts 100, 100 do not decrease"),
        (["--nodes", "100,0"], "expected whole numbers of at least 1"),
        (["--ratios", "1,4"], "ratios 1.0, 4.0; expected numbers above 1, such as 8,4,4"),
        (["--nodes", "100", "--pair-distance", "-1"], "pair distance -1.0; expected metres, 0 or more"),
    ],
)
def test_counts_that_cannot_be_had_end_with_one_line_and_leave_the_dataset_alone(
    path: Path, options: list[str], message: str
) -> None:
    before = path.read_bytes()
    code, out, err = run(path, *options)
    assert code == 1
    assert out == ""
    assert err.splitlines()[-1].startswith(f"error: {path}: ")
    assert message in err.splitlines()[-1]
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--nodes", "8,x"], "expected whole numbers with commas between them, such as 1165,292,73"),
        (["--nodes", "8.5"], "expected whole numbers"),
        (["--ratios", "a"], "expected numbers with commas"),
        (["--nodes", "100", "--ratios", "8"], "give either --nodes or --ratios"),
        (["--selection", "best"], "expected quadric or vtk"),
    ],
)
def test_bad_usage_ends_with_code_two(path: Path, options: list[str], message: str) -> None:
    code, _, err = run(path, *options)
    assert code == 2
    assert message in " ".join(err.replace("│", " ").split())


def test_files_that_are_no_dataset_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.nc").write_text("not a dataset")
    (tmp_path / "empty.zarr").mkdir()
    for name, message in (("none.zarr", "no such dataset"), ("text.nc", "cannot be opened"), ("empty.zarr", "no Zarr")):
        code, _, err = run(tmp_path / name)
        assert code == 1
        assert message in err.splitlines()[-1]


def test_outputs_that_cannot_be_written_are_told_and_the_hierarchy_is_kept(path: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for option, place in (("--picture", tmp_path / "file" / "levels.png"), ("--vtp", tmp_path / "file" / "levels")):
        code, _, err = run(path, "--nodes", "120,30", option, place)
        assert code == 1
        assert "cannot be written" in err.splitlines()[-1]
        assert [level.n_nodes for level in open_hierarchy(path).levels] == [120, 30]


def test_a_machine_that_cannot_draw_gets_the_hierarchy_and_the_reason(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import evaluation.drawing.rendering

    monkeypatch.setattr(evaluation.drawing.rendering, "rendering_problem", lambda: "no image can be drawn: no EGL")
    code, _, err = run(path, "--nodes", "120,30", "--picture", tmp_path / "levels.png")
    assert code == 0
    assert "no image can be drawn" in err
    assert not (tmp_path / "levels.png").exists()
    assert len(open_hierarchy(path).levels) == 2


def with_beam(path: Path, *, own_faces: bool) -> Path:
    """The campaign with a beam to its last node, which lies on no face; the beam's part may have faces elsewhere."""
    ds = campaign()
    last = ds.sizes["node"] - 1
    ds = ds.isel(face=~(ds["face_nodes"] == last).any("corner")).drop_vars(["part_id", "part_name"])
    ds["part_id"], ds["part_name"] = ("part", [7, 9]), ("part", np.array(["frame", "spring"], "O"))
    ds["cell_nodes"] = (("cell", "cell_corner"), np.array([[0, last]], np.int32))
    ds["cell_type"], ds["cell_part"] = ("cell", np.array([3], np.uint8)), ("cell", np.array([1], np.int32))
    if own_faces:
        ds["face_part"][:10] = 1
    write(ds, path)
    return path


def test_parts_without_faces_are_named_with_what_to_do(tmp_path: Path) -> None:
    path = with_beam(tmp_path / "beam.nc", own_faces=False)
    code, _, err = run(path, "--nodes", "120,30")
    assert code == 0
    told = " ".join(err.split())
    assert "part 9 (spring) has no faces (beams, particles): its 1 node on no face of another part" in told
    assert "--exclude-parts 9" in told
    with pytest.warns(UserWarning, match=r"part 9 \(spring\) has no faces"):
        crashkit.coarsen(path, [120, 30])


def test_parts_with_faces_of_their_own_are_not_named(tmp_path: Path) -> None:
    path = with_beam(tmp_path / "beam.nc", own_faces=True)
    code, out, _ = run(path, "--nodes", "120,30", "--json")
    assert (code, json.loads(out)["parts_without_faces"]) == (0, [])
