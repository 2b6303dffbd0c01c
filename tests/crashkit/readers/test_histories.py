"""Time histories: OpenRadioss T01 and LS-DYNA binout, against numbers known from elsewhere."""

from __future__ import annotations

import contextlib
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crashkit.errors import ReadError
from crashkit.readers._binout import binout_files, read_binout
from crashkit.readers._radioss_history import read_history
from crashkit.readers.history import Channel, History, distinct, quantity_of

# Byte of the file behind its first sample.
FIRST_SAMPLE_ENDS = 3332
T01 = Path(__file__).parents[2] / "data" / "histories" / "bumperT01"


def column(history: History, name: str) -> np.ndarray:
    return history.values[:, [c.name for c in history.channels].index(name)]


def test_a_sled_of_half_a_tonne_starts_with_its_kinetic_energy() -> None:
    history = read_history(T01)
    assert len(history.time) == 40
    assert np.allclose(np.diff(history.time), 1e-4, atol=4e-6)
    mass, speed = column(history, "mass")[0], 7.0  # run 1 of the campaign runs at 7 m/s
    assert column(history, "kinetic_energy")[0] == pytest.approx(mass * speed**2 / 2, rel=1e-3)
    assert column(history, "x_momentum")[0] == pytest.approx(mass * speed, rel=1e-3)
    assert column(history, "sled_velocity_x")[0] == pytest.approx(speed, rel=1e-4)


def test_wall_forces_are_what_slows_the_structure_down() -> None:
    history = read_history(T01)
    force = column(history, "pole_normal_force_x") + column(history, "pole_tangential_force_x")
    momentum = column(history, "x_momentum")
    lost = momentum[0] - momentum[-1]
    assert np.trapezoid(force, history.time) == pytest.approx(lost, rel=0.02)
    (wall,) = [c for c in history.channels if c.name == "pole_normal_force_x"]
    assert wall.quantity == "force"
    assert "impulse" in wall.derived


def test_displacements_are_the_integral_of_velocities() -> None:
    history = read_history(T01)
    way = np.trapezoid(column(history, "sled_velocity_x"), history.time)
    assert way == pytest.approx(column(history, "sled_displacement_x")[-1], rel=1e-3)


def test_filtered_and_plain_accelerations_of_one_place_are_told_apart() -> None:
    names = [c.name for c in read_history(T01).channels]
    assert "gauges_filtered_beam_left_acceleration_x" in names
    assert "gauges_and_sled_beam_left_acceleration_x" in names
    assert len(set(names)) == len(names)


@given(st.integers(min_value=2700, max_value=T01.stat().st_size - 1))
def test_a_file_that_was_cut_gives_the_samples_before_the_cut(cut: int) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "cutT01"
        file.write_bytes(T01.read_bytes()[:cut])
        whole = read_history(T01)
        try:
            found = read_history(file)
        except ReadError:
            assert cut < FIRST_SAMPLE_ENDS
            return
        assert np.array_equal(found.time, whole.time[: len(found.time)])
        energy = column(whole, "internal_energy")[: len(found.time)]
        assert np.array_equal(column(found, "internal_energy"), energy)


@given(st.integers(min_value=0, max_value=2700))
def test_a_cut_head_is_refused_with_its_place(cut: int) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "cutT01"
        file.write_bytes(T01.read_bytes()[:cut])
        with pytest.raises(ReadError, match="cutT01"):
            read_history(file)


@given(st.integers(min_value=0, max_value=2700), st.integers(min_value=0, max_value=255))
def test_a_wrong_byte_in_the_head_is_one_line_or_nothing(place: int, byte: int) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "wrongT01"
        content = bytearray(T01.read_bytes())
        content[place] = byte
        file.write_bytes(content)
        with contextlib.suppress(ReadError):
            read_history(file)


def test_a_group_record_that_is_too_short_is_one_line(tmp_path: Path) -> None:
    file = tmp_path / "shortT01"
    records = [
        struct.pack(">i", 4021) + bytes(100),
        b"date",
        b"",
        b"",
        b"",
        struct.pack(">6i", 0, 0, 0, 0, 1, 0),
        b"1234",
    ]
    file.write_bytes(b"".join(struct.pack(">i", len(r)) + r + struct.pack(">i", len(r)) for r in records))
    with pytest.raises(ReadError, match=r"shortT01: the record before byte .* is shorter than its kind"):
        read_history(file)


@pytest.mark.parametrize(
    ("name", "quantity"),
    [
        ("x_momentum", "momentum"),
        ("moment_z", "moment"),
        ("energy_ratio", "one"),
        ("pole_normal_force_x", "force"),
        ("external_work", "energy"),
        ("rx_velocity", "one/time"),
        ("rx_displacement", "one"),
        ("energy_per_mass", "unknown"),
        ("cycle_count", "unknown"),
    ],
)
def test_the_last_known_word_says_what_a_curve_measures(name: str, quantity: str) -> None:
    assert quantity_of(name) == quantity


def test_what_is_no_history_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "xT01"
    file.write_bytes(struct.pack(">ii4xi", 8, 12, 8))
    with pytest.raises(ReadError, match="no version of a time history"):
        read_history(file)


def binout(folder: Path) -> Path:
    """A binout as LS-DYNA lays it out: glstat and rwforc, two states of each in folders d000001, d000002."""
    from lasso.dyna.lsda_py3 import Lsda

    file = folder / "binout0000"
    out = Lsda(str(file), "w")
    for k, time in enumerate((0.0, 0.001, 0.002)):
        out.cd(f"/glstat/d{k + 1:06d}", 1)
        out.write("time", 10, (time,))
        out.write("kinetic_energy", 10, (1000.0 - 100 * k,))
        out.write("internal_energy", 10, (90.0 * k,))
    for k, time in enumerate((0.0, 0.002)):
        out.cd(f"/rwforc/forces/d{k + 1:06d}", 1)
        out.write("time", 10, (time,))
        out.write("normal_force", 10, (0.0 + 8 * k, 4.0 * k))
    out.cd("/rwforc/forces/metadata", 1)
    out.write("ids", 4, (7, 9))
    out.close()
    return file


def test_databases_of_a_binout_are_curves_at_common_times(tmp_path: Path) -> None:
    binout(tmp_path)
    history = read_binout(binout_files(tmp_path))
    assert history.time.tolist() == [0.0, 0.001, 0.002]
    assert column(history, "glstat_kinetic_energy").tolist() == [1000.0, 900.0, 800.0]
    assert column(history, "rwforc_7_normal_force").tolist() == [0.0, 4.0, 8.0]
    assert column(history, "rwforc_9_normal_force").tolist() == [0.0, 2.0, 4.0]
    kinds = {c.name: c.quantity for c in history.channels}
    assert kinds["glstat_internal_energy"] == "energy"
    assert kinds["rwforc_9_normal_force"] == "force"


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_damaged_binout_is_one_line(tmp_path: Path) -> None:
    file = binout(tmp_path)
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(ReadError, match="binout0000"):
        read_binout([file])


def test_names_that_occur_twice_are_numbered() -> None:
    names = [c.name for c in distinct([Channel("a", "force"), Channel("b", "force"), Channel("a", "force")])]
    assert names == ["a_1", "b", "a_2"]


def test_curves_that_share_a_name_are_numbered_around_names_that_are_taken() -> None:
    named = [Channel(name, "energy") for name in ("rail_1", "rail", "rail", "floor", "rail")]
    assert [c.name for c in distinct(named)] == ["rail_1", "rail_2", "rail_3", "floor", "rail_4"]
