"""Pictures with text: panels, scales and captions that belong to the arrays, drawn from a real run."""

from __future__ import annotations

import io
from importlib.resources import files

import h5py
import numpy as np
import pytest

from crashkit.writers.paraview import write_paraview
from evaluation.drawing.pictures import (
    KeptNodes,
    Row,
    comparison_picture,
    file_picture,
    kept_nodes_picture,
    limits_of,
    states_at,
    states_picture,
)
from evaluation.drawing.style import Sheet
from evaluation.errors import EvaluationError

SHEET = Sheet(13.0)


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Coarse images: drawing without a graphics card takes time."""
    monkeypatch.setattr("evaluation.drawing.pictures.PIXELS_PER_CM", 25)


@pytest.fixture(scope="module")
def run() -> dict[str, np.ndarray]:
    with h5py.File(str(files("crashkit") / "data" / "kart_demo.h5")) as file:
        return {
            "points": file["kart/reference_configuration"][5],
            "faces": file["kart/faces"][:],
            "truth": file["kart/displacements"][5],
            "other": file["kart/displacements"][6],
            "time": file["time"][:],
        }


def texts(figure) -> list[str]:
    return [t.get_text() for t in figure.texts if t.get_text().strip()]


def bars(figure) -> dict[str, tuple[float, float]]:
    """Label of each colour bar -> its limits."""
    found = {}
    for axes in figure.axes:
        if axes.images:
            continue
        label = axes.get_xlabel() or axes.get_title(loc="left")
        found[label] = axes.get_xlim() if axes.get_xlabel() else axes.get_ylim()
    return found


def test_truth_and_prediction_share_a_scale_and_the_error_has_its_own(run):
    u, p = run["truth"][-1], 0.5 * run["truth"][-1]
    figure = comparison_picture(run["points"], run["faces"], u, p, "MH1", SHEET)
    size = 100 * np.linalg.norm(u, axis=-1).max()
    assert texts(figure) == ["truth", "MH1", "error of MH1"]
    assert bars(figure) == {
        "displacement (cm)": (0.0, pytest.approx(size)),
        "error (cm)": (0.0, pytest.approx(size / 2, rel=1e-6)),
    }
    shapes = {axes.images[0].get_array().shape for axes in figure.axes if axes.images}
    assert len(shapes) == 1


@pytest.mark.parametrize("suffix", [".pvd", ".vtkhdf"])
def test_a_picture_of_a_paraview_file_is_that_of_its_arrays(run, tmp_path, suffix):
    u, p = run["truth"], run["other"]
    alive = np.ones((len(run["time"]), len(run["faces"])), bool)
    alive[10:, :900] = False
    path = write_paraview(
        tmp_path / f"run{suffix}", run["points"], run["faces"], run["time"], {"displacement": u, "predicted": p},
        lines=[[0, 1]], alive=alive,
    )[0]  # fmt: skip
    of_file = file_picture(path, 12, "MH1", SHEET)
    of_arrays = comparison_picture(run["points"], run["faces"], u[12], p[12], "MH1", SHEET, alive=alive[12])
    assert texts(of_file) == texts(of_arrays)
    for a, b in zip(of_file.axes[:3], of_arrays.axes[:3], strict=True):
        np.testing.assert_array_equal(a.images[0].get_array(), b.images[0].get_array())
    with pytest.raises(EvaluationError, match="no point array 'MH2'; expected it among those there: displacement"):
        file_picture(path, prediction="MH2")


def test_a_perfect_prediction_is_drawn_too(run):
    u = run["truth"][-1]
    figure = comparison_picture(run["points"], run["faces"], u, u, sheet=SHEET)
    figure.savefig(io.BytesIO(), dpi=40)
    assert texts(figure)[-1] == "error"


def test_panels_stand_below_each_other_on_a_phone(run):
    u = run["truth"][-1]
    figure = comparison_picture(run["points"], run["faces"], u, u, sheet=Sheet(9.0))
    lefts = {round(axes.get_position().x0, 6) for axes in figure.axes if axes.images}
    assert len(lefts) == 1


def test_rows_of_states_name_row_time_and_scale(run):
    size = 100 * np.linalg.norm(run["truth"], axis=-1)
    rows = [Row("level 3", run["truth"], size), Row("level 2 adds", run["other"], 0.1 * size, "contribution (cm)")]
    figure = states_picture(run["points"], run["faces"], run["time"], rows, sheet=SHEET)
    found = texts(figure)
    assert found[0] == "level 3\n10.5 ms"
    assert found[3] == "level 2 adds\n10.5 ms"
    assert [t.strip() for t in found[1:3]] == ["19.5 ms", "30.0 ms"]
    assert bars(figure)["contribution\n(cm)"][1] == pytest.approx(0.1 * size[[7, 13, 20]].max())
    assert sum(bool(axes.images) for axes in figure.axes) == 6


def test_kept_nodes_are_counted(run):
    kept = np.arange(0, len(run["points"]), 30)
    edges = np.stack([np.arange(len(kept) - 1), np.arange(1, len(kept))], axis=1)
    level = KeptNodes("level 2", kept, np.empty((0, 3), int), edges)
    figure = kept_nodes_picture(run["points"], run["faces"], [level], SHEET)
    assert texts(figure) == [f"level 2: {len(kept)} of {len(run['points'])} nodes kept", "its mesh"]
    red, lines = (axes.images[0].get_array() for axes in figure.axes)
    assert (red[..., 0].astype(int) - red[..., 1] > 100).any()
    assert (lines < 200).any()


def test_limits_and_states():
    assert limits_of([1.0, np.nan, 3.0]) == (0.0, 3.0)
    assert limits_of([-1.0, 2.0]) == (-1.0, 2.0)
    assert limits_of([np.nan]) == (0.0, 1.0)
    assert states_at(np.linspace(0, 0.03, 101), (1 / 3, 2 / 3, 1)) == [33, 67, 100]


def test_arrays_of_different_meshes_are_refused(run):
    with pytest.raises(EvaluationError, match=r"expected \(n, 3\) on the same nodes"):
        comparison_picture(run["points"], run["faces"], run["truth"][-1], run["truth"][-1, :9])
    with pytest.raises(EvaluationError, match="row 'a' has displacements"):
        states_picture(run["points"], run["faces"], run["time"], [Row("a", run["truth"][:3], run["truth"][:, :, 0])])
