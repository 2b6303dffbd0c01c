"""LS-DYNA d3plot: equal to VTK's reader where that reads it, to lasso-python elsewhere, and incomplete families told."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from lasso.dyna import D3plot
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline
from vtkmodules.vtkIOLSDyna import vtkLSDynaReader

from crashkit.errors import ReadError
from crashkit.readers import reader_for


@pytest.fixture
def solids(data) -> Path:
    return data("d3plot/solid_int")


def overwrite(file: Path, offset: int, value: object, kind: str = "<f4") -> None:
    content = bytearray(file.read_bytes())
    raw = np.array(value, kind).tobytes()
    content[offset : offset + len(raw)] = raw
    file.write_bytes(content)


@pytest.mark.parametrize("name", ["simple", "beamip"])
def test_coordinates_and_times_equal_vtks_reader(data, only_run, name):
    folder = data(f"d3plot/{name}")
    reader = vtkLSDynaReader()
    reader.SetFileName(str(folder / "d3plot"))
    reader.UpdateInformation()
    times = reader.GetOutputInformation(0).Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS())
    run = only_run(folder)
    assert run.time.tolist() == list(times)
    for state, time in enumerate(times):
        reader.UpdateTimeStep(time)
        blocks = reader.GetOutput()
        (mesh,) = filter(None, (blocks.GetBlock(k) for k in range(blocks.GetNumberOfBlocks())))
        current = (run.mesh.position + run.displacement(state, state + 1)[0]).astype(np.float32)
        # VTK numbers the nodes as its cells use them, so they are compared corner by corner.
        ours = run.mesh.face_nodes if len(run.mesh.face_nodes) else run.mesh.cell_nodes
        corners = vtk_to_numpy(mesh.GetCells().GetConnectivityArray()).reshape(ours.shape)
        assert mesh.GetNumberOfPoints() == len(run.mesh.node_id)
        np.testing.assert_array_equal(current[ours], vtk_to_numpy(mesh.GetPoints().GetData())[corners])


@pytest.mark.parametrize("name", ["simple", "beamip", "solid_int"])
def test_states_equal_lasso(data, only_run, name):
    folder = data(f"d3plot/{name}")
    theirs = D3plot(str(folder / "d3plot"))
    run, states = only_run(folder), len(theirs.arrays["timesteps"])
    position = theirs.arrays["node_coordinates"].astype(float)
    expected = (theirs.arrays["node_displacement"] - position).astype(np.float32)
    np.testing.assert_array_equal(run.time, theirs.arrays["timesteps"])
    np.testing.assert_array_equal(run.mesh.position, position)
    np.testing.assert_array_equal(run.displacement(0, states), expected)
    np.testing.assert_array_equal(run.displacement(states - 1, states), expected[-1:])


def test_the_node_block_holds_positions_not_displacements(solids, only_run):
    run = only_run(solids)
    assert np.abs(run.displacement(0, 1)).max() == 0
    assert np.abs(run.mesh.position).max() > 10


def test_a_block_that_is_zero_at_first_holds_displacements(solids, only_run):
    expected = only_run(solids).displacement(0, 5)
    first, count = only_run(solids)._file.blocks["displacement"]
    for state in range(5):
        overwrite(solids / f"d3plot{state + 1:02d}", 4 * first, expected[state])
    assert expected[0].size == count
    np.testing.assert_array_equal(only_run(solids).displacement(0, 5), expected)


def test_parts_ids_and_titles(solids, only_run):
    mesh = only_run(solids).mesh
    assert [(p.id, p.name) for p in mesh.parts] == [
        (1000, "solid_mat_1"),
        (2000, "solid_mat_2"),
        (3000, "shell_mat_1"),
        (4000, "shell_mat_2"),
    ]
    assert set(mesh.face_part) == {2, 3}
    assert set(mesh.cell_part) == {0, 1}
    assert mesh.cell_type.tolist() == [12] * 16
    assert mesh.face_id.tolist() == list(range(17, 33))
    assert mesh.node_id.tolist() == D3plot(str(solids / "d3plot")).arrays["node_ids"].tolist()
    assert mesh.node_id[96] == 111


def test_a_part_named_as_a_rigid_wall_is_one(solids, only_run):
    file = solids / "d3plot"
    file.write_bytes(file.read_bytes().replace(b"shell_mat_2", b"rigid wall "))
    assert [p.rigid_wall for p in only_run(solids).mesh.parts] == [False, False, False, True]


def test_beams_are_lines(data, only_run):
    run = only_run(data("d3plot/beamip"))
    assert run.mesh.cell_type.tolist() == [3]
    assert run.mesh.cell_nodes.tolist() == [[0, 1]]
    assert run.mesh.parts[0].name == "SECTION_BEAM"
    assert run.alive_cells(0, 2).tolist() == [[True], [True]]
    theirs = D3plot(str(run.files[0])).arrays
    np.testing.assert_array_equal(run.field("beam_axial_force", 0, 2), theirs["element_beam_axial_force"])


def test_fields_equal_lasso_and_are_missing_elsewhere(solids, only_run):
    run, theirs = only_run(solids), D3plot(str(solids / "d3plot")).arrays
    np.testing.assert_array_equal(run.field("velocity", 0, 5), theirs["node_velocity"])
    strain = theirs["element_shell_effective_plastic_strain"].max(axis=2)
    np.testing.assert_array_equal(run.field("plastic_strain", 1, 4), strain[1:4])
    np.testing.assert_allclose(run.field("stress", 0, 5), theirs["element_shell_stress"].mean(axis=2), atol=1e-4)
    assert run.field("solid_plastic_strain", 0, 5).shape == (5, 16)
    assert run.fields["solid_von_mises"].quantity == "stress"


def test_von_mises_of_uniaxial_stress_is_that_stress(solids, only_run):
    run = only_run(solids)
    first, count = run._file.blocks["shell"]
    layers = np.zeros((16, 52), np.float32)
    layers[:, 8 * 2] = -250.0  # xx of the third of five layers; the others are free of stress
    overwrite(solids / "d3plot01", 4 * first, layers)
    assert layers.size == count
    np.testing.assert_allclose(only_run(solids).field("von_mises", 0, 1), np.full((1, 16), 250.0))
    np.testing.assert_allclose(only_run(solids).field("stress", 0, 1)[0, :, 0], np.full(16, -50.0))


def test_deleted_elements_are_not_alive(solids, only_run):
    blocks = only_run(solids)._file.blocks
    overwrite(solids / "d3plot03", 4 * (blocks["shell_alive"][0] + 5), 0)
    overwrite(solids / "d3plot04", 4 * (blocks["solid_alive"][0] + 2), 0)
    run = only_run(solids)
    assert np.argwhere(~run.alive(0, 5)).tolist() == [[2, 5]]
    assert np.argwhere(~run.alive_cells(0, 5)).tolist() == [[3, 2]]


def test_where_nodes_are_deleted_their_elements_are_not_alive(solids, only_run):
    """MDLOPT = 1: one word a node instead of one an element."""
    first = only_run(solids)._file.blocks["solid_alive"][0]
    overwrite(solids / "d3plot", 4 * 36, -5, "<i4")
    for number in range(1, 6):
        file = solids / f"d3plot{number:02d}"
        words = np.fromfile(file, "<f4")
        nodes = np.ones(106, "<f4")
        nodes[60] = number < 4
        np.concatenate([words[:first], nodes, [np.float32(-999999)], np.zeros(50)]).astype("<f4").tofile(file)
    run = only_run(solids)
    assert run.problems == ()
    touched = (run.mesh.face_nodes == 60).any(axis=1)
    assert touched.any()
    np.testing.assert_array_equal(run.alive(0, 5), [[True] * 16] * 3 + [(~touched).tolist()] * 2)


def test_thick_shells_are_hexahedra(solids, only_run):
    """The solids of the run, announced as thick shells."""
    expected = only_run(solids).mesh
    file = solids / "d3plot"
    words = np.fromfile(file, "<i4")
    for solid, thick in ((23, 40), (24, 41), (27, 42)):  # numbers of elements, of materials, of variables
        words[[solid, thick]] = [0, words[solid]]
    numbering = 128 + 3 * 106 + 9 * 16 + 5 * 16
    words[numbering + np.array([6, 9])] = [0, 16]
    ids = numbering + 16 + 106
    words[ids : ids + 32] = np.roll(words[ids : ids + 32], 16)  # those of thick shells stand behind the shells'
    words.tofile(file)
    run = only_run(solids)
    assert run.problems == ()
    np.testing.assert_array_equal(run.mesh.cell_nodes, expected.cell_nodes)
    np.testing.assert_array_equal(run.mesh.cell_id, expected.cell_id)
    np.testing.assert_array_equal(run.mesh.cell_part, expected.cell_part)
    assert {"tshell_stress", "tshell_plastic_strain"} <= set(run.fields)
    assert run.alive_cells(0, 5).all()


def test_variables_that_do_not_add_up_are_not_guessed(solids, only_run):
    """Words of other variables (neips) leave it open where a field stands."""
    overwrite(solids / "d3plot", 4 * 35, 2, "<i4")
    run = only_run(solids)
    np.testing.assert_array_equal(run.displacement(0, 1), np.zeros((1, 106, 3)))
    assert "plastic_strain" not in run.fields
    with pytest.raises(ReadError, match=r"plastic_strain is not read: shells hold 52 words each, .* account for 57"):
        run.field("plastic_strain", 0, 1)


def test_the_end_time_is_taken_from_a_deck_beside(solids, only_run):
    assert only_run(solids).end_time is None
    (solids / "main.k").write_text("*KEYWORD\n*CONTROL_TERMINATION\n$   endtim\n     0.025         0\n*END\n")
    assert only_run(solids).end_time == 0.025
    (solids / "other.key").write_text("*CONTROL_TERMINATION\n0.5,0\n")
    assert only_run(solids).end_time is None


def test_a_family_with_gaps_is_read_in_the_order_of_numbers_and_told(solids, only_run):
    for old, new in (("05", "100"), ("04", "12")):
        (solids / f"d3plot{old}").rename(solids / f"d3plot{new}")
    run = only_run(solids)
    assert "95 files of the family up to d3plot100 are missing: d3plot04, d3plot05" in run.problems[0]
    assert len(run.time) == 5
    assert (np.diff(run.time) > 0).all()


def test_missing_states_are_refused(solids, only_run):
    for file in solids.glob("d3plot0*"):
        file.unlink()
    with pytest.raises(ReadError, match=r"no state found in 1 file\(s\).*d3plot01"):
        only_run(solids)


def test_a_run_without_displacements_is_refused(data, only_run):
    with pytest.raises(ReadError, match=r"no displacements \(IU = 0\), only temperature, velocity"):
        only_run(data("d3plot/node_temperature"))


def test_a_mesh_adapted_midway_is_a_problem(solids, only_run):
    shutil.copy(solids / "d3plot", solids / "d3plotaa")
    assert "adapted during the run (d3plotaa is there)" in only_run(solids).problems[0]


@pytest.mark.parametrize("share", [0.3, 0.9, 0.97])
def test_a_truncated_state_file_is_a_problem_with_name_and_byte(solids, only_run, share):
    file = solids / "d3plot03"
    with file.open("r+b") as stream:
        stream.truncate(int(share * file.stat().st_size))
    run = only_run(solids)
    assert len(run.time) == 4
    assert "d3plot03: behind 0 whole states of 11932 bytes, at byte 0 of" in run.problems[0]


def test_cut_off_padding_changes_nothing(solids, only_run):
    expected = only_run(solids).displacement(0, 5)
    with (solids / "d3plot05").open("r+b") as stream:
        stream.truncate(11936)
    run = only_run(solids)
    assert run.problems == ()
    np.testing.assert_array_equal(run.displacement(0, 5), expected)


def test_an_empty_state_file_is_a_problem(solids, only_run):
    (solids / "d3plot02").write_bytes(b"")
    assert "d3plot02: behind 0 whole states" in only_run(solids).problems[0]


@pytest.mark.parametrize("length", [256, 1000, 3000, 3500, 3700])
def test_a_truncated_first_file_is_refused(solids, length):
    with (solids / "d3plot").open("r+b") as stream:
        stream.truncate(length)
    with pytest.raises(ReadError, match="d3plot"):
        next(reader_for(solids, "d3plot").runs(solids))


@pytest.mark.parametrize(
    ("word", "value", "message"),
    [
        (16, 2**30, "asks for .* bytes of mesh"),  # nodes
        (31, 2**30, "asks for .* bytes of mesh"),  # shells
        (31, -5, "word NEL4 of the header is -5"),
        (33, 2**30, "no state found"),  # variables of a shell
        (39, 2**30, "asks for .* bytes of mesh"),  # numbering
        (15, 2, "2-D model"),
        (23, -16, "ten-node solids"),
        (57, 2**30, "bytes of mesh"),  # extra header words
    ],
)
def test_a_header_that_cannot_be_true_is_refused(solids, word, value, message):
    overwrite(solids / "d3plot", 4 * word, value, "<i4")
    with pytest.raises(ReadError, match=message):
        next(reader_for(solids, "d3plot").runs(solids))


def test_a_node_number_that_is_too_large_is_named(solids):
    overwrite(solids / "d3plot", 4 * (64 + 64 + 3 * 106 + 9 * 16), 5000, "<i4")
    with pytest.raises(ReadError, match="shell 0 names node 4999; expected 0 to 105"):
        next(reader_for(solids, "d3plot").runs(solids))


def test_a_position_that_is_no_number_is_named(solids, only_run):
    first, _ = only_run(solids)._file.blocks["displacement"]
    overwrite(solids / "d3plot04", 4 * (first + 3 * 31), np.inf)
    with pytest.raises(ReadError, match="d3plot04, state 3, byte 0: the position of entry 31 is not a finite number"):
        only_run(solids).displacement(0, 5)


def test_times_that_do_not_increase_are_a_problem(solids, only_run):
    overwrite(solids / "d3plot02", 0, 0.0)
    assert "d3plot02, state 1, byte 0: its time 0 is not after 0" in only_run(solids).problems[0]


def test_lasso_leaves_the_root_logger_alone(solids):
    """In a process of its own: in this one lasso-python is imported already."""
    script = (
        "import logging, sys; from pathlib import Path; from crashkit.readers import reader_for; path = Path(sys.argv[1]);"
        "run = next(reader_for(path).runs(path)); run.displacement(0, 1); print(logging.getLogger().handlers)"
    )
    found = subprocess.run([sys.executable, "-c", script, str(solids)], check=True, capture_output=True, text=True)
    assert found.stdout.strip() == "[]"


def test_double_precision(solids, only_run, tmp_path):
    """The same run in 8-byte words: what LS-DYNA double precision writes."""
    folder = tmp_path / "double"
    folder.mkdir()
    states = only_run(solids)
    _widen(solids / "d3plot", folder / "d3plot", _GEOMETRY_FLOATS)
    for file in sorted(solids.glob("d3plot0*")):
        words = np.fromfile(file, "<f4")
        words.astype("<f8").tofile(folder / file.name)
    run = only_run(folder)
    np.testing.assert_allclose(run.displacement(0, 5), states.displacement(0, 5), atol=1e-6)
    np.testing.assert_array_equal(run.field("plastic_strain", 0, 5), states.field("plastic_strain", 0, 5))
    assert [p.id for p in run.mesh.parts] == [1000, 2000, 3000, 4000]


# Words of the geometry file that are floats: the version, the coordinates, and the two end marks.
_GEOMETRY_FLOATS = [14, *range(128, 128 + 318), 836]


def _widen(source: Path, target: Path, floats: list[int]) -> None:
    words = np.fromfile(source, "<i4")
    wide = words.astype("<i8")
    wide[floats] = words[floats].view("<f4").astype("<f8").view("<i8")
    end = 837  # behind the geometry's end mark stand titles, 18 words of 4 bytes each in either precision
    raw = bytearray(wide[:end].tobytes())
    at = end
    kind = int(words[at])
    raw += np.array([kind], "<i8").tobytes()
    if kind == 90000:
        raw += words[at + 1 : at + 19].tobytes()
        at += 19
        raw += np.array([int(words[at])], "<i8").tobytes()
    count = int(words[at + 1])
    raw += np.array([count], "<i8").tobytes()
    at += 2
    for _ in range(count):
        raw += np.array([int(words[at])], "<i8").tobytes() + words[at + 1 : at + 19].tobytes()
        at += 19
    raw += np.array([-999999.0], "<f8").tobytes()
    raw += bytes(-len(raw) % 4096)
    target.write_bytes(raw)


@pytest.fixture
def particles(data) -> Path:
    """25 particles of part 101 above a wall that LS-DYNA drew as part 1, release 7: titles come with part numbers."""
    return data("d3plot/sph_r7")


def _retitle(file: Path, numbers: list[int], titles: list[str]) -> None:
    """Write numbers and titles of the parts; they stand behind the word 90001 and their count."""
    words = np.fromfile(file, "<i4")
    start = 4 * (int(np.flatnonzero(words == 90001)[0]) + 2)
    for k, (number, title) in enumerate(zip(numbers, titles, strict=True)):
        overwrite(file, start + 76 * k, number, "<i4")
        overwrite(file, start + 76 * k + 4, list(title.ljust(72).encode()), "u1")


@pytest.mark.parametrize("release", ["r7", "r12"])
def test_a_wall_that_ls_dyna_drew_is_one_in_every_release(data, only_run, release):
    """Release 12 numbers titles 1, 2 in the order of the parts; release 7 writes the numbers of the parts."""
    parts = only_run(data(f"d3plot/sph_{release}")).mesh.parts
    assert [(p.id, p.name, p.rigid_wall) for p in parts] == [
        (101, "part 101", False),
        (1, "null shells for visualization", True),
    ]


def test_titles_by_position_and_by_number(data, only_run):
    later, earlier = data("d3plot/sph_r12"), data("d3plot/sph_r7")
    _retitle(later / "d3plot", [1, 2], ["front rail", "rigid wall"])
    _retitle(earlier / "d3plot", [1, 101], ["rigid wall", "front rail"])
    for folder in (later, earlier):
        parts = only_run(folder).mesh.parts
        assert [(p.id, p.name, p.rigid_wall) for p in parts] == [(101, "front rail", False), (1, "rigid wall", True)]


def test_particles_die_by_the_sign_of_their_material(particles, only_run):
    """The first word of a particle's block; the block stands behind the word that says whether the shell lives."""
    run = only_run(particles)
    assert run.alive_cells(0, 10).all()
    words = 845
    for state in (5, 6):
        overwrite(particles / "d3plot01", 4 * (state * words + 320 + 21 * 3), -1.0)
    alive = only_run(particles).alive_cells(0, 10)
    assert np.argwhere(~alive).tolist() == [[5, 3], [6, 3]]


def test_results_of_particles_equal_lasso(particles, only_run):
    theirs = D3plot(str(particles / "d3plot")).arrays
    run = only_run(particles)
    for name, array in (("sph_pressure", "sph_pressure"), ("sph_density", "sph_density"), ("sph_mass", "sph_mass")):
        np.testing.assert_array_equal(run.field(name, 0, 10), theirs[array])
    np.testing.assert_array_equal(run.field("sph_stress", 0, 10), theirs["sph_stress"])
    np.testing.assert_array_equal(run.field("sph_plastic_strain", 3, 4), theirs["sph_effective_plastic_strain"][3:4])
    assert run.fields["sph_pressure"].quantity == "stress"


def test_shells_with_strain_tensors_give_what_stands_before_them(particles, only_run):
    """Plastic strain tensors of three surfaces (IDTDT = 100): 18 words more a shell than lasso-python can place."""
    before = {n: only_run(particles).field(n, 0, 10) for n in ("stress", "plastic_strain", "thickness")}
    moved = only_run(particles).displacement(0, 10)
    state, behind_shell = 845, 286 + 33
    overwrite(particles / "d3plot", 4 * 33, 33 + 18, "<i4")
    overwrite(particles / "d3plot", 4 * 56, 100, "<i4")
    for file in sorted(particles.glob("d3plot0*")):
        words = np.fromfile(file, "<f4")
        count = (int(np.flatnonzero(words)[-1]) + 1) // state
        states, rest = words[: count * state].reshape(count, state), words[count * state :]
        np.concatenate([np.insert(states, [behind_shell] * 18, 7.5, axis=1).ravel(), rest]).tofile(file)
    run = only_run(particles)
    assert not run.problems
    for name, values in before.items():
        np.testing.assert_array_equal(run.field(name, 0, 10), values)
    np.testing.assert_array_equal(run.displacement(0, 10), moved)
    with pytest.raises(
        ReadError, match=r"strain tensors \(IDTDT = 100, asked for by STRFLG of \*DATABASE_EXTENT_BINARY\)"
    ):
        run.field("strain", 0, 1)
    assert "strain" not in run.fields


def test_d3part_is_left_aside_and_read_where_it_is_all_there_is(solids, only_run):
    moved = only_run(solids).displacement(0, 5)
    for file in sorted(solids.glob("d3plot*")):
        shutil.copy(file, solids / file.name.replace("d3plot", "d3part"))
    overwrite(solids / "d3part", 4 * 11, 5, "<i4")
    runs = reader_for(solids).runs(solids)
    assert runs.names == (solids.name,)
    assert "d3part left aside, since d3plot is there" in runs.passed_over[0]
    asked = only_run(solids / "d3part")
    assert (asked.name, asked.files[0].name) == (solids.name, "d3part")
    for file in sorted(solids.glob("d3plot*")):
        file.unlink()
    alone = only_run(solids)
    assert (alone.name, alone.files[0].name) == (solids.name, "d3part")
    np.testing.assert_array_equal(alone.displacement(0, 5), moved)


def test_two_files_of_one_number_are_refused(solids):
    shutil.copy(solids / "d3plot02", solids / "d3plot2")
    with pytest.raises(ReadError, match="d3plot02 and d3plot2 have the same number"):
        list(reader_for(solids).runs(solids))


def test_a_family_that_femzip_packed_is_called_so(solids):
    overwrite(solids / "d3plot", 4 * 51, 76_893_465, "<i4")
    with pytest.raises(ReadError, match="is packed with FEMZIP, which needs a licence"):
        list(reader_for(solids).runs(solids))
