"""`crashkit ingest`, `info` and `validate`: what they print, and every wrong use in one line with code 1."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import meshio
import numpy as np
import pytest
from typer.testing import CliRunner

from crashkit.cli import app
from crashkit.dataset import demo_data, open_dataset

DATA = Path(__file__).parents[2] / "data"
RADIOSS = DATA / "radioss" / "run_b"
D3PLOT = DATA / "d3plot" / "solid_int"


def run(*arguments: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, [*map(str, arguments)])
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


@pytest.fixture(autouse=True)
def _quick(quick_disk: None) -> None:
    pass


@pytest.fixture
def dataset(demo_dataset: Path, tmp_path: Path) -> Path:
    """A copy of the demo dataset that may be damaged."""
    return Path(shutil.copytree(demo_dataset, tmp_path / "kart.zarr"))


# What is printed


def test_ingest_tells_what_it_did(tmp_path: Path) -> None:
    output = tmp_path / "crash.zarr"
    code, out, told = run("ingest", RADIOSS, "-o", output, "--fields", "plastic_strain", "--allow-incomplete")
    assert (code, out) == (0, "")
    assert "rigid walls left out: rigid wall" in told
    assert f"{output}: 1 runs (1 new), 2 states, 2400 nodes" in told.splitlines()
    assert told.splitlines()[-3:] == [
        f"look at  {output}", f"next     crashkit info {output}", f"next     crashkit coarsen {output}"
    ]  # fmt: skip
    assert open_dataset(output).attrs["solver"] == "OpenRadioss"


def test_ingest_as_json(tmp_path: Path) -> None:
    code, out, _ = run(
        "ingest", D3PLOT, "-o", tmp_path / "crash.nc", "--units", "mm-ms-kg", "--parts", "shell*", "--json"
    )
    told = json.loads(out)
    assert code == 0
    assert told["runs"] == told["added"] == ["solid_int"]
    assert told["nodes"] == open_dataset(tmp_path / "crash.nc").sizes["node"] > 0
    assert "2 of 4 parts chosen" in told["notes"]


def test_ingest_at_given_times_tells_the_error(tmp_path: Path) -> None:
    code, out, told = run("ingest", D3PLOT, "-o", tmp_path / "crash.nc", "--units", "SI", "--time", "0:0.015:4")
    assert code == 0
    assert "estimated error (mm)" in out
    assert "4 states" in told


def test_ingest_of_files_without_times_takes_a_time_step(tmp_path: Path) -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    (tmp_path / "runs").mkdir()
    for state in range(3):
        mesh = meshio.Mesh(corners + 0.1 * state, [("triangle", np.array([[0, 1, 2]]))])
        mesh.write(tmp_path / "runs" / f"plate_{state}.ply")
    asked = ("ingest", tmp_path / "runs", "-o", tmp_path / "crash.nc", "--reader", "meshio", "--units", "mm-ms-kg")
    code, _, told = run(*asked)
    assert code == 1
    assert "(--time-step)" in told
    assert run(*asked, "--time-step", "0.5")[0] == 0
    np.testing.assert_allclose(open_dataset(tmp_path / "crash.nc").time, [0, 0.0005, 0.001])


def test_ingest_skips_and_says_why(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    shutil.copytree(D3PLOT, runs / "good")
    shutil.copytree(D3PLOT, runs / "short")
    (runs / "short" / "d3plot03").unlink()
    code, _, told = run("ingest", runs, "-o", tmp_path / "crash.zarr", "--units", "mm-ms-kg", "--on-error", "skip")
    assert code == 0
    assert "skipped short: " in told
    assert "d3plot03" in told
    assert "1 runs (1 new, 1 skipped)" in told


def test_info_answers_what_an_engineer_asks_first(dataset: Path) -> None:
    code, out, _ = run("info", dataset)
    assert code == 0
    for text in (
        "runs        36",
        "states      21, 0 ms to 30 ms",
        "2400 nodes, 4836 faces, 0 solids and beams",
        "1 kart (4836 faces)",
        "displacement 939.6 mm (run run_022, 30 ms, node 1616)",
        f"none yet; make one with crashkit coarsen {dataset}",
    ):
        assert text in out
    row = next(line for line in out.splitlines() if "yield_stress" in line)
    assert [cell.strip() for cell in row.split("│")[1:-1]] == ["yield_stress", "172.72", "734.4", "MPa"]


def test_info_as_json_is_in_si(dataset: Path) -> None:
    run("coarsen", dataset, "--nodes", "300,75")
    code, out, _ = run("info", dataset, "--json")
    told = json.loads(out)
    assert code == 0
    assert (told["runs"], told["states"], told["nodes"]) == (36, 21, 2400)
    assert told["parameters"][2] == {
        "name": "yield_stress",
        "units": "Pa",
        "table_units": "MPa",
        "table_factor": 1e6,
        "min": pytest.approx(1.7272e8),
        "max": pytest.approx(7.344e8),
    }
    assert told["largest_displacement"]["run"] == "run_022"
    assert told["bytes_on_disk"] == sum(f.stat().st_size for f in dataset.rglob("*") if f.is_file())
    assert [level["nodes"] for level in told["levels"]] == [300, 75]
    assert {"distance_mean", "lifting_error_mean"} <= told["levels"][0].keys()


def test_info_of_erosion_fields_and_incomplete_runs(tmp_path: Path) -> None:
    shutil.copytree(D3PLOT, tmp_path / "d3plots")
    (tmp_path / "d3plots" / "d3plot03").unlink()
    output = tmp_path / "crash.nc"
    run(
        "ingest",
        tmp_path / "d3plots",
        "-o",
        output,
        "--units",
        "mm-ms-kg",
        "--fields",
        "velocity",
        "--allow-incomplete",
    )
    _, out, _ = run("info", output)
    assert "runs        1, incomplete: d3plots" in out
    assert "velocity (m s-1, on nodes)" in out
    code, out, _ = run("validate", output)
    assert code == 1
    assert out.startswith("run d3plots: found an incomplete run")


def test_validate_of_a_good_dataset(dataset: Path) -> None:
    code, out, told = run("validate", dataset)
    assert (code, out) == (0, "")
    assert told == f"{dataset}: keeps every rule of a crash dataset\n"


def test_validate_lists_every_violation(dataset: Path) -> None:
    import zarr

    group = zarr.open_group(str(dataset), mode="r+")
    group["displacement"][4, 3, 17, 0] = np.nan
    group["impact_speed"][5] = np.inf
    code, out, told = run("validate", dataset)
    assert code == 1
    assert "displacement, run run_004, state 3, node 17: found a value that is not finite, expected a number" in out
    assert "impact_speed, run run_005: found a value that is not finite, expected a number" in out
    assert "results, run run_004: found content with SHA-256" in out
    assert told == f"{dataset}: {len(out.splitlines())} violations\n"
    code, out, _ = run("validate", dataset, "--json")
    assert code == 1
    assert json.loads(out)["valid"] is False
    assert run("validate", dataset, "--quick")[0] == 0


# Wrong use


def truncated(folder: Path) -> Path:
    path = folder / "kart.h5"
    path.write_bytes(demo_data().read_bytes()[:100_000])
    return path


def text(folder: Path) -> Path:
    path = folder / "notes.txt"
    path.write_text("no solver wrote this")
    return path


def empty(folder: Path) -> Path:
    path = folder / "empty"
    path.mkdir()
    return path


WRONG_SOURCES = {
    "missing": (lambda folder: folder / "nothing.h5", (), "nothing.h5: no such file or folder"),
    "wrong type": (text, (), "notes.txt: the content is none of the known formats"),
    "empty folder": (empty, (), "empty: the content is none of the known formats"),
    "truncated": (truncated, (), "kart.h5: "),
    "reader": (lambda folder: demo_data(), ("--reader", "abaqus"), "reader 'abaqus' is not known; known are d3plot"),
    "another reader": (lambda folder: demo_data(), ("--reader", "openradioss"), "kart_demo.h5: "),
    "units": (lambda folder: D3PLOT, (), "its files state no units; say them, for example --units mm-ms-kg"),
    "wrong units": (lambda folder: D3PLOT, ("--units", "mm"), "units 'mm' not understood; expected length-time-mass"),
    "part": (lambda folder: demo_data(), ("--parts", "door"), "no part is called 'door'; the runs have 1 (kart)"),
    "field": (lambda folder: demo_data(), ("--fields", "stress"), "no run has a field 'stress'"),
    "table": (lambda folder: demo_data(), ("--params", "no.csv"), "no.csv: no such parameter table"),
    "mesh": (lambda folder: demo_data(), ("--mesh", "no.vtp"), "--mesh is no.vtp, which is no file"),
    "times": (lambda folder: demo_data(), ("--time", "0:1:5"), "the dataset's times are 0 to 1 s"),
    "no displacement": (
        lambda folder: unpacked(folder), ("--units", "SI"), "d3plot: has no displacements (IU = 0)",
    ),
}  # fmt: skip


def unpacked(folder: Path) -> Path:
    import lzma

    path = folder / "temperature" / "d3plot"
    path.parent.mkdir()
    path.write_bytes(lzma.decompress((DATA / "d3plot" / "node_temperature" / "d3plot.xz").read_bytes()))
    return path


@pytest.mark.parametrize("suffix", [".zarr", ".nc"])
@pytest.mark.parametrize("what", WRONG_SOURCES)
def test_source_that_cannot_be_used_is_one_line_and_leaves_nothing(tmp_path: Path, what: str, suffix: str) -> None:
    make, options, expected = WRONG_SOURCES[what]
    (tmp_path / "in").mkdir()
    (tmp_path / "out").mkdir()
    code, out, told = run("ingest", make(tmp_path / "in"), "-o", tmp_path / "out" / f"crash{suffix}", *options)
    lines = [line for line in told.splitlines() if line.strip()]
    assert (code, out) == (1, "")
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    assert expected in lines[0]
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize(
    ("output", "expected"),
    [
        ("crash.h5", "a dataset is called NAME.zarr or NAME.nc"),
        ("nowhere/crash.zarr", "nowhere does not exist; make it first"),
        ("file/crash.nc", "file does not exist; make it first"),
        ("other.zarr", "choose another name for the output"),
        ("other.nc", "choose another name for the output"),
    ],
)
def test_output_that_cannot_be_written_is_one_line(tmp_path: Path, output: str, expected: str) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "other.nc").write_text("mine")
    (tmp_path / "other.zarr").mkdir()
    code, _, told = run("ingest", demo_data(), "-o", tmp_path / output)
    assert code == 1
    assert expected in told
    assert {p.name for p in tmp_path.iterdir()} == {"file", "other.nc", "other.zarr"}


@pytest.mark.parametrize("options", [("--on-error", "ignore"), ("--time", "0:1"), ("--workers", "0")])
def test_bad_usage_is_code_two(tmp_path: Path, options: tuple[str, ...]) -> None:
    assert run("ingest", demo_data(), "-o", tmp_path / "crash.zarr", *options)[0] == 2


def damage(dataset: Path, kind: str) -> Path:
    if kind == "missing":
        return dataset.with_name("nothing.zarr")
    if kind == "wrong type":
        return demo_data()
    if kind == "truncated":
        path = dataset.with_suffix(".nc")
        with h5py.File(path, "w") as file:
            file["displacement"] = np.zeros(100_000)
        path.write_bytes(path.read_bytes()[:5000])
        return path
    chunk = dataset / "displacement" / "c.3.0.0.0"
    chunk.write_bytes(chunk.read_bytes()[:1000])
    return dataset


@pytest.mark.parametrize("command", ["info", "validate"])
@pytest.mark.parametrize("kind", ["missing", "wrong type", "truncated", "damaged chunk"])
def test_what_is_no_dataset_is_one_line(dataset: Path, command: str, kind: str) -> None:
    path = damage(dataset, kind)
    code, out, told = run(command, path)
    assert (code, out) == (1, "")
    assert told.startswith(f"error: {path}: ")
    assert len(told.splitlines()) == 1


def test_interrupt_says_how_to_go_on(tmp_path: Path) -> None:
    """Ctrl-C from the first run on: what is finished is kept and the message says so."""
    code = (
        "import os, signal, crashkit.ingestion.staging as s, crashkit.cli as c\n"
        "real = s.Staging.finish\n"
        "def finish(self, run):\n"
        "    real(self, run)\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "s.Staging.finish = finish\n"
        "c.main()\n"
    )
    output = tmp_path / "crash.zarr"
    done = subprocess.run(
        [sys.executable, "-c", code, "ingest", str(demo_data()), "-o", str(output)],
        capture_output=True, text=True, env={**os.environ, "COLUMNS": "200"},
    )  # fmt: skip
    assert done.returncode == 130
    assert (
        f"interrupted; finished runs are kept in {output}.partial, the same command goes on from there" in done.stderr
    )
    assert len(list((tmp_path / "crash.zarr.partial" / "runs").iterdir())) == 1
