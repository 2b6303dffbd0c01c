"""OpenRadioss animation files: equal to what an independent reader got, complete or said to be incomplete."""

from __future__ import annotations

import contextlib
import gzip
import shutil
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from crashkit.errors import ReadError
from crashkit.readers import reader_for

NODES, SHELLS = 2400, 4836  # of the structure; the wall has 5 nodes and 2 facets more


@pytest.fixture
def run_b(data) -> Path:
    return data("radioss/run_b")


@pytest.fixture
def plain(run_b) -> Path:
    """The same run unpacked."""
    for packed in run_b.glob("kartA*.gz"):
        packed.with_suffix("").write_bytes(gzip.decompress(packed.read_bytes()))
        packed.unlink()
    return run_b


@pytest.fixture
def reference():
    with np.load(Path(__file__).parents[2] / "data/radioss/run_b_reference.npz") as arrays:
        return dict(arrays)


def test_positions_times_and_strains_equal_the_reference(run_b, only_run, reference):
    run = only_run(run_b)
    position = run.mesh.position + run.displacement(0, 2)
    np.testing.assert_array_equal(run.time, reference["time"])
    # A displacement is rounded to single precision once: at most half a unit in its last place.
    np.testing.assert_allclose(position[:, :NODES], reference["position"], rtol=0, atol=2e-8)
    np.testing.assert_array_equal(run.mesh.face_nodes[:SHELLS, :3], reference["triangles"])
    np.testing.assert_array_equal(run.field("plastic_strain", 0, 2)[:, :SHELLS], reference["plastic_strain"])


def test_plain_and_packed_files_are_the_same(run_b, plain, only_run, data, tmp_path):
    packed = tmp_path / "packed"
    shutil.copytree(Path(__file__).parents[2] / "data/radioss/run_b", packed)
    one, other = only_run(plain), only_run(packed)
    np.testing.assert_array_equal(one.displacement(0, 2), other.displacement(0, 2))
    np.testing.assert_array_equal(one.field("velocity", 0, 2), other.field("velocity", 0, 2))


def test_the_rigid_wall_is_a_part_of_its_own(run_b, only_run):
    mesh = only_run(run_b).mesh
    assert [(p.id, p.name, p.rigid_wall) for p in mesh.parts] == [(1, "frame", False), (1, "rigid wall", True)]
    assert (mesh.face_part == [0] * SHELLS + [1, 1]).all()
    assert (mesh.node_id[:NODES] == np.arange(1, NODES + 1)).all()
    assert (mesh.node_id[NODES:] == 0).all()


def test_triangles_end_in_minus_one_among_quadrilaterals(run_b, only_run):
    faces = only_run(run_b).mesh.face_nodes
    assert (faces[:SHELLS, 3] == -1).all()
    assert (faces[-1] >= NODES).all()


def test_the_decks_tell_units_and_end_time(run_b, only_run):
    run = only_run(run_b)
    assert run.units == "SI"
    assert run.end_time == pytest.approx(0.03)
    assert {f.name for f in run.files} >= {"kart_0000.rad", "kart_0001.rad.gz"}


def test_other_units_in_the_deck(run_b, only_run):
    deck = run_b / "kart_0000.rad"
    words = "                  Mg                  mm                   s"
    si = "                  kg                   m                   s"
    deck.write_text(deck.read_text().replace(si, words))
    assert only_run(run_b).units == "mm-s-t"


def test_without_decks_units_and_end_time_are_not_known(run_b, only_run):
    for deck in run_b.glob("*.rad*"):
        deck.unlink()
    run = only_run(run_b)
    assert (run.units, run.end_time) == (None, None)


def test_deleted_elements_are_not_alive(plain, only_run):
    file = plain / "kartA002"
    content = bytearray(file.read_bytes())
    run = only_run(plain)
    status = run._layout.kinds["shell"].status.offset
    content[status + 7] = 0
    file.write_bytes(content)
    alive = only_run(plain).alive(0, 2)
    assert alive.shape == (2, SHELLS + 2)
    assert np.argwhere(~alive).tolist() == [[1, 7]]


def test_fields_carry_what_they_measure(run_b, only_run):
    run = only_run(run_b)
    assert {n: (f.location, f.components, f.quantity) for n, f in run.fields.items()} == {
        "velocity": ("node", 3, "velocity"),
        "plastic_strain": ("face", 1, "one"),
    }
    np.testing.assert_allclose(run.field("velocity", 0, 1)[0, :NODES], [[31, 0, 0]] * NODES)


def test_several_runs_in_one_folder_are_told_apart_by_name(run_b):
    for number in (1, 2):
        shutil.copy(run_b / f"kartA00{number}.gz", run_b / f"carA00{number}.gz")
    assert set(reader_for(run_b).runs(run_b).names) == {"car", "kart"}


def test_a_folder_of_runs_gives_them_their_folders_names(run_b, tmp_path):
    campaign = tmp_path / "campaign"
    for name in ("slow", "fast"):
        shutil.copytree(run_b, campaign / name)
    assert set(reader_for(campaign).runs(campaign).names) == {"slow", "fast"}


def test_a_missing_state_is_a_problem(run_b, only_run):
    (run_b / "kartA002.gz").rename(run_b / "kartA004.gz")
    run = only_run(run_b)
    assert "2 of the animation files up to kartA004.gz are missing: kartA002, kartA003" in run.problems[0]
    assert run.displacement(0, 2).shape == (2, NODES + 5, 3)


def test_times_that_do_not_increase_are_a_problem(plain, only_run):
    shutil.copy(plain / "kartA002", plain / "kartA003")
    assert "kartA003: its time 0.00300051 is not after" in only_run(plain).problems[0]


def test_a_first_state_later_than_zero_is_read_from_the_undeformed_shape(plain, only_run, reference):
    (plain / "kartA001").unlink()
    run = only_run(plain)
    assert "kartA001" in run.problems[0]
    np.testing.assert_allclose(run.mesh.position[:NODES], reference["position"][0], atol=1e-6)
    assert np.abs(run.displacement(0, 1)[0, :NODES]).max() > 0.05


@pytest.mark.parametrize("share", [0.0, 1e-5, 0.001, 0.2, 0.6, 0.9, 0.9999])
@pytest.mark.parametrize("state", [1, 2])
def test_a_truncated_plain_file_is_refused_with_its_name(plain, only_run, state, share):
    file = plain / f"kartA00{state}"
    with file.open("r+b") as stream:
        stream.truncate(int(share * file.stat().st_size))
    with pytest.raises(ReadError, match=f"kartA00{state}"):
        only_run(plain).displacement(0, 2)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.9999])
def test_a_truncated_packed_file_is_refused_with_its_name(run_b, only_run, share):
    file = run_b / "kartA002.gz"
    with file.open("r+b") as stream:
        stream.truncate(int(share * file.stat().st_size))
    with pytest.raises(ReadError, match="kartA002"):
        only_run(run_b).displacement(0, 2)


def test_truncation_names_the_byte(plain, only_run):
    with (plain / "kartA001").open("r+b") as stream:
        stream.truncate(20_000)
    with pytest.raises(
        ReadError, match="node positions at byte 323 should take 28860 bytes, but the file ends at byte 20000"
    ):
        only_run(plain)


def test_shells_that_change_during_the_run_are_refused(plain, only_run):
    file = plain / "kartA002"
    content = bytearray(file.read_bytes())
    content[only_run(plain)._layout.kinds["shell"].nodes.offset + 3] ^= 1
    file.write_bytes(content)
    with pytest.raises(ReadError, match=r"kartA002: the shells at byte .* join other nodes than in kartA001"):
        only_run(plain).displacement(0, 2)


def test_a_count_that_cannot_be_true_is_refused(plain, only_run):
    for number in (1, 2):
        file = plain / f"kartA00{number}"
        content = bytearray(file.read_bytes())
        content[291:295] = b"\x7f\xff\xff\xff"  # nodes
        file.write_bytes(content)
    with pytest.raises(ReadError, match="should take 25769803764 bytes"):
        only_run(plain)


def test_a_position_that_is_no_number_is_named(plain, only_run):
    file = plain / "kartA002"
    content = bytearray(file.read_bytes())
    content[323 + 12 * 99 : 323 + 12 * 99 + 4] = np.array(np.nan, ">f4").tobytes()
    file.write_bytes(content)
    with pytest.raises(ReadError, match="kartA002, state 1, byte 323: the position of entry 99 is not a finite number"):
        only_run(plain).displacement(0, 2)


def write_animation(file: Path, time: float, lift: float, dead_beam: bool = False) -> None:
    """A file with every section of the format: 2 shells, 2 solids, 1 beam, 1 particle, masses, tree, time history.

    The wedge and the tetrahedron are hexahedra with repeated nodes, as the solver writes them.
    """

    def ints(*values: int) -> bytes:
        return np.array(values, ">i4").tobytes()

    def floats(values: object) -> bytes:
        return np.asarray(values, ">f4").tobytes()

    def texts(width: int, *values: str) -> bytes:
        return b"".join(v.encode().ljust(width, b"\0") for v in values)

    nodes = 10
    position = np.arange(30.0).reshape(nodes, 3) ** 1.5
    position[:, 2] += lift
    out = [
        b"\0\0\x54\x2c",
        floats(time),
        texts(81, "Time=", "ModAnim", "Radioss Run="),
        ints(1, 1, 1, 1, 1, 1, 0, 1, 0, 0),
    ]
    out += [ints(nodes, 2, 2, 1, 1, 2, 1, 1), np.zeros(6, ">u2").tobytes(), floats(position)]
    out += [ints(0, 1, 2, 3, 3, 2, 4, 4), b"\1\1", ints(1, 2), texts(50, "  7:door", "  3:rail"), bytes(6 * nodes)]
    out += [texts(81, "Time Step", "Thickness"), floats(np.full(nodes, 1e-6)), floats([1.5, 2.5])]
    out += [
        texts(81, "Velocity", "Displacement"),
        floats(np.full((nodes, 3), 9)),
        floats(np.full((nodes, 3), [0, 0, lift])),
    ]
    out += [texts(81, "Stress (upper)"), floats([[1, 2, 3], [4, 5, 6]])]
    out += [floats(np.ones(2)), floats(np.ones(nodes)), ints(*range(101, 111)), ints(11, 12), ints(*[0] * 6)]
    # solids
    out += [
        ints(2, 1, 1, 1),
        ints(0, 1, 2, 3, 4, 4, 7, 7, 5, 6, 7, 7, 8, 8, 8, 8),
        b"\1\1",
        ints(2),
        texts(50, "  5:block"),
    ]
    out += [texts(81, "Plastic Strain"), floats([0.25, 0.75]), texts(81, "Stress"), floats(np.arange(12))]
    out += [floats([1, 1]), ints(21, 22), ints(0, 0, 0)]
    # beams
    out += [ints(1, 1, 1, 1, 1), ints(8, 9), bytes([not dead_beam]), ints(1), texts(50, "  9:strut")]
    out += [
        texts(81, "Axial Force"),
        floats([-4]),
        texts(81, "Force"),
        floats(np.arange(9)),
        ints(0),
        floats([1]),
        ints(31),
    ]
    out += [ints(0, 0, 0)]
    # tree, time history
    out += [ints(1), texts(50, "all"), ints(-1), ints(0), ints(2, 1, 2), ints(1, 1), ints(1, 1), ints(1, 1)]
    out += [texts(50, "steel"), ints(1), texts(50, "shell"), ints(1)]
    out += [ints(1, 0, 0, 1), ints(5), texts(50, "node 5"), ints(31), texts(50, "strut")]
    # particles
    out += [ints(1, 1, 1, 0), ints(4), b"\1", ints(1), texts(50, "  8:tank"), texts(81, "Density"), floats([1000])]
    out += [floats([1]), ints(105), ints(0, 0, 0)]
    file.write_bytes(b"".join(out))


@pytest.fixture
def every_section(tmp_path) -> Path:
    write_animation(tmp_path / "carA001", 0.0, 0.0)
    write_animation(tmp_path / "carA002", 1.0, 0.5, dead_beam=True)
    return tmp_path


def test_solids_beams_and_particles_are_cells(every_section, only_run):
    run = only_run(every_section)
    mesh = run.mesh
    assert run.problems == ()
    assert [(p.id, p.name) for p in mesh.parts] == [(7, "door"), (3, "rail"), (5, "block"), (9, "strut"), (8, "tank")]
    assert mesh.face_nodes.tolist() == [[0, 1, 2, 3], [3, 2, 4, -1]]
    assert mesh.face_part.tolist() == [0, 1]
    assert mesh.cell_type.tolist() == [13, 10, 3, 1]  # wedge, tetrahedron, line, vertex
    assert mesh.cell_part.tolist() == [2, 2, 3, 4]
    assert mesh.cell_id.tolist() == [21, 22, 31, 105]
    assert [sorted(n for n in c if n >= 0) for c in mesh.cell_nodes.tolist()] == [
        [0, 1, 2, 3, 4, 7],
        [5, 6, 7, 8],
        [8, 9],
        [4],
    ]
    assert mesh.node_id.tolist() == list(range(101, 111))


def test_fields_of_every_kind_are_missing_on_the_others(every_section, only_run):
    run = only_run(every_section)
    nan = np.nan
    np.testing.assert_array_equal(run.field("thickness", 0, 1), [[1.5, 2.5]])
    np.testing.assert_array_equal(run.field("stress_upper", 0, 1), [[[1, 2, 3], [4, 5, 6]]])
    np.testing.assert_array_equal(run.field("solid_plastic_strain", 1, 2), [[0.25, 0.75, nan, nan]])
    np.testing.assert_array_equal(run.field("beam_axial_force", 0, 1), [[nan, nan, -4, nan]])
    np.testing.assert_array_equal(run.field("sph_density", 0, 1), [[nan, nan, nan, 1000]])
    assert run.fields["solid_stress"].components == 6
    assert run.fields["beam_axial_force"].quantity == "force"
    assert "displacement" not in run.fields


def test_dead_beams_are_told(every_section, only_run):
    run = only_run(every_section)
    assert run.alive_cells(0, 2).tolist() == [[True] * 4, [True, True, False, True]]
    assert run.alive(0, 2).all()
    np.testing.assert_allclose(run.displacement(1, 2)[0], np.full((10, 3), [0, 0, 0.5]), atol=1e-5)


def test_a_file_cut_short_in_any_section_is_refused(every_section, only_run):
    file = every_section / "carA001"
    whole = file.read_bytes()
    for length in range(0, len(whole) - 1, 5):
        file.write_bytes(whole[:length])
        with pytest.raises(ReadError, match="carA00"):
            only_run(every_section)


def test_bytes_behind_the_end_are_a_problem(every_section, only_run):
    for number in (1, 2):
        file = every_section / f"carA00{number}"
        file.write_bytes(file.read_bytes() + b"\0" * 8)
    assert "8 bytes behind byte" in only_run(every_section).problems[0]


def test_a_file_made_to_fill_the_memory_is_refused(run_b, only_run):
    """Zeros behind the content grow a thousandfold; they are not unpacked, and are said."""
    first = sorted(run_b.glob("kartA*.gz"))[0]
    whole = gzip.decompress(first.read_bytes())
    first.write_bytes(gzip.compress(whole + bytes(200 << 20), 9))
    run = only_run(run_b)
    assert "bytes behind byte" in run.problems[0]
    assert run._content(0).held < len(whole) + (2 << 20)
    # The header itself may ask for it: 2e9 nodes in a file of some kilobytes.
    header = bytearray(whole)
    header[251 + 40 : 251 + 44] = (150_000_000).to_bytes(4, "big")
    first.write_bytes(gzip.compress(bytes(header) + bytes(200 << 20), 9))
    with pytest.raises(ReadError, match="which no result does; the file is damaged or was made to fill the memory"):
        only_run(run_b)


def test_two_files_of_one_number_are_refused(plain):
    shutil.copy(plain / "kartA001", plain / "kartA0001")
    with pytest.raises(ReadError, match="kartA0001 and kartA001 have the same number"):
        list(reader_for(plain).runs(plain))


def test_a_gzip_file_is_unpacked_no_further_than_its_header_counts(run_b, plain, only_run):
    """A hundred megabytes of zeros behind the last array, a hundred kilobytes on the disk."""
    for file in plain.glob("kartA0*"):
        packed = gzip.compress(file.read_bytes() + bytes(100 << 20 if file.name == "kartA001" else 0), 1)
        file.with_name(f"{file.name}.gz").write_bytes(packed)
        file.unlink()
    tracemalloc.start()
    try:
        with contextlib.suppress(ReadError):  # that more follows may be refused, too
            only_run(run_b).displacement(0, 2)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 30 << 20
