"""Each rule of a crash dataset: broken alone, it is told alone, with the place."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr

from data_schema import CONVENTIONS, dataset_checksum, digests_of_run, fields, parameters, run_checksum, validate

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
