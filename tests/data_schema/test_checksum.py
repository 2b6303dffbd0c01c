"""Checksums: the same for the same content, another for every change, whatever the order of storage."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable
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
            "node_id": ("node", np.arange(5)),
            "face_nodes": (("face", "corner"), np.array([[0, 1, 2], [2, 3, 4]], np.int32)),
            "face_part": ("face", np.array([0, 1], np.int32)),
            "face_id": ("face", np.array([7, 8])),
            "part_id": ("part", np.array([1, 2])),
            "part_name": ("part", np.array(["rail", "floor"])),
            "cell_nodes": (("cell", "cell_corner"), np.array([[0, 1, 2, 3], [1, 2, 3, 4]], np.int32)),
            "cell_type": ("cell", np.array([10, 10], np.uint8)),
            "cell_part": ("cell", np.array([0, 0], np.int32)),
            "cell_id": ("cell", np.array([9, 10])),
            "speed": ("sim", [3.0, 4.0], {"role": "parameter"}),
        },
        coords={"sim": ["a", "b"], "time": [0.0, 1.0, 2.0]},
    ).assign(changes)


SHARED = [
    "time", "node_id", "face_nodes", "face_part", "face_id", "part_id", "part_name", "cell_nodes", "cell_type", "cell_part",
    "cell_id", "reference_position",
]  # fmt: skip


def total(ds: xr.Dataset) -> str:
    return dataset_checksum(ds, [run_checksum(digests_of_run(ds, k)) for k in range(ds.sizes["sim"])])


@given(st.integers(1, 300), st.integers(1, 200_000), st.integers(1, 36))
def test_blocks_cover_everything_once_and_stay_small(states: int, length: int, entry: int) -> None:
    found = checksum.blocks(states, length, entry)
    assert found[0][0] == 0
    assert found[-1][1] == length
    assert all(a[1] == b[0] for a, b in pairwise(found))
    assert max(b - a for a, b in found) * states * entry <= max(checksum.BLOCK_BYTES, states * entry)


@given(st.integers(1, 300), st.integers(1, 200_000), st.integers(1, 36))
def test_blocks_are_as_few_as_their_size_allows_and_of_one_length_but_the_last(
    states: int, length: int, entry: int
) -> None:
    lengths = [b - a for a, b in checksum.blocks(states, length, entry)]
    fit = max(1, checksum.BLOCK_BYTES // (states * entry))
    fewest = -(-length // fit)
    assert len(lengths) <= fewest
    assert set(lengths[:-1]) <= {checksum.block_length(states, length, entry)}
    assert lengths[0] == -(-length // fewest)


def test_blocks_of_nothing() -> None:
    assert checksum.blocks(3, 0, 4) == []
    assert checksum.block_length(0, 5, 12) == 5
    assert checksum.block_length(3, 0, 0) == 1


def test_a_block_has_eight_mebibytes() -> None:
    assert checksum.blocks(2, 1 << 21, 4) == [(0, 1 << 20), (1 << 20, 1 << 21)]


def test_a_digest_is_the_sha256_of_little_endian_numbers_row_by_row() -> None:
    values = np.arange(6, dtype="<f4").reshape(2, 3)
    expected = hashlib.sha256(struct.pack("<6f", *range(6))).digest()
    assert checksum.block_digest(values).sha256 == expected
    assert checksum.block_digest(values.astype(">f4")).sha256 == expected
    assert checksum.block_digest(np.asfortranarray(values)).sha256 == expected


@pytest.mark.parametrize(
    ("block", "is_default"),
    [
        (np.array([True, True]), True),
        (np.array([True, False]), False),
        (np.array([np.nan, np.nan], np.float32), True),
        (np.array([np.nan, 0.0], np.float32), False),
        (np.array([0.0, np.nan], np.float32), False),
        (np.array([0.0, 0.0], np.float32), False),
    ],
)
def test_the_default_says_nothing(block: np.ndarray, is_default: bool) -> None:
    assert checksum.block_digest(block).is_default is is_default


def test_an_array_is_the_digest_of_its_blocks_in_order_unless_all_are_default() -> None:
    one, two = checksum.BlockDigest(b"1", True), checksum.BlockDigest(b"2", False)
    assert checksum.array_digest([one, two]) == hashlib.sha256(b"12").hexdigest()
    assert checksum.array_digest(iter([two, one])) == hashlib.sha256(b"21").hexdigest()
    assert checksum.array_digest([one, one]) is None


def test_a_run_is_the_digest_of_its_arrays_by_name() -> None:
    expected = hashlib.sha256(b"alive 11\ndisplacement 22").hexdigest()
    assert run_checksum({"displacement": "22", "alive": "11"}) == expected


def test_results_are_read_in_blocks_of_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checksum, "BLOCK_BYTES", 3 * 12 * 2)  # two nodes of three states
    run = small()["displacement"].isel(sim=1)
    found = list(checksum.result_blocks(run))
    assert [(a, b) for a, b, _ in found] == [(0, 2), (2, 4), (4, 5)]
    assert np.array_equal(np.concatenate([values for _, _, values in found], axis=1), run.values)


def test_results_are_displacement_erosion_and_fields() -> None:
    more = {
        "strain": (("sim", "time", "face"), np.zeros((2, 3, 2), np.float32), {"role": "field"}),
        "cell_alive": (("sim", "time", "cell"), np.zeros((2, 3, 2), bool)),
        "alive": (("sim", "time", "face"), np.zeros((2, 3, 2), bool)),
    }
    assert checksum.results(small(**more)) == ["displacement", "alive", "cell_alive", "strain"]
    assert digests_of_run(small(**more), 0).keys() == {"displacement", "alive", "cell_alive", "strain"}
    assert digests_of_run(small(), 0) != digests_of_run(small(), 1)


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


def altered(values: np.ndarray) -> np.ndarray:
    """The last entry changed."""
    out = values.copy()
    out.flat[-1] = str(out.flat[-1])[::-1] if out.dtype.kind == "U" else out.flat[-1] + 1
    return out


@pytest.mark.parametrize("name", SHARED)
def test_everything_that_runs_share_counts(name: str) -> None:
    ds = small()
    assert total(ds.assign({name: ds[name].copy(data=altered(ds[name].values))})) != total(ds)


def test_what_counts_as_shared_is_all_of_the_layout_without_runs_but_copies() -> None:
    ds = small(node_x=("node", np.zeros(5)), mesh=((), 0), complete=("sim", [True, True]), mass=("node", np.ones(5)))
    assert sorted(checksum.shared(ds)) == sorted(SHARED)
    assert total(ds) == total(small())


def test_an_array_of_another_shape_is_another() -> None:
    ds = small()
    turned = ds["cell_nodes"].values.reshape(4, 2)
    other = ds.drop_vars(["cell_nodes", "cell_type", "cell_part", "cell_id"]).assign(
        cell_nodes=(("cell", "cell_corner"), turned)
    )
    straight = other.assign(cell_nodes=(("cell", "cell_corner"), turned.reshape(2, 4)))
    assert total(other) != total(straight)


@pytest.mark.parametrize(
    "stored",
    [
        lambda ds: ds.assign(part_name=ds.part_name.astype(object)),
        lambda ds: ds.assign(part_name=ds.part_name.astype("U40")),
        lambda ds: ds.assign(face_nodes=ds.face_nodes.astype(np.int64), cell_type=ds.cell_type.astype(int)),
        lambda ds: ds.assign(face_nodes=ds.face_nodes.astype(">i4"), reference_position=ds.reference_position.astype(">f8")),
    ],
    ids=["objects", "longer text", "wider numbers", "big endian"],
)  # fmt: skip
def test_how_a_shared_array_is_stored_does_not_count(stored: Callable[[xr.Dataset], xr.Dataset]) -> None:
    assert total(stored(small())) == total(small())


def test_names_of_parts_are_kept_apart() -> None:
    one, other = (small(part_name=("part", names)) for names in (["ab", "c"], ["a", "bc"]))
    assert total(one) != total(other)


def test_parameters_count_by_name_whatever_their_order() -> None:
    ds = small().drop_vars("speed")
    a, b = ("sim", [1.0, 2.0], {"role": "parameter"}), ("sim", [3.0, 4.0], {"role": "parameter"})
    assert total(ds.assign(a=a, b=b)) == total(ds.assign(b=b, a=a))
    assert total(ds.assign(a=a, b=b)) != total(ds.assign(a=b, b=a))


def test_every_run_needs_its_checksum() -> None:
    with pytest.raises(ValueError, match="zip"):
        dataset_checksum(small(), ["x"])


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
    other = shapes.copy()
    other[1, 4, 2] += 1e-9
    assert whole != dataset_checksum(ds.assign(reference_position=(("sim", "node", "xyz"), other)), checksums)
