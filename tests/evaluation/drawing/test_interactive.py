"""The page with one run in three dimensions: self-contained, bounded, and its positions are those of the run."""

from __future__ import annotations

import base64
import json
import re
import zlib

import numpy as np
import pytest

from crashkit.mesh.hierarchy import build_hierarchy
from evaluation.drawing.interactive import _thinned, interactive_view, shown_states
from evaluation.errors import EvaluationError

TIME = np.linspace(0, 0.03, 12)


def tube(rings: int = 10, around: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """A closed tube of quadrilaterals and a triangle."""
    angle = 2 * np.pi * np.arange(around) / around
    x = np.array([[r, np.cos(a), np.sin(a)] for r in range(rings) for a in angle], float) * [0.2, 0.1, 0.1]
    faces = [
        [r * around + k, r * around + (k + 1) % around, (r + 1) * around + (k + 1) % around, (r + 1) * around + k]
        for r in range(rings - 1)
        for k in range(around)
    ]
    return x, np.array([*faces, [0, 1, 2, -1]])


def flight(n: int) -> tuple[np.ndarray, np.ndarray]:
    noise = np.random.default_rng(0).normal(scale=0.02, size=(2, len(TIME), n, 3)) * (TIME / 0.03)[:, None, None]
    return 5 * TIME[:, None, None] + noise[0], 5 * TIME[:, None, None] + noise[1]


def run_in(page: str) -> dict:
    return json.loads(re.search(r'<script id="run" type="application/json">(.*?)</script>', page, re.S)[1])


def positions(run: dict, name: str) -> np.ndarray:
    """(state, node, 3), m, decoded as the page's script does it; the first is the reference."""
    data = np.frombuffer(zlib.decompress(base64.b64decode(run[name])), np.uint8).astype(np.uint32)
    low, high = data[: len(data) // 2], data[len(data) // 2 :]
    steps = np.cumsum((low | (high << 8)).reshape(-1, run["nodes"], 3), axis=0) % 2**16
    return np.array(run["origin"]) + np.array(run["step"]) * steps


def test_positions_travel_to_the_page_within_one_step(tmp_path):
    x, faces = tube()
    u, p = flight(len(x))
    page = interactive_view(x, faces, TIME, u, p, tmp_path / "run.html", names=("solver", "MH1"))
    assert (tmp_path / "run.html").read_text(encoding="utf-8") == page
    run = run_in(page)
    assert run["names"] == ["solver", "MH1"]
    assert run["time"] == pytest.approx(TIME)
    for name, field in (("truth", u), ("prediction", p)):
        found = positions(run, name)
        np.testing.assert_allclose(found[0], x, atol=max(run["step"]))
        np.testing.assert_allclose(found[1:], x + field, atol=max(run["step"]))
    assert max(run["step"]) < 1e-4
    error = 100 * np.linalg.norm(p - u, axis=-1)
    assert run["errors"][-1] == (
        f"error over all nodes: mean {error[-1].mean():.2f} cm, largest {error[-1].max():.2f} cm"
    )
    assert run["limits"][1] == pytest.approx(error.max())


def test_the_page_loads_nothing_from_elsewhere():
    x, faces = tube()
    page = interactive_view(x, faces, TIME, *flight(len(x)), title="run </title><script>alert(1)</script>")
    assert not re.search(r'<(script|link|img|iframe)[^>]+(src|href)="(?!data:)', page)
    assert "alert(1)</script>" not in page
    assert page.count("OfflineLocalView.load(") == 1


def test_states_and_nodes_are_bounded():
    x, faces = tube()
    u, p = flight(len(x))
    run = run_in(interactive_view(x, faces, TIME, u, p, max_states=4, max_nodes=60))
    assert run["nodes"] == 60
    np.testing.assert_allclose(run["time"], TIME[[0, 4, 7, 11]])
    shown = positions(run, "truth")[-1]
    distance = np.linalg.norm(shown[:, None] - (x + u[-1])[None], axis=-1).min(axis=1)
    assert distance.max() < 1e-3
    assert "more than are shown" in run["errors"][0]
    exact = 100 * np.linalg.norm(p - u, axis=-1)[-1].max()
    assert f"largest {exact:.2f} cm" in run["errors"][-1]


def test_a_level_that_is_there_is_shown_in_place_of_a_mesh_that_is_too_large():
    x, faces = tube()
    u, p = flight(len(x))
    levels = build_hierarchy(x, faces, [90, 40, 12]).levels
    for most, nodes in ((60, 40), (11, 11)):  # the level of 90 is too large, that of 12 has none below it
        run = run_in(interactive_view(x, faces, TIME, u, p, max_states=2, max_nodes=most, levels=levels))
        assert run["nodes"] == nodes
        shown = positions(run, "truth")[-1]
        assert np.linalg.norm(shown[:, None] - (x + u[-1])[None], axis=-1).min(axis=1).max() < 1e-3


def test_eroded_faces_and_lost_nodes_are_hidden_from_their_state_on():
    x, faces = tube()
    u, p = flight(len(x))
    u[8:, 5] = np.nan
    alive = np.ones((len(TIME), len(faces)), bool)
    alive[4:, 30] = False
    run = run_in(interactive_view(x, faces, TIME, u, p, alive=alive))
    count = 2 * (len(faces) - 1) + 1
    bits = np.unpackbits(np.frombuffer(zlib.decompress(base64.b64decode(run["shown"])), np.uint8))
    shown = bits[: len(TIME) * count].reshape(len(TIME), count).astype(bool)
    assert shown[:4].all()
    assert (~shown[4:8]).sum(axis=1).tolist() == [2] * 4  # both halves of a quadrilateral
    assert (~shown[8:]).sum(axis=1).tolist() == [6] * 4  # and those of the two around the lost node
    assert np.isfinite(positions(run, "truth")).all()


@pytest.mark.parametrize("shape", [(11, 160, 3), (12, 159, 3)])
def test_a_prediction_of_another_shape_is_refused(shape):
    x, faces = tube()
    with pytest.raises(EvaluationError, match="expected 12 states of 160 nodes x 3"):
        interactive_view(x, faces, TIME, flight(len(x))[0], np.zeros(shape))


def test_without_the_extra_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "trame_vtk.modules.vtk", None)
    x, faces = tube()
    with pytest.raises(EvaluationError, match=r"pip install 'crashkit\[viewer\]'"):
        interactive_view(x, faces, TIME, *flight(len(x)))


def test_a_mesh_is_thinned_to_the_nodes_of_its_faces_where_those_are_fewer() -> None:
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    loose = np.arange(18.0).reshape(6, 3) + 5
    x, corners = np.concatenate([loose, square]), np.array([[6, 7, 8], [6, 8, 9]])
    moved = np.zeros((1, 10, 3))
    at, faces, *_ = _thinned(x, corners, moved, moved, np.ones((1, 2), bool), (), 8)
    np.testing.assert_array_equal(at, square)
    assert sorted(map(sorted, faces.tolist())) == [[0, 1, 2], [0, 2, 3]]


def test_states_that_are_shown_are_evenly_spread_with_first_and_last() -> None:
    assert shown_states(5).tolist() == [0, 1, 2, 3, 4]
    some = shown_states(64)
    assert (len(some), some[0], some[-1]) == (31, 0, 63)
    assert set(np.diff(some).tolist()) == {2, 3}
