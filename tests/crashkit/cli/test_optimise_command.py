"""`crashkit optimise`: the plate is dented by 15 ms times the speed, so every answer is known."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pandas as pd
import pytest
from test_train_command import dataset, run

import crashkit
from crashkit.errors import CrashkitError
from evaluation.errors import EvaluationError

DENT = "max(displacement(along=-z))"
LOWEST = ["--known", "impact_angle=0deg", "--known", "yield_stress=400MPa"]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("models") / "gpr"
    quick = ["physics.clock=off", "physics.symmetry=off", "inputs.derived=off"]
    crashkit.train(dataset(20), folder, "pod-gpr", settings=quick)
    return folder


def test_the_fastest_impact_within_a_dent(model: Path, tmp_path: Path) -> None:
    code, out, err = run(
        "optimise", model, "--maximise", "impact_speed", "--number", f"dent={DENT}", "--subject-to", "dent < 300 mm",
        *LOWEST, "-o", tmp_path / "best", "--starts", 2, "--json",
    )  # fmt: skip
    assert code == 0, err
    said = json.loads(out)
    limit = said["limits"][0]
    assert said["feasible"]
    assert said["value"] == pytest.approx((0.3 - limit["margin"]) / 0.015, rel=0.02)
    assert limit["margin"] > 0
    assert limit["active"]
    assert limit["probability"] == pytest.approx(0.9, abs=0.03)
    assert limit["price"] == pytest.approx(1 / 0.015, rel=0.1)
    assert next(r for r in said["sensitivities"] if r["parameter"] == "impact_speed")["dent < 300 mm"] == pytest.approx(
        0.015, rel=0.1
    )
    confirm = pd.read_csv(tmp_path / "best" / "confirm.csv")
    assert list(confirm["run"])[:1] == ["optimum"]
    assert confirm["yield_stress (Pa)"].eq(4e8).all()
    code, _, err = run("predict", model, "--params", tmp_path / "best" / "confirm.csv", "-o", tmp_path / "p.npz")
    assert code == 0, err
    code, _, err = run("optimise", model, "--maximise", "impact_speed", "-o", tmp_path / "best")
    assert (code, "--overwrite" in err) == (1, True)


def test_as_predicted_there_is_no_margin(model: Path) -> None:
    found = crashkit.optimise(
        model, maximise="impact_speed", subject_to=f"{DENT} < 30 cm", known={"impact_angle": 0, "yield_stress": 4e8},
        confidence=0.5, starts=2,
    )  # fmt: skip
    assert found.value == pytest.approx(20.0, rel=0.02)
    assert found.limits["margin"][0] == 0


def test_where_nothing_is_feasible_the_least_broken_is_named(model: Path, tmp_path: Path) -> None:
    code, out, err = run(
        "optimise", model, "--minimise", "impact_speed", "--subject-to", f"{DENT} < 10 mm", *LOWEST, "-o", tmp_path / "x",
        "--starts", 2,
    )  # fmt: skip
    assert code == 0
    assert "nothing in the trained range keeps all limits" in err
    assert re.search(r"short by 1\d\d(\.\d+)? mm", err), "in the unit of the limit"
    assert "lower edge" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"minimise": "mass"}, "'mass' is neither a parameter .* nor a number; define it: --number 'mass="),
        ({"minimise": "impact_speed", "maximise": "impact_speed"}, "one of minimise and maximise"),
        ({"minimise": DENT, "subject_to": f"{DENT} < 8 kg"}, "the limit is in kg"),
        ({"minimise": "displacement()"}, "one number a run"),
        ({"minimise": "__import__('os')"}, "the function '__import__'"),
        ({"minimise": DENT, "confidence": 90}, "expected a share"),
        ({"minimise": "max(displacement)"}, r"displacement is a function; write displacement\(\)"),
        (
            {"minimise": "impact_speed", "subject_to": f"{DENT} < 80"},
            "write the unit of the limit, such as .* < 80 mm'",
        ),
        ({"minimise": DENT, "known": {"speed": 1}}, "parameter 'speed' is not known"),
    ],
)
def test_what_cannot_be_asked(model: Path, arguments: dict, message: str) -> None:
    with pytest.raises((CrashkitError, EvaluationError), match=message):
        crashkit.optimise(model, **arguments)


def test_free_parameters_are_named_first_and_limits_carry_units(model: Path, tmp_path: Path) -> None:
    code, out, err = run(
        "optimise", model, "--maximise", "impact_speed", "--subject-to", f"{DENT} < 300 mm", "--known", "yield_stress=400MPa",
        "-o", tmp_path / "best", "--starts", 1,
    )  # fmt: skip
    assert code == 0, err
    said = " ".join((err + out).split())
    assert "free, loads too: impact_speed (" in said
    assert "given: yield_stress = 4e+08 Pa" in said
    assert "held with --known impact_speed=" in said
    found = pd.read_csv(tmp_path / "best" / "limits.csv")
    assert f"{1000 * found['predicted'][0]:.4g} mm" in out, "in the unit of the limit"
    assert found["predicted"][0] < 0.3, "the file is in SI"


def test_parameters_without_influence_are_told_and_given_ones_have_their_trained_range(
    model: Path, tmp_path: Path
) -> None:
    code, _, err = run(
        "optimise", model, "--minimise", "2 * impact_speed", "--known", "yield_stress=400MPa", "-o", tmp_path / "best",
        "--starts", 1,
    )  # fmt: skip
    assert code == 0, err
    assert "note: impact_angle hardly matters there: over the whole range the value change" in " ".join(err.split())
    found = pd.read_csv(tmp_path / "best" / "parameters.csv", index_col="parameter")
    assert list(found["at"]) == ["lower edge", "hardly matters", "given"]
    low, high = (float(f(dataset(20)["yield_stress"])) for f in (min, max))
    assert found.loc["yield_stress", ["range_low", "range_high"]].tolist() == pytest.approx([low, high], rel=1e-6)
    assert found.loc["yield_stress", "value"] == pytest.approx(4e8)


def test_a_number_with_the_name_of_a_parameter_is_refused(model: Path) -> None:
    with pytest.raises(CrashkitError, match="impact_speed is a parameter of the model"):
        crashkit.optimise(model, "impact_speed", numbers={"impact_speed": "2 * impact_angle"})
