"""Images of meshes: what is drawn, where, and what happens where nothing can be drawn."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from evaluation.drawing.rendering import choose_view, render, rendering_problem
from evaluation.errors import EvaluationError

# A frame-like plate: 4 m along x, 1 m along y, flat in z.
POINTS = np.array([[x, y, 0.0] for x in range(5) for y in range(2)], float)
FACES = np.array([[2 * k, 2 * k + 2, 2 * k + 3, 2 * k + 1] for k in range(4)])


def ink(image: np.ndarray) -> np.ndarray:
    """Where the image is not white."""
    return (image < 250).any(axis=-1)


def test_the_view_holds_all_positions_and_looks_down_on_the_flat_side():
    far = POINTS + np.array([3.0, 0, 1.0])
    view = choose_view([POINTS, far], FACES)
    assert view.up[2] > 0.5
    assert abs(view.right[0]) > 0.8
    np.testing.assert_allclose(
        [view.right @ view.up, np.linalg.norm(view.right), np.linalg.norm(view.up)], [0, 1, 1], atol=1e-12
    )
    for cloud in (POINTS, far):
        for axis, size in ((view.right, view.width), (view.up, view.height)):
            assert (abs((cloud - view.centre) @ axis) < size / 2).all()


def test_a_structure_that_is_flat_along_y_is_seen_from_y():
    upright = POINTS[:, [0, 2, 1]] * [1, 1, 3]
    view = choose_view([upright], FACES)
    assert abs(view.up[1]) > 0.5


def test_the_view_does_not_mind_nodes_that_are_gone():
    partly = np.stack([POINTS, np.where(np.arange(10)[:, None] < 4, np.nan, POINTS)])
    whole, gappy = choose_view([POINTS], FACES), choose_view([partly], FACES)
    np.testing.assert_allclose([gappy.width, gappy.height], [whole.width, whole.height])
    with pytest.raises(EvaluationError, match="no node with a finite position"):
        choose_view([np.full((10, 3), np.nan)], FACES)


def test_an_image_fills_its_view_on_white():
    view = choose_view([POINTS], FACES)
    image = render(POINTS, FACES, view, width=200)
    assert image.shape == (round(200 * view.height / view.width), 200, 3)
    assert image.dtype == np.uint8
    drawn = ink(image)
    assert drawn.any(axis=0).sum() > 180
    assert not drawn[:, :2].any()


def test_values_are_coloured_between_the_limits():
    view = choose_view([POINTS], FACES)
    low, high = (render(POINTS, FACES, view, np.full(10, v), (0, 2), width=100) for v in (0.0, 2.0))
    colours = [image[ink(image)].mean(axis=0) for image in (low, high)]
    assert colours[0][2] > colours[0][1]  # viridis starts in violet
    assert colours[1][1] > 2 * colours[1][2]  # and ends in yellow


def test_zero_everywhere_has_a_colour_and_nan_is_grey():
    view = choose_view([POINTS], FACES)
    violet = render(POINTS, FACES, view, np.zeros(10), (0, 0), width=100)
    grey = render(POINTS, FACES, view, np.full(10, np.nan), (0, 1), width=100)
    assert np.ptp(violet[ink(violet)].mean(axis=0)) > 30
    assert np.ptp(grey[ink(grey)].mean(axis=0)) < 12


def test_eroded_faces_and_faces_of_lost_nodes_are_not_drawn():
    view = choose_view([POINTS], FACES)
    whole = ink(render(POINTS, FACES, view, width=200)).sum()
    lost = POINTS.copy()
    lost[8:] = np.nan
    for image in (
        render(POINTS, FACES, view, np.arange(4.0), (0, 4), width=200, alive=[True, True, True, False]),
        render(lost, FACES, view, width=200),
    ):
        assert 0.7 * whole < ink(image).sum() < 0.8 * whole


def test_triangles_among_quadrilaterals_are_drawn_as_such():
    view = choose_view([POINTS], FACES)
    halves = np.where(np.arange(4) == 3, -1, FACES)
    whole, half = (ink(render(POINTS, f, view, width=200)).sum() for f in (FACES, halves))
    assert half == pytest.approx(whole / 2, rel=0.05)


def test_a_displaced_mesh_is_displaced_by_as_many_pixels():
    view = choose_view([POINTS, POINTS + view_shift()], FACES)
    columns = [np.flatnonzero(ink(render(POINTS + s, FACES, view, width=400)).any(axis=0)) for s in (0, view_shift())]
    expected = view_shift() @ view.right / view.width * 400
    assert columns[1][0] - columns[0][0] == pytest.approx(expected, abs=1.5)


def view_shift() -> np.ndarray:
    return np.array([1.0, 0.0, 0.0])


def test_marked_nodes_and_lone_edges_are_drawn_without_faces():
    view = choose_view([POINTS], FACES)
    nothing = np.empty((0, 3), int)
    dots = render(POINTS, nothing, view, width=200, marked=[0, 9])
    lines = render(POINTS, nothing, view, width=200, lines=[[0, 9]])
    assert 0 < ink(dots).sum() < ink(lines).sum() < 2000
    assert not ink(render(POINTS, nothing, view, width=200)).any()


def test_drawing_without_a_display_says_nothing_on_stderr():
    script = (
        "import numpy as np, sys\n"
        "from evaluation.drawing.rendering import choose_view, render\n"
        "x, f = np.eye(3), np.array([[0, 1, 2]])\n"
        "image = render(x, f, choose_view([x], f), width=50)\n"
        "sys.exit(0 if (image < 250).any() else 3)\n"
    )
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "VTK_DEFAULT_OPENGL_WINDOW")}
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_where_nothing_can_be_drawn_one_line_says_so_instead_of_a_crash(monkeypatch):
    view = choose_view([POINTS], FACES)
    monkeypatch.setenv("VTK_DEFAULT_OPENGL_WINDOW", "vtkNoSuchRenderWindow")
    problem = rendering_problem()
    assert problem is not None
    assert "install one" in problem
    with pytest.raises(EvaluationError, match=r"no image can be drawn: .*leave pictures out"):
        render(POINTS, FACES, view)


def test_the_environment_is_left_as_it_was():
    before = dict(os.environ)
    render(POINTS, FACES, choose_view([POINTS], FACES), width=20)
    assert dict(os.environ) == before
