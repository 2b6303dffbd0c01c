"""Checksums: the same for the same content, another for every change, whatever the order of storage."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from data_schema import checksum, dataset_checksum, digests_of_run, run_checksum


def small(**changes: object) -> xr.Dataset:
    rng = np.random.default_rng(0)
    u = rng.normal(size=(2, 3, 5, 3)).astype(np.float32)
    return xr.Dataset(
        {
            "displacement": (("sim", "time", "node", "xyz"), u),
            "reference_position": (("node", "xyz"), rng.normal(size=(5, 3))),
            "face_nodes": (("face", "corner"), np.array([[0, 1, 2], [2, 3, 4]], np.int32)),
            "node_id": ("node", np.arange(5)),
            "speed": ("sim", [3.0, 4.0], {"role": "parameter"}),
        },
        coords={"sim": ["a", "b"], "time": [0.0, 1.0, 2.0]},
    ).assign(changes)


def total(ds: xr.Dataset) -> str:
    return dataset_checksum(ds, [run_checksum(digests_of_run(ds, k)) for k in range(ds.sizes["sim"])])


@given(st.integers(1, 300), st.integers(1, 200_000), st.integers(1, 36))
def test_blocks_cover_everything_once_and_stay_small(states: int, length: int, entry: int) -> None:
    found = checksum.blocks(states, length, entry)
    assert found[0][0] == 0
    assert found[-1][1] == length
    assert all(a[1] == b[0] for a, b in pairwise(found))
    assert max(b - a for a, b in found) * states * entry <= max(checksum.BLOCK_BYTES, states * entry)


def test_many_blocks_hash_alike_for_any_storage(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checksum, "BLOCK_BYTES", 80)
    ds = small()
    stored = ds.assign(displacement=ds["displacement"].transpose("node", "xyz", "time", "sim").copy())
    again = stored.assign(displacement=stored["displacement"].transpose(*ds["displacement"].dims))
    assert total(again) == total(ds)


@pytest.mark.parametrize(
    "change",
    [
        lambda ds: ds.assign(displacement=ds.displacement + np.float32(1e-6)),
        lambda ds: ds.assign(reference_position=ds.reference_position * 1.0000001),
        lambda ds: ds.assign(speed=ds.speed.copy(data=[3.0, 4.0000001])),
        lambda ds: ds.assign_coords(sim=["a", "c"]),
        lambda ds: ds.assign_coords(time=[0.0, 1.0, 2.1]),
        lambda ds: ds.isel(sim=[1, 0]),
        lambda ds: ds.assign(alive=(("sim", "time", "face"), np.array([[[1, 1], [1, 0], [1, 0]]] * 2, bool))),
        lambda ds: ds.assign(
            strain=(("sim", "time", "face"), np.zeros((2, 3, 2), np.float32), {"role": "field"})
        ),
    ],
    ids=["displacement", "position", "parameter", "name", "time", "order", "alive", "field"],
)  # fmt: skip
def test_every_change_of_content_shows(change) -> None:  # type: ignore[no-untyped-def]
    assert total(change(small())) != total(small())


def test_what_says_nothing_does_not_count() -> None:
    nothing = {
        "alive": (("sim", "time", "face"), np.ones((2, 3, 2), bool)),
        "strain": (("sim", "time", "face"), np.full((2, 3, 2), np.nan, np.float32), {"role": "field"}),
    }
    assert total(small(**nothing)) == total(small())


def test_attributes_do_not_count() -> None:
    assert total(small().assign_attrs(history="another")) == total(small())


def test_positions_of_runs_count_where_they_differ() -> None:
    ds = small()
    shapes = np.stack([ds.reference_position.values, ds.reference_position.values * 1.1])
    with_shapes = ds.assign(reference_position=(("sim", "node", "xyz"), shapes))
    checksums = ["x", "y"]
    whole = dataset_checksum(with_shapes, checksums)
    apart = dataset_checksum(ds.drop_vars("reference_position"), checksums, lambda k: shapes[k])
    assert whole == apart
    assert whole != dataset_checksum(ds, checksums)
