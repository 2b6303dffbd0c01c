"""Damaged and lost chunks of a dataset are never taken for data, and named with their run."""

from __future__ import annotations

import contextlib
import random
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest

from crashkit.api.campaign import open_campaign
from crashkit.api.coarsen import coarsen
from crashkit.api.describe import describe_dataset
from crashkit.api.propose import propose
from crashkit.api.source import source_of
from crashkit.api.validate import validate
from crashkit.dataset import open_dataset, reading_dataset
from crashkit.errors import ReadError
from crashkit.mesh.store import level_displacement, open_mesh, summarize_hierarchy


@pytest.fixture(scope="module")
def coarsened(demo_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = Path(shutil.copytree(demo_dataset, tmp_path_factory.mktemp("chunks") / "kart.zarr"))
    coarsen(path, [60, 16])
    return path


def read_all(path: Path) -> None:
    """Everything that info, coarsen, train and evaluate read."""
    with open_dataset(path, chunks=None) as dataset, reading_dataset(path):
        describe_dataset(dataset, path)
    campaign = open_campaign(source_of(path))
    for run in range(len(campaign.runs)):
        campaign.displacement(0)[run]
    level_displacement(path, 2)


def chunk_files(path: Path) -> list[Path]:
    return sorted(p for p in path.rglob("c*") if p.is_file())


@pytest.mark.parametrize("seed", range(12))
def test_a_flipped_bit_or_a_lost_chunk_is_refused_anywhere(coarsened: Path, seed: int) -> None:
    draw = random.Random(seed)
    every = [p for p in chunk_files(coarsened) if p.parent.name not in ("adjacency_indices", "adjacency_indptr")]
    chunk = draw.choice([p for p in every if p.parent.name == "displacement"] if seed % 2 else every)
    before = chunk.read_bytes()
    try:
        if seed % 3 == 2:
            chunk.unlink()
        else:
            damaged = bytearray(before)
            damaged[draw.randrange(len(damaged))] ^= 1 << draw.randrange(8)
            chunk.write_bytes(damaged)
        with pytest.raises(ReadError, match=r"kart\.zarr: .*(damaged|lost)"):
            read_all(coarsened)
        with contextlib.suppress(ReadError):
            assert validate(coarsened), chunk
    finally:
        chunk.write_bytes(before)


def test_run_and_chunk_are_named(coarsened: Path) -> None:
    chunk = coarsened / "displacement" / "c.7.0.0.0"
    before = chunk.read_bytes()
    try:
        chunk.write_bytes(before[:-9] + b"\xff" + before[-8:])
        with pytest.raises(ReadError, match=r"chunk displacement/c\.7\.0\.0\.0 of run run_007 is damaged"):
            read_all(coarsened)
        chunk.unlink()
        with pytest.raises(ReadError, match=r"chunk displacement/c\.7\.0\.0\.0 of run run_007 is lost"):
            open_dataset(coarsened)
    finally:
        chunk.write_bytes(before)
    read_all(coarsened)


@pytest.mark.parametrize(
    ("variable", "reads"),
    [
        *[(name, open_mesh) for name in ("reference_position", "face_nodes", "face_part", "node_id", "part_id")],
        *[(name, source_of) for name in ("reference_position", "face_nodes")],
        ("part_name", summarize_hierarchy),
        ("impact_speed", lambda path: propose(path, 2)),
    ],
)
def test_what_a_command_reads_first_may_be_what_is_damaged(
    coarsened: Path, variable: str, reads: Callable[[Path], object]
) -> None:
    chunk = next(p for p in chunk_files(coarsened) if p.parent == coarsened / variable)
    before = chunk.read_bytes()
    try:
        chunk.write_bytes(before[:-1] + bytes([before[-1] ^ 1]))
        with pytest.raises(ReadError, match=rf"kart\.zarr: chunk {variable}/c\.0.* is damaged"):
            reads(coarsened)
    finally:
        chunk.write_bytes(before)


def test_runs_that_a_user_stores_with_xarray_are_a_dataset(coarsened: Path, tmp_path: Path) -> None:
    """Chunks of zeros are left out by xarray: they are zeros, not lost."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Zarr 3 does not specify how texts are stored
        with open_dataset(coarsened) as whole:
            whole.isel(sim=slice(1, 4)).to_zarr(tmp_path / "some.zarr")
    assert validate(tmp_path / "some.zarr") == []
    with open_dataset(tmp_path / "some.zarr") as some, open_dataset(coarsened) as whole:
        assert some.displacement.equals(whole.displacement.isel(sim=slice(1, 4)))
        assert some.alignment_error.values.tolist() == [0.0] * 3


def test_a_flipped_bit_in_netcdf_values_is_refused(tmp_path: Path) -> None:
    import h5py

    from crashkit.dataset import demo_data
    from crashkit.ingestion.ingest import ingest

    path = tmp_path / "kart.nc"
    ingest([demo_data()], path)
    with h5py.File(path) as file:
        where = file["displacement"].id.get_chunk_info(5)
    raw = bytearray(path.read_bytes())
    raw[where.byte_offset + where.size // 2] ^= 1
    path.write_bytes(raw)
    with pytest.raises(ReadError, match=r"kart\.nc: cannot be read"):
        read_all(path)
