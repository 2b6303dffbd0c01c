"""`crashkit invert`: parameters from measured points, in the units and forms that people have."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import plate
import pytest
from test_train_command import dataset, run

import crashkit
from crashkit.api.invert import _warnings
from crashkit.errors import CrashkitError

TRUE = np.array([[22.0, 4.0, 3e8]])
NODES = [5, 23, 41, 44, 60, 78]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("models") / "gpr"
    quick = ["physics.clock=off", "physics.symmetry=off", "inputs.derived=off"]
    crashkit.train(dataset(20), folder, "pod-gpr", settings=quick)
    return folder


@pytest.fixture(scope="module")
def moved() -> np.ndarray:
    return plate.displacement(TRUE)[0, -1][[n - 1 for n in NODES]]


def by_node(moved: np.ndarray) -> pd.DataFrame:
    return pd.DataFrame({"node": NODES, **{f"u{a} [mm]": 1e3 * moved[:, k] for k, a in enumerate("xyz")}})


def test_parameters_are_found(model: Path, moved: np.ndarray, tmp_path: Path) -> None:
    points = tmp_path / "points.csv"
    by_node(moved).to_csv(points, index=False)
    code, out, err = run("invert", model, "--measured", points, "-o", tmp_path / "out", "--json")
    assert code == 0, err
    said = json.loads(out)
    rows = {r["parameter"]: r for r in said["parameters"]}
    assert rows["impact_speed"]["best"] == pytest.approx(22.0, rel=0.03)
    assert rows["impact_angle"]["best"] == pytest.approx(4.0, abs=0.5)
    assert rows["impact_speed"]["low"] < 22.0 < rows["impact_speed"]["high"]
    assert any("yield_stress: hardly determined" in s for s in said["warnings"])
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "parameters.csv", "explanations.csv", "samples.csv", "residuals.csv", "pairs.png",
    }  # fmt: skip
    code, _, err = run("invert", model, "--measured", points, "-o", tmp_path / "out")
    assert code == 1
    assert "--overwrite" in err
    code, _, err = run("predict", model, "--params", tmp_path / "out" / "explanations.csv", "-o", tmp_path / "p.npz")
    assert code == 0, err


def test_places_and_positions_say_the_same(model: Path, moved: np.ndarray) -> None:
    start = plate.grid(9)[[n - 1 for n in NODES]]
    places = pd.DataFrame(
        {**{f"{a} [cm]": 100 * start[:, k] for k, a in enumerate("xyz")},
         **{f"p{a} (mm)": 1e3 * (start + moved)[:, k] for k, a in enumerate("xyz")}}
    )  # fmt: skip
    one, two = crashkit.invert(model, by_node(moved)), crashkit.invert(model, places)
    assert np.allclose(one.posterior.best[:2], two.posterior.best[:2], rtol=1e-3)
    assert one.contains({"impact_speed": 22.0, "impact_angle": 4.0, "yield_stress": 3e8})
    assert not one.contains({"impact_speed": 12.0, "impact_angle": 4.0, "yield_stress": 3e8})


def test_some_components_at_two_times_will_do(model: Path) -> None:
    u = plate.displacement(TRUE)[0]
    table = pd.DataFrame(
        {"node": [41, 41, 5], "time [ms]": [15.0, 30.0, np.nan], "uz [mm]": [1e3 * u[3, 40, 2], 1e3 * u[6, 40, 2], np.nan],
         "ux [mm]": [np.nan, np.nan, 1e3 * u[6, 4, 0]]}
    )  # fmt: skip
    found = crashkit.invert(model, table, known={"impact_angle": "4deg", "yield_stress": "300MPa"})
    assert found.best["impact_speed"] == pytest.approx(22.0, rel=0.05)
    assert (found.posterior.samples[:, 1] == 4.0).all()
    assert list(found.residual["time (s)"]) == [0.015, 0.03, 0.03]


def test_what_no_parameters_explain_is_told(model: Path, moved: np.ndarray) -> None:
    found = crashkit.invert(model, by_node(moved * [1, 1, -1]))
    assert any("no parameters within the trained range" in s for s in found.warnings)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"node": [5, 23, 41, 44, 60, 999]}, "row 7: node 999 is none of the model"),
        ({"time [ms]": [40.0] * 6}, "row 2: time 0.04 s; the model was trained"),
        ({"uz [kg]": [0.0] * 6}, "column uz is in kg"),
        ({"speed": [0.0] * 6}, "column 'speed' is not known"),
        ({"px [mm]": [0.0] * 6}, "both a displacement and a position"),
        ({"uy [mm]": ["a"] * 6}, "row 2, column 'uy \\[mm\\]': found 'a'"),
    ],
)
def test_tables_that_do_not_fit(model: Path, moved: np.ndarray, change: dict, message: str, tmp_path: Path) -> None:
    table = by_node(moved)
    if "uz [kg]" in change:
        table = table.drop(columns="uz [mm]")
    table = table.assign(**change)
    table.to_csv(tmp_path / "points.csv", index=False)
    with pytest.raises(CrashkitError, match=message):
        crashkit.invert(model, tmp_path / "points.csv")


def test_places_elsewhere_and_lengths_without_units(model: Path, moved: np.ndarray) -> None:
    away = pd.DataFrame({"x": [0.5], "y": [0.5], "z": [2.0], "ux": [0.1]})
    with pytest.raises(CrashkitError, match=r"200\.0 cm away from the undeformed structure"):
        crashkit.invert(model, away)
    in_mm = by_node(moved).rename(columns=lambda c: c.split(" ")[0]) * 1.0
    in_mm[["ux", "uy", "uz"]] *= 1e3
    with pytest.raises(CrashkitError, match="state the units"):
        crashkit.invert(model, in_mm)
    with pytest.raises(CrashkitError, match="no length above zero"):
        crashkit.invert(model, by_node(moved), noise="1kg")
    with pytest.raises(CrashkitError, match="noise 3: in which unit"):
        crashkit.invert(model, by_node(moved), noise="3")


@pytest.mark.parametrize(("factor", "told"), [(0.1, "10 times as much"), (10.0, "0.1 times as much")])
def test_lengths_in_a_wrong_unit_are_told(model: Path, moved: np.ndarray, factor: float, told: str) -> None:
    found = crashkit.invert(model, by_node(factor * moved))
    said = [w for w in found.warnings if "root mean square" in w]
    assert len(said) == 1
    assert told in said[0]
    assert "check the units" in said[0]


def test_known_values_beyond_the_trained_range_are_told(model: Path, moved: np.ndarray) -> None:
    known = {"impact_angle": "15degree", "yield_stress": 3e8}
    found = crashkit.invert(model, by_node(moved), known=known)
    assert any("impact_angle = 15 degree is outside the trained range" in w for w in found.warnings)
    inside = crashkit.invert(model, by_node(moved), known={"impact_angle": 4.0, "yield_stress": 3e8})
    assert not any("outside the trained range" in w for w in inside.warnings)


def test_a_best_value_outside_its_interval_is_told(model: Path, moved: np.ndarray) -> None:
    found = crashkit.invert(model, by_node(moved))
    post = found.posterior
    elsewhere = replace(post, explanations=(replace(post.explanations[0], parameters=post.high.copy()),))
    said = _warnings(elsewhere, found._misfit, found.residual, found.names, found.units, np.ones(3))
    assert any(w.startswith("impact_speed, impact_angle") and "outside the 90 % interval" in w for w in said)
    assert not any("outside the 90 % interval" in w for w in found.warnings)


def test_a_long_search_says_beforehand_how_long(
    model: Path, moved: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard: list[str] = []
    known = {"impact_angle": 4.0, "yield_stress": 3e8}
    crashkit.invert(model, by_node(moved), known=known, report=lambda what, *_: heard.append(what))
    assert heard == ["searching the range"]
    monkeypatch.setattr("crashkit.api.invert._SOON", 0.0)
    crashkit.invert(model, by_node(moved), known=known, report=lambda what, *_: heard.append(what))
    assert re.fullmatch(r"searching the range, about \d+ (s|min)", heard[1])


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nope.csv", "nope.csv: no such table of measured points; expected a file (.csv, .tsv, .json, .xlsx)"),
        ("", ": is a folder; expected a table of measured points"),
        ("points.txt", "points.txt: a table of measured points is .csv, .tsv, .json, .xlsx, not .txt"),
    ],
)
def test_a_file_of_points_is_called_so(tmp_path: Path, name: str, message: str) -> None:
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "model.json").write_text("{}")
    (tmp_path / "points.txt").write_text("node,ux\n1,2\n")
    code, _, err = run("invert", tmp_path / "model", "--measured", tmp_path / name)
    assert (code, message in " ".join(err.split())) == (1, True), err
