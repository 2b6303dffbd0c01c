"""Mirror planes of meshes that are symmetric, nearly so, or not."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from crashkit.mesh import symmetry
from crashkit.mesh.surface import Surface
from crashkit.mesh.symmetry import mirror_plane, mirror_planes
from data_schema.mirror import MirrorPlane


def box(n: int = 6, *, shift: float = 0.0, jitter: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A bent sheet in two halves, left and right of y = `shift`: positions, quads, parts."""
    x, y = np.meshgrid(np.linspace(0, 1, 2 * n + 1), np.linspace(-1, 1, 4 * n + 1), indexing="ij")
    move = jitter * np.random.default_rng(0).uniform(-1, 1, x.shape) * (np.abs(y) < 1)
    y = y + move
    points = np.stack([x.ravel(), y.ravel() + shift, (0.3 * y**2 + 0.2 * x**3).ravel()], axis=1)
    number = np.arange(x.size).reshape(x.shape)
    quads = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1)
    part = np.broadcast_to(np.arange(4 * n) >= 2 * n, quads.shape[:2]).astype(np.int32)
    return points, quads.reshape(-1, 4), part.ravel()


def turned(points: np.ndarray) -> np.ndarray:
    """Rotated about an axis that is none of the coordinate system's."""
    a, b = np.radians(33), np.radians(20)
    one = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    return points @ (one @ np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])).T


def mirrored_position_error(plane: MirrorPlane, points: np.ndarray) -> float:
    images = points - 2 * (points @ plane.normal - plane.offset)[:, None] * plane.normal
    return float(np.abs(plane.to_image @ points - images).max())


@pytest.mark.parametrize("shift", [0.0, 0.37])
def test_the_plane_is_found_wherever_it_lies(shift: float) -> None:
    points, quads, part = box(shift=shift)
    plane = mirror_planes(points, quads, part)[0]
    np.testing.assert_allclose(plane.normal, [0, 1, 0], atol=1e-9)
    assert plane.offset == pytest.approx(shift, abs=1e-6)
    assert plane.largest < 1e-6
    assert mirrored_position_error(plane, points) < 1e-6
    assert "on average" in plane.told


def test_a_plane_askew_is_found_too() -> None:
    points, quads, part = box()
    planes = mirror_planes(turned(points), quads, part)
    assert planes
    assert planes[0].mean < 1e-3


def test_a_mesh_that_is_less_symmetric_than_its_shape_is_mirrored_between_its_nodes() -> None:
    points, quads, part = box(jitter=0.02)
    plane = mirror_planes(points, quads, part)[0]
    assert 0 < plane.mean < 0.25 * plane.edge
    assert mirrored_position_error(plane, points) < plane.largest + 1e-9
    np.testing.assert_allclose(np.asarray(plane.to_image.sum(axis=1)).ravel(), 1.0)
    assert plane.to_image.min() >= 0


def test_parts_go_over_into_parts() -> None:
    points, quads, part = box()
    plane = mirror_planes(points, quads, part)[0]
    left = np.unique(quads[part == 0])
    inside = left[points[left, 1] < -1e-9]
    reached = np.unique(plane.to_image[inside].indices)
    assert (points[reached, 1] > 0).all()


def test_a_shape_without_symmetry_has_no_plane() -> None:
    points, quads, part = box()
    points[:, 2] += 0.4 * points[:, 0] * points[:, 1] + 0.3 * np.sin(3 * points[:, 1]) + 0.2 * points[:, 0] ** 2
    assert mirror_planes(points, quads, part) == []


@pytest.mark.parametrize("bent", [0.0, 0.4])
def test_some_nodes_of_a_large_mesh_only_spare_planes_that_do_not_fit(
    bent: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    points, quads, part = box(12, jitter=0.01)
    points[:, 2] += bent * np.maximum(points[:, 1] - 0.5, 0.0)
    judged: list[NDArray[np.float64]] = []
    of_all = symmetry._plane

    def counted(mesh: Surface, normal: NDArray[np.float64], offset: float, edge: float) -> MirrorPlane:
        judged.append(normal)
        return of_all(mesh, normal, offset, edge)

    monkeypatch.setattr(symmetry, "_plane", counted)
    before = mirror_planes(points, quads, part)
    all_of_them = len(judged)
    monkeypatch.setattr(symmetry, "_MANY", 0)
    after = mirror_planes(points, quads, part)
    assert [(p.name, p.mean, p.most) for p in after] == [(p.name, p.mean, p.most) for p in before]
    assert len(after) <= len(judged) - all_of_them < all_of_them
    assert bool(after) is (bent == 0.0)


def test_a_named_plane_is_taken_however_badly_it_fits() -> None:
    points, quads, _ = box()
    plane = mirror_plane(points, quads, [2.0, 0.0, 0.0], 1.0)
    np.testing.assert_allclose(plane.normal, [1, 0, 0])
    assert plane.offset == pytest.approx(0.5)
    np.testing.assert_allclose(plane.reflection, np.diag([-1.0, 1.0, 1.0]))


def test_the_plane_of_a_mesh_far_from_the_origin_is_where_the_mesh_is() -> None:
    points, quads, part = box()
    near, far = mirror_planes(points, quads, part)[0], mirror_planes(points + np.array([0, 700.0, 0]), quads, part)[0]
    assert far.offset == pytest.approx(near.offset + 700.0 * near.normal[1], abs=1e-9)
    assert far.name == "y = 700 m"
    assert far.mean == pytest.approx(near.mean, abs=1e-9)
    named = mirror_plane(points + np.array([0, 700.0, 0]), quads, [0.0, 1.0, 0.0], 700.0)
    assert (named.offset, named.mean) == (700.0, pytest.approx(near.mean, abs=1e-9))


def test_every_plane_has_a_normal_of_length_one() -> None:
    points, quads, part = box()
    for shift in (0.0, 700.0):
        for plane in mirror_planes(points + np.array([0, shift, 0]), quads, part):
            assert np.linalg.norm(plane.normal) == pytest.approx(1)
