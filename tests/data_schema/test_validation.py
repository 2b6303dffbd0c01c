"""Each rule of a crash dataset: broken alone, it is told alone, with the place."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr

from data_schema import (
    CONVENTIONS,
    Violation,
    checksum,
    dataset_checksum,
    digests_of_run,
    fields,
    parameters,
    run_checksum,
    validate,
)

FILES = json.dumps([{"run": r, "file": f"{r}.h5", "bytes": 3, "sha256": "0" * 64} for r in ("a", "b")])


def good() -> xr.Dataset:
    """Two runs of two triangles and a beam, four states; the second triangle erodes in run b."""
    u = np.cumsum(np.random.default_rng(1).normal(size=(2, 4, 5, 3)), axis=1).astype(np.float32)
    u[:, 0] = 0
    alive = np.ones((2, 4, 2), bool)
    alive[1, 2:, 1] = False
    u[1, 2:, 3] = np.nan  # node 3 is of the second triangle alone; node 4 is held by the beam
    ds = xr.Dataset(
        {
            "displacement": (("sim", "time", "node", "xyz"), u, {"units": "m"}),
            "reference_position": (("node", "xyz"), np.eye(5, 3), {"units": "m"}),
            "node_id": ("node", np.arange(10, 15)),
            "face_nodes": (("face", "corner"), np.array([[0, 1, 2], [2, 3, 4]], np.int32)),
            "face_part": ("face", np.array([0, 1], np.int32)),
            "cell_nodes": (("cell", "cell_corner"), np.array([[0, 4]], np.int32)),
            "cell_type": ("cell", np.array([3], np.uint8)),
            "cell_part": ("cell", np.array([1], np.int32)),
            "part_id": ("part", np.array([1, 2])),
            "part_name": ("part", np.array(["x", "y"])),
            "alive": (("sim", "time", "face"), alive),
            "complete": ("sim", np.array([True, True])),
            "speed": ("sim", np.array([1.0, 2.0]), {"units": "m s-1", "role": "parameter"}),
            "strain": (("sim", "time", "face"), np.zeros((2, 4, 2), np.float32), {"units": "1", "role": "field"}),
        },
        coords={"sim": np.array(["a", "b"]), "time": ("time", np.arange(4.0), {"units": "s"})},
        attrs={
            "Conventions": CONVENTIONS,
            "solver": "none",
            "source_files": FILES,
            "units_read": "SI",
            "units_written": "SI",
            "crashkit_version": "0",
            "history": "made",
        },
    )
    checksums = [run_checksum(digests_of_run(ds, k)) for k in range(2)]
    ds["run_checksum"] = ("sim", np.array(checksums))
    return ds.assign_attrs(checksum=dataset_checksum(ds, checksums))


def changed(name: str, index: tuple[object, ...], value: object) -> Callable[[xr.Dataset], xr.Dataset]:
    """A dataset with one value of a variable changed, and checksums that fit."""

    def change(ds: xr.Dataset) -> xr.Dataset:
        values = ds[name].values.copy()
        values[index] = value
        return unsealed(ds.assign({name: ds[name].copy(data=values)}))

    return change


def unsealed(ds: xr.Dataset) -> xr.Dataset:
    return ds.drop_vars("run_checksum", errors="ignore")


def without_attribute(name: str) -> Callable[[xr.Dataset], xr.Dataset]:
    return lambda ds: ds.assign_attrs({name: ""})


BROKEN: dict[str, tuple[Callable[[xr.Dataset], xr.Dataset], str]] = {
    "variable missing": (lambda ds: ds.drop_vars("node_id"), "node_id: found nothing"),
    "dimensions swapped": (
        lambda ds: ds.assign(displacement=ds.displacement.transpose("time", "sim", "node", "xyz")),
        "displacement: found dimensions",
    ),
    "type": (lambda ds: ds.assign(node_id=ds.node_id.astype(float)), "node_id: found type float64"),
    "unit": (lambda ds: ds.assign(displacement=ds.displacement.assign_attrs(units="mm")), "found units 'mm'"),
    "two directions": (lambda ds: ds.isel(xyz=[0, 1]), "dimension xyz: found 2, expected 3"),
    "five corners": (lambda ds: ds.pad(corner=(0, 2), constant_values=-1), "dimension corner: found 5"),
    "no run": (lambda ds: ds.isel(sim=[]), "dimension sim: found 0"),
    "no element": (
        lambda ds: ds.isel(face=[]).drop_vars(["cell_nodes", "cell_type", "cell_part"]), "dimension face: found 0",
    ),
    "attribute": (without_attribute("solver"), "attribute solver: found nothing"),
    "conventions": (lambda ds: ds.assign_attrs(Conventions="CF-1.0"), "attribute Conventions: found 'CF-1.0'"),
    "files": (lambda ds: ds.assign_attrs(source_files="[{}]"), "attribute source_files"),
    "parameter on time": (
        lambda ds: ds.assign(speed=("time", np.arange(4.0), {"units": "1", "role": "parameter"})),
        "speed: found a parameter on",
    ),
    "parameter without unit": (lambda ds: ds.assign(speed=ds.speed.assign_attrs(units="")), "speed: found no units"),
    "field without unit": (lambda ds: ds.assign(strain=ds.strain.assign_attrs(units="")), "strain: found no units"),
    "field on sim": (lambda ds: ds.assign(strain=("sim", [1.0, 2.0], {"units": "1", "role": "field"})), "strain: found a"),
    "time turns back": (lambda ds: ds.assign_coords(time=("time", [0.0, 1, 1, 2], {"units": "s"})), "time, state 2"),
    "time no number": (lambda ds: ds.assign_coords(time=("time", [0, 1, 2, np.nan], {"units": "s"})), "time: found"),
    "run twice": (lambda ds: ds.assign_coords(sim=np.array(["a", "a"])), "sim: found a 2 times"),
    "node twice": (changed("node_id", (1,), 10), "node_id: found 10 2 times"),
    "curve twice": (
        lambda ds: ds.assign(channel=("channel", ["wall_force", "wall_force"])), "channel: found wall_force 2 times",
    ),
    "face beyond nodes": (changed("face_nodes", (1, 2), 5), "face_nodes: found numbers 0 to 5, expected -1 to 4"),
    "face of two": (changed("face_nodes", (0, 1), -1), "face_nodes, face 0"),
    "part beyond": (changed("face_part", (0,), 2), "face_part: found numbers 1 to 2"),
    "position": (changed("reference_position", (0, 0), np.inf), "reference_position: found"),
    "parameter no number": (changed("speed", (1,), np.nan), "speed, run b: found a value that is not finite"),
    "incomplete": (changed("complete", (1,), False), "run b: found an incomplete run"),
    "value missing": (changed("displacement", (0, 2, 4, 1), np.nan), "run a, state 2, node 4: found a value"),
    "value of a gone node": (changed("displacement", (1, 3, 3), 0.0), "run b, state 3, node 3: found a number"),
    "first state": (changed("displacement", (0, 0, 2, 0), 0.01), "run a, first state: found up to 0.01 m"),
    "nothing moves": (changed("displacement", (0,), 0.0), "run a: found zero everywhere"),
    "changed after writing": (
        lambda ds: ds.assign(strain=ds.strain.copy(data=ds.strain.values + np.float32(1))), "results, run a: found content",
    ),
    "mesh changed after writing": (
        lambda ds: ds.assign(reference_position=ds.reference_position.copy(data=ds.reference_position.values * 2)),
        "attribute checksum",
    ),
}  # fmt: skip


def test_good_dataset_has_no_violation() -> None:
    assert validate(good()) == []


@pytest.mark.parametrize("name", BROKEN)
def test_broken_rule_is_told_with_its_place(name: str) -> None:
    change, told = BROKEN[name]
    assert told in "\n".join(map(str, validate(change(good()))))


def test_every_violation_is_told_not_the_first() -> None:
    ds = changed("displacement", (0, 2, 4, 1), np.nan)(changed("speed", (1,), np.nan)(good()))
    told = "\n".join(map(str, validate(ds)))
    assert "run a, state 2" in told
    assert "speed, run b" in told


def test_values_are_left_alone_if_not_wanted() -> None:
    assert validate(changed("displacement", (0, 0, 2, 0), 0.01)(good()), values=False) == []


def test_some_runs_of_a_dataset_are_as_good_as_all() -> None:
    assert validate(good().isel(sim=[1])) == []


def test_node_of_a_dead_cell_must_be_gone() -> None:
    ds = unsealed(good())
    dead = np.ones((2, 4, 1), bool)
    dead[0, 3] = False
    alive = ds["alive"].values.copy()
    alive[0, 3, 1] = False
    ds = ds.assign(alive=ds["alive"].copy(data=alive), cell_alive=(("sim", "time", "cell"), dead))
    assert {v.where for v in validate(ds)} == {"displacement, run a, state 3, node 3"}


def test_names_by_role_and_order() -> None:
    ds = good().assign(angle=("sim", [1.0, 2.0], {"units": "degree", "role": "parameter"}))
    assert parameters(ds) == ["speed", "angle"]
    assert parameters(ds.assign_attrs(parameters='["angle", "speed"]')) == ["angle", "speed"]
    assert fields(ds) == ["strain"]


# Exactly what is told, and exactly where the line is


def told(ds: xr.Dataset, **options: bool) -> list[str]:
    return [str(v) for v in validate(ds, **options)]


def test_a_violation_says_where_what_and_what_was_expected() -> None:
    violation = Violation("time", "values that are not finite", "finite times")
    assert str(violation) == "time: found values that are not finite, expected finite times"


@pytest.mark.parametrize("values", [True, False])
def test_a_broken_layout_is_told_alone(values: bool) -> None:
    ds = changed("displacement", (0, 2, 4, 1), np.nan)(good()).drop_vars("node_id")
    assert told(ds, values=values) == [
        "node_id: found nothing, expected a variable on (node): the solver's node number, unique"
    ]


@pytest.mark.parametrize("name", ["alive", "face_id", "cell_id", "run_checksum", "complete"])
def test_what_is_optional_may_be_missing(name: str) -> None:
    ds = unsealed(good()).drop_vars(name, errors="ignore").drop_attrs(deep=False)
    ds = ds.assign_attrs({k: v for k, v in good().attrs.items() if k != "checksum"})
    if name == "alive":
        ds["displacement"] = ds.displacement.fillna(0.5)
    assert told(ds) == []


def test_every_attribute_that_is_missing_is_told() -> None:
    ds = good().drop_attrs(deep=False)
    expected = {"Conventions", "solver", "source_files", "units_read", "units_written", "crashkit_version", "history"}
    assert {v.where for v in validate(ds)} == {f"attribute {name}" for name in expected}
    assert all(v.found == "nothing" and v.expected for v in validate(ds))


@pytest.mark.parametrize(
    "text", ["no JSON", "[1, 2]", "3", '[{"run": "a", "file": "a.h5", "bytes": 3}]', '{"run": "a"}']
)
def test_source_files_are_a_list_of_run_file_bytes_and_digest(text: str) -> None:
    assert [v.where for v in validate(good().assign_attrs(source_files=text))] == ["attribute source_files"]


def test_integers_may_be_unsigned_and_text_may_be_objects() -> None:
    ds = good()
    ds = ds.assign(face_part=ds.face_part.astype(np.uint16), part_name=ds.part_name.astype(object))
    assert told(ds) == []
    assert told(ds.assign(face_part=ds.face_part.astype(bool))) == [
        "face_part: found type bool, expected numpy kind 'i'"
    ]
    assert told(ds.assign(part_name=("part", [1, 2]))) == ["part_name: found type int64, expected numpy kind 'U'"]


def test_all_accepted_dimensions_are_told() -> None:
    ds = good().assign(reference_position=(("xyz", "node"), np.eye(3, 5), {"units": "m"}))
    assert told(ds) == ["reference_position: found dimensions (xyz, node), expected (node, xyz) or (sim, node, xyz)"]


def test_runs_may_have_positions_of_their_own() -> None:
    shapes = np.stack([np.eye(5, 3), np.eye(5, 3) * 1.5])
    ds = unsealed(good()).assign(reference_position=(("sim", "node", "xyz"), shapes, {"units": "m"}))
    assert told(ds) == []


@pytest.mark.parametrize("name", ["displacement", "reference_position", "time"])
def test_a_missing_unit_is_told(name: str) -> None:
    ds = good()
    ds[name].attrs.pop("units")
    assert told(ds) == [f"{name}: found units '', expected '{'s' if name == 'time' else 'm'}'"]


def test_triangles_alone_have_three_corners_and_four_are_as_good() -> None:
    assert told(unsealed(good()).pad(corner=(0, 1), constant_values=-1).assign_coords(good().coords)) == []


@pytest.mark.parametrize("name", ["time", "node"])
def test_nothing_of_a_dimension_is_told(name: str) -> None:
    assert f"dimension {name}: found 0, expected at least 1" in told(unsealed(good()).isel({name: []}))


def test_solids_and_beams_alone_are_enough() -> None:
    ds = unsealed(good()).isel(face=[])
    ds["displacement"] = ds.displacement.fillna(0.5)
    assert told(ds) == []


@pytest.mark.parametrize(
    ("dims", "good_one"),
    [
        (("sim", "time", "node"), True), (("sim", "time", "face"), True), (("sim", "time", "cell"), True),
        (("sim", "time", "node", "xyz"), True), (("sim", "time"), False), (("sim", "node", "time"), False),
        (("time", "sim", "node"), False), (("sim", "time", "part"), False),
    ],
)  # fmt: skip
def test_a_field_is_on_runs_states_and_nodes_faces_or_cells(dims: tuple[str, ...], good_one: bool) -> None:
    ds = unsealed(good())
    values = np.ones([ds.sizes[d] for d in dims], np.float32)
    found = told(ds.assign(strain=(dims, values, {"units": "1", "role": "field"})))
    expected = f"strain: found a field on ({', '.join(dims)}), expected (sim, time, node | face | cell [, ...])"
    assert found == ([] if good_one else [expected])


def test_times_that_do_not_increase_are_told_with_the_first_place() -> None:
    ds = good().assign_coords(time=("time", [0.0, 2.0, 1.5, 1.0], {"units": "s"}))
    assert told(ds)[0] == "time, state 2: found 1.5 s after 2 s, expected strictly increasing times"


@pytest.mark.parametrize(
    ("name", "index", "value", "found"),
    [
        ("face_nodes", (1, 0), -2, "face_nodes: found numbers -2 to 4, expected -1 to 4 (node)"),
        ("face_nodes", (1, 0), 5, "face_nodes: found numbers 0 to 5, expected -1 to 4 (node)"),
        ("face_part", (1,), -1, "face_part: found numbers -1 to 0, expected 0 to 1 (part)"),
        ("face_part", (0,), 2, "face_part: found numbers 1 to 2, expected 0 to 1 (part)"),
        ("cell_nodes", (0, 1), 5, "cell_nodes: found numbers 0 to 5, expected -1 to 4 (node)"),
        ("cell_nodes", (0, 1), -2, "cell_nodes: found numbers -2 to 0, expected -1 to 4 (node)"),
        ("cell_part", (0,), 2, "cell_part: found numbers 2 to 2, expected 0 to 1 (part)"),
        ("cell_part", (0,), -1, "cell_part: found numbers -1 to -1, expected 0 to 1 (part)"),
    ],
)
def test_numbers_must_point_at_what_is_there(name: str, index: tuple[int, ...], value: int, found: str) -> None:
    assert found in told(changed(name, index, value)(good()))


def test_results_are_not_judged_where_faces_are_wrong() -> None:
    ds = changed("displacement", (0, 0, 2, 0), 0.5)(changed("face_nodes", (1, 0), 5)(good()))
    assert {v.where for v in validate(ds)} == {"face_nodes"}


def test_a_face_of_two_nodes_is_told_with_its_corners() -> None:
    assert told(changed("face_nodes", (1, 2), -1)(good())) == [
        "face_nodes, face 1: found [2, 3, -1], expected at least three nodes"
    ]


@pytest.mark.parametrize(("moved", "is_told"), [(0.9e-5, False), (-0.9e-5, False), (1.1e-5, True), (-1.1e-5, True)])
def test_the_first_state_may_differ_by_rounding(moved: float, is_told: bool) -> None:
    found = told(changed("displacement", (1, 0, 3, 2), moved)(good()))
    assert found == (
        ["displacement, run b, first state: found up to 1.1e-05 m, expected zero: it is the reference"]
        if is_told
        else []
    )


@pytest.mark.parametrize("bytes_", [4 * 12, 4 * 12 * 2, 1 << 20])
def test_the_place_of_a_bad_value_does_not_depend_on_how_many_nodes_are_looked_at_at_once(
    monkeypatch: pytest.MonkeyPatch, bytes_: int
) -> None:
    monkeypatch.setattr(checksum, "BLOCK_BYTES", bytes_)
    ds = changed("displacement", (0, 3, 4, 1), np.inf)(good())
    assert told(ds) == ["displacement, run a, state 3, node 4: found a value that is not finite, expected a number"]
    ds = changed("displacement", (1, 2, 3), [0.0, 1.0, 2.0])(good())
    assert told(ds) == ["displacement, run b, state 2, node 3: found a number, expected NaN: all its elements are gone"]
    late = changed("displacement", (0, slice(None), slice(0, 4)), 0.0)(good())
    assert told(late) == [], "one node that moves in the last block is enough"


def test_one_component_missing_is_a_node_missing_and_one_there_is_a_node_there_in_part() -> None:
    assert told(changed("displacement", (1, 2, 3, 0), 1.0)(good())) == []


def test_a_single_state_needs_not_move() -> None:
    assert told(unsealed(good()).isel(time=[0])) == []


def test_a_node_of_no_element_is_never_gone() -> None:
    ds = unsealed(good()).drop_vars(["cell_nodes", "cell_type", "cell_part"])
    alive = np.zeros((2, 4, 2), bool)
    ds["alive"] = ds.alive.copy(data=alive)
    ds["face_nodes"] = ds.face_nodes.copy(data=[[0, 1, 2], [0, 1, 3]])
    values = np.full((2, 4, 5, 3), np.nan, np.float32)
    values[:, :, 4] = np.arange(4)[:, None]
    ds["displacement"] = ds.displacement.copy(data=values)
    assert told(ds) == []


def test_faces_without_erosion_hold_the_nodes_of_dead_solids() -> None:
    ds = unsealed(good()).drop_vars("alive")
    cells = np.ones((2, 4, 1), bool)
    cells[:, 2:] = False
    u = ds.displacement.fillna(0.5)
    ds = ds.assign(displacement=u, cell_alive=(("sim", "time", "cell"), cells))
    assert told(ds) == [], "the beam's nodes are of a face too"


def test_a_checksum_that_does_not_fit_is_told_for_the_run_it_is_of() -> None:
    ds = good()
    ds["run_checksum"] = ds.run_checksum.copy(data=[str(ds.run_checksum.values[0]), "f" * 64])
    found = validate(ds)
    assert [v.where for v in found] == ["results, run b", "attribute checksum"]
    assert run_checksum(digests_of_run(ds, 1))[:12] in found[0].found
    assert found[0].expected.startswith("ffffffffffff...")


@pytest.mark.parametrize(
    "name", ["part_name", "face_part", "cell_type", "cell_part", "part_id", "node_id", "speed", "time"]
)
def test_a_change_of_what_runs_share_after_writing_is_told(name: str) -> None:
    ds = good()
    values = ds[name].values.copy()
    values.flat[-1] = (
        "z" if values.dtype.kind == "U" else {"face_part": 0, "cell_part": 0}.get(name, values.flat[-1] + 1)
    )
    changed_one = (
        ds.assign_coords(time=("time", values, ds.time.attrs))
        if name == "time"
        else ds.assign({name: ds[name].copy(data=values)})
    )
    assert [v.where for v in validate(changed_one)] == ["attribute checksum"]


def test_without_recorded_checksums_there_is_nothing_to_compare() -> None:
    ds = unsealed(good()).assign_attrs(checksum="0" * 64)
    assert told(ds) == []
    assert told(good().assign_attrs(checksum="")) == []
    assert told(good().assign_attrs(checksum="0" * 64)) == [
        "attribute checksum: found 000000000000..., expected the SHA-256 of mesh, times, parameters and runs as they are"
    ]
