"""Building a hierarchy: what is asked for, what is refused, and what adding up lifting errors says."""

from __future__ import annotations

import numpy as np
import pytest
from mesh_shapes import joined, kart, plate

from crashkit import mesh
from crashkit.errors import MeshError
from crashkit.mesh import build_hierarchy
from crashkit.mesh.lifting import LiftingMeter
from data_schema.levels import lift


def test_without_counts_an_eighth_and_two_quarters_are_kept() -> None:
    position, faces, _ = kart()
    assert [level.n_nodes for level in build_hierarchy(position, faces).levels] == [300, 75, 19]


def test_all_nodes_may_be_asked_for() -> None:
    position, faces = plate(5, 5)
    level = build_hierarchy(position, faces, [25])[1]
    assert (level.to_full.toarray() == np.eye(25)).all()
    assert len(level.faces) == 32


def test_the_settings_say_how_it_was_made() -> None:
    position, faces = plate(9, 9)
    settings = build_hierarchy(position, faces, [20], selection="vtk").settings
    assert settings == {"selection": "vtk", "pair_distance": pytest.approx(0.01 * np.sqrt(2)), "counts": [20]}


def test_face_parts_come_along() -> None:
    position, faces, part = joined(plate(6, 6), plate(6, 6))
    position[36:, 2] += 1
    level = build_hierarchy(position, faces, [20], face_part=part)[1]
    assert level.face_part is not None
    assert ((level.kept[level.faces] >= 36).all(axis=1) == (level.face_part == 1)).all()


def test_a_level_that_is_not_there_is_named() -> None:
    position, faces = plate(5, 5)
    with pytest.raises(IndexError, match="level 2 asked for; the hierarchy has levels 1 to 1"):
        build_hierarchy(position, faces, [9])[2]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"counts": [26]}, "26 nodes were asked for, but only 25 nodes lie on faces; ask for fewer"),
        ({"counts": [9, 9]}, "node counts 9, 9 do not decrease"),
        ({"counts": [9, 12]}, "node counts 9, 12 do not decrease"),
        ({"counts": []}, "node counts missing; expected whole numbers of at least 1"),
        ({"counts": [9, 0]}, "node counts 9, 0; expected whole numbers of at least 1"),
        ({"counts": [9.5]}, "expected whole numbers"),
        ({"counts": [9], "selection": "random"}, "selection 'random' is not known; expected quadric or vtk"),
        ({"counts": [9], "pair_distance": -1.0}, "pair distance -1.0; expected metres, 0 or more"),
        ({"counts": [9], "pair_distance": np.nan}, "pair distance nan"),
    ],
)
def test_what_cannot_be_had_is_refused_in_one_line(arguments: dict, message: str) -> None:
    position, faces = plate(5, 5)
    with pytest.raises(MeshError, match=message) as caught:
        build_hierarchy(position, faces, **arguments)
    assert "\n" not in str(caught.value)


def test_nodes_without_faces_do_not_count_as_available() -> None:
    position, faces = plate(3, 3)
    with pytest.raises(MeshError, match="only 9 nodes lie on faces"):
        build_hierarchy(np.concatenate([position, position + 5]), faces, [12])


def test_a_mesh_of_beams_only_is_refused() -> None:
    with pytest.raises(MeshError, match=r"no face \(only beams or loose nodes\); a hierarchy needs shells"):
        build_hierarchy(np.eye(3), np.empty((0, 4), int), [2])


def test_lifting_errors_add_up_over_blocks_as_over_everything() -> None:
    position, faces, displacement = kart()
    hierarchy = build_hierarchy(position, faces, [300, 75])
    meter = LiftingMeter(hierarchy)
    for block in np.array_split(displacement, 3):
        meter.add(block)
    for level, found in zip(hierarchy.levels, meter.errors, strict=True):
        u = displacement.astype(float)
        error = np.linalg.norm(np.einsum("fn,snx->sfx", level.to_full.toarray(), u[:, level.kept]) - u, axis=-1)
        assert found.mean == pytest.approx(error.mean(), rel=1e-5)
        assert found.largest == pytest.approx(error.max(), rel=1e-4)


def test_lifting_costs_the_kart_less_than_one_percent_of_its_movement_at_an_eighth_of_its_nodes() -> None:
    position, faces, displacement = kart()
    meter = LiftingMeter(build_hierarchy(position, faces, [300]))
    meter.add(displacement)
    assert meter.errors[0].mean < 0.01 * np.linalg.norm(displacement, axis=-1).mean()


def test_the_quadric_selection_lifts_better_than_the_one_through_vtk() -> None:
    position, faces, displacement = kart()
    errors = []
    for selection in ("quadric", "vtk"):
        meter = LiftingMeter(build_hierarchy(position, faces, [300, 75, 19], selection=selection))  # type: ignore[arg-type]
        meter.add(displacement)
        errors.append([e.mean for e in meter.errors])
    assert (np.array(errors[0]) < errors[1]).all()


def test_lifting_keeps_the_precision_of_the_data() -> None:
    position, faces = plate(6, 6)
    level = build_hierarchy(position, faces, [12])[1]
    assert lift(level.to_full, np.ones((2, 12, 3), np.float32)).dtype == np.float32


@pytest.mark.parametrize("name", mesh.__all__)
def test_no_public_name_is_hidden_by_a_module(name: str) -> None:
    getattr(mesh, name)  # imports the module behind it
    assert callable(getattr(mesh, name))


def test_a_mesh_far_from_the_origin_is_coarsened_as_well() -> None:
    position, faces, displacement = kart()
    errors = []
    for offset in (0.0, 1e6):
        meter = LiftingMeter(build_hierarchy(position + offset, faces, [300, 75]))
        meter.add(displacement[:1].reshape(-1, *displacement.shape[-2:]))
        errors.append([error.mean for error in meter.errors])
    np.testing.assert_allclose(errors[1], errors[0], rtol=0.2)
