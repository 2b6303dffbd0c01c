"""Proposed runs go on: to `predict --params`, to a campaign, and from its table back; units and constants included."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from test_train_command import dataset, run

import crashkit
from crashkit.api.propose import next_names, propose, write_table
from crashkit.api.run_campaign import points_of_table
from crashkit.campaign.box import Box, Range
from crashkit.errors import CrashkitError
from crashkit.ingestion.parameter_table import read_parameter_table

QUICK = ["physics.clock=off", "physics.symmetry=off", "inputs.derived=off"]


@pytest.fixture(scope="module")
def crash(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten runs with speeds from a table in km/h, and one thickness for all."""
    path = tmp_path_factory.mktemp("data") / "crash.nc"
    runs = dataset(10)
    runs["impact_speed"].attrs["table_units"] = "km/h"
    runs["thickness"] = ("sim", np.full(10, 0.0012), {"units": "m", "role": "parameter", "table_units": "mm"})
    runs.to_netcdf(path)
    return path


@pytest.fixture(scope="module")
def model(crash: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("models") / "gpr"
    crashkit.train(crash, folder, "pod-gpr", settings=QUICK)
    return folder


def test_what_is_proposed_can_be_predicted(crash: Path, model: Path, tmp_path: Path) -> None:
    table = tmp_path / "next.csv"
    code, _, err = run("propose", crash, "-n", 3, "--method", "halton", "-o", table)
    assert code == 0, err
    heads = table.read_text().splitlines()[0]
    assert heads == "run,impact_speed (km/h),impact_angle (degree),yield_stress (Pa),thickness (mm)"
    assert set(read_parameter_table(table).rows) == {"run_010", "run_011", "run_012"}
    code, out, err = run("predict", model, "--params", table, "-o", tmp_path / "new.npz", "--json")
    assert code == 0, err
    assert [row["run"] for row in json.loads(out)] == ["run_010", "run_011", "run_012"]
    wanted = read_parameter_table(table).rows["run_011"]["impact_speed"][0] / 3.6
    assert float(np.load(tmp_path / "new_run_011.npz")["impact_speed"]) == pytest.approx(wanted)


def test_one_thickness_for_all_runs_does_not_keep_the_process_from_proposing(
    crash: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained = crashkit.train
    monkeypatch.setattr("crashkit.api.train.train", lambda *a, **k: trained(*a, **{**k, "settings": QUICK}))
    table = propose(crash, 2)
    low, high = 3.6 * np.array([dataset(10)["impact_speed"].min(), dataset(10)["impact_speed"].max()])
    assert table["impact_speed"].between(low, high).all()
    assert (table["thickness"].to_numpy() == [1.2, 1.2]).all()
    assert table.attrs["expected_error_after_m"] < table.attrs["expected_error_m"]


def test_proposals_of_a_box_go_to_a_campaign_and_come_back(tmp_path: Path) -> None:
    ranges = {"speed": Range(low=20, high=60, unit="km/h"), "offset": Range(low=-50, high=50, unit="mm")}
    table = propose(None, 5, box=Box(parameters=ranges))
    write_table(table, tmp_path / "first.csv")
    back = points_of_table(tmp_path / "first.csv", ("offset", "speed"), ("m", "km/h"))
    assert np.allclose(back, np.stack([table["offset"] / 1000, table["speed"]], axis=1))
    rows = read_parameter_table(tmp_path / "first.csv").rows
    assert rows["run_000"]["offset"] == (table["offset"].iloc[0], "mm")


@pytest.mark.parametrize(
    ("runs", "names"),
    [
        ([], ["run_000", "run_001"]),
        (["run_035", "run_007"], ["run_036", "run_037"]),
        (["V9", "v10", "base"], ["v11", "v12"]),
        (["a9", "A10"], ["A11", "A12"]),
        (["base"], ["run_000", "run_001"]),
    ],
)
def test_names_go_on_with_those_of_the_dataset(runs: list[str], names: list[str]) -> None:
    assert next_names(runs, 2) == names


def test_a_table_without_a_column_of_runs_is_predicted_by_its_rows(model: Path, tmp_path: Path) -> None:
    table = tmp_path / "mine.csv"
    table.write_text("impact_speed,impact_angle,yield_stress,thickness\nkm/h,deg,MPa,mm\n72,5,400,1.2\n54,0,300,1.2\n")
    code, out, err = run("predict", model, "--params", table, "-o", tmp_path / "p.npz", "--json")
    assert code == 0, err
    assert [row["run"] for row in json.loads(out)] == ["row_3", "row_4"]
    assert float(np.load(tmp_path / "p_row_3.npz")["impact_speed"]) == pytest.approx(20)


def test_a_table_is_refused_under_another_name_before_anything_is_read(tmp_path: Path) -> None:
    code, _, err = run("propose", tmp_path / "none.zarr", "-o", tmp_path / "next.xlsx")
    assert (code, "next.xlsx: a table is written as CSV; expected a name that ends in .csv" in err) == (1, True)


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ("impact_speed: {low: 20, high: 90, unit: km/h}", "the box and the runs differ in impact_angle, yield_stress"),
        (
            "impact_speed: {low: 20, high: 90, unit: kg}\n  impact_angle: {low: -5, high: 5, unit: deg}\n"
            "  yield_stress: {low: 200, high: 600, unit: MPa}",
            "impact_speed is in kg in the box and in km/h in the runs",
        ),
        (
            "impact_speed: [20, 90]",
            r"parameters.impact_speed: expected {low: .., high: .., unit: .., odd: ..}, found \[20, 90\]",
        ),
        ("impact_speed: {low: 20}", "parameters.impact_speed.high is missing; the file says low"),
        ("impact_speed: {low: 20, high: 60, odd: true}", "20 to 60 is marked odd"),
    ],
)
def test_a_box_that_does_not_fit_is_told_before_anything_is_trained(
    crash: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, box: str, message: str
) -> None:
    monkeypatch.setattr("crashkit.api.train.train", None)
    (tmp_path / "box.yaml").write_text(f"parameters:\n  {box}\n")
    for method in ("expected-reduction", "halton"):
        with pytest.raises(CrashkitError, match=message):
            propose(crash, 2, box=tmp_path / "box.yaml", method=method)  # type: ignore[arg-type]
