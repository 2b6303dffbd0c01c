"""Numbers by formula and histories, from settings to a prediction with its band."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

import crashkit
from crashkit.api.campaign import histories
from crashkit.api.evaluate import _asked, _beside, _opened
from crashkit.api.numbers import half_width
from crashkit.api.scatter import scatter
from crashkit.api.source import source_of
from crashkit.cli import app
from crashkit.cli.predict import _readable
from crashkit.errors import DataError
from data_schema.progress import silent
from evaluation.comparison.split import Split, entries
from evaluation.drawing.style import Sheet
from evaluation.errors import EvaluationError
from evaluation.figures.histories import FIGURE as HISTORIES
from evaluation.figures.kind import drawn, to_csv
from evaluation.figures.numbers import FIGURE as NUMBERS
from surrogates.errors import SurrogateError
from surrogates.settings import settings
from surrogates.storage.card import card

KPI = {
    "intrusion": "max(displacement(part=box, along=x))",
    "peak": "cfc60(wall_force).max()",
    "both": "intrusion * peak",
}
WHERE = {"impact_speed": 9.0, "pole_offset": 0.05, "beam_thickness": 2e-3, "box_thickness": 1.8e-3, "yield_stress": 4e8}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> xr.Dataset:
    output = tmp_path_factory.mktemp("numbers") / "bumper.zarr"
    crashkit.ingest(crashkit.bumper_data(), output)
    return crashkit.open_dataset(output).isel(sim=[*range(14), *range(26, 30)], time=slice(None, None, 5)).load()


@pytest.fixture(scope="module")
def model(runs: xr.Dataset) -> crashkit.Model:
    return crashkit.train(
        runs, model="pod-gpr", test="14:18", targets=["history:wall_force"],
        settings={"kpi": KPI, "physics.clock": "off", "physics.symmetry": "off", "inputs.derived": "off",
                  "pod.modes": [16], "validation.folds": 3, "removal": "off"},
    )  # fmt: skip


def test_numbers_are_those_of_the_predicted_field_and_histories(model: crashkit.Model) -> None:
    said = model.predict(WHERE, band=0.9)
    box = np.unique(said["face_nodes"].values[np.isin(said["face_part"].values, [1, 2])])
    assert float(said["intrusion"]) == pytest.approx(
        float(said["displacement"].values[:, box[box >= 0], 0].max()), rel=1e-6
    )
    assert said["intrusion"].attrs["units"] == "m"
    assert said["history"].dims == ("sample", "channel")
    assert float(said["peak"]) == pytest.approx(float(said["history"].max()), rel=0.3)
    assert float(said["both"]) == pytest.approx(float(said["peak"]) * float(said["intrusion"]))
    assert said["both"].attrs["units"] == "J"
    for name in KPI:
        assert 0 < float(said[f"{name}_half_width"]) < 2 * float(said[name])
    several = model.predict({n: [v, v * 1.01] for n, v in WHERE.items()})
    assert several["intrusion"].dims == ("sim",)


def test_numbers_of_new_runs_are_near_the_truth(model: crashkit.Model, runs: xr.Dataset) -> None:
    for run in (14, 15):
        true = runs.isel(sim=run)
        said = model.predict({n: float(true[n]) for n in model.parameters}, extrapolate=True)
        box = np.unique(true["face_nodes"].values[np.isin(true["face_part"].values, [1, 2])])
        deep = float(np.nanmax(true["displacement"].values[:, box[box >= 0], 0]))
        assert float(said["intrusion"]) == pytest.approx(deep, rel=0.15)


def test_errors_on_left_out_runs_are_kept_with_the_model(model: crashkit.Model, tmp_path: Path) -> None:
    told = model.record.numbers["intrusion"]
    assert len(told["errors"]) == 14
    assert 0 < np.mean(np.abs(list(told["errors"].values()))) < 0.2 * told["size"]
    model.save(tmp_path / "model")
    back = crashkit.load_model(tmp_path / "model")
    assert back.record.numbers == model.record.numbers
    done = CliRunner().invoke(
        app, ["predict", str(tmp_path / "model"), *(x for n, v in WHERE.items() for x in ("-p", f"{n}={v}{model.parameters[n][2]}")),
              "--band", "0.9", "-o", str(tmp_path / "p.npz")],
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert "intrusion: 0." in done.stderr
    assert "peak: " in done.stderr
    assert np.load(tmp_path / "p.npz")["peak"] == pytest.approx(float(model.predict(WHERE)["peak"]), rel=1e-5)


def test_the_card_lists_histories_and_numbers_with_their_errors(model: crashkit.Model) -> None:
    told = card(model.surrogate)
    wanted = model.record.numbers["intrusion"]
    error = np.mean(np.abs(list(wanted["errors"].values())))
    assert f"| {error:.4g} |" in next(line for line in told.splitlines() if line.startswith("| intrusion |"))
    name, curve = next(iter(model.surrogate.curves.items()))
    assert f"| {curve.errors['chosen']:.4g} |" in next(
        line for line in told.splitlines() if line.startswith(f"| {name} |")
    )


def test_a_number_called_as_a_parameter_is_refused_before_the_training(runs: xr.Dataset) -> None:
    with pytest.raises(DataError, match=r"kpi\.yield_stress has the name of a parameter"):
        crashkit.train(runs, model="pod-gpr", settings={"kpi": {"yield_stress": "max(displacement())"}})


def test_a_band_wider_than_the_value_says_so() -> None:
    assert "wider than the value" in _readable(0.01, "m", 0.02)
    assert "wider" not in _readable(0.02, "m", 0.01)


def test_scatter_knows_the_numbers_of_the_model(model: crashkit.Model) -> None:
    found = scatter(model, {"yield_stress": "5%"}, at={"impact_speed": 9.0}, draws=40, limits=["peak < 200 kN"])
    assert [n.name for n in found.numbers] == ["largest_displacement", *KPI]
    assert found.numbers[2].unit == "N"
    assert found.limits[0].probability.model is not None


def test_the_report_compares_them_with_the_truth(
    model: crashkit.Model, runs: xr.Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The rating itself has its own tests, and takes half a minute to be compiled.
    monkeypatch.setattr("evaluation.comparison.beside.rate", lambda time, true, said: SimpleNamespace(overall=0.7))
    source = source_of(runs)
    reference, stored = _opened(source, _asked(model))
    result = SimpleNamespace(
        entries=entries(stored), predictor=lambda entry: stored[0].predictors[0], reference=reference,
        split=Split(tuple(range(14)), tuple(range(14, 18))), test_names=reference.runs[14:],
    )  # fmt: skip
    found = _beside(source, result, silent)  # type: ignore[arg-type]
    assert found is not None
    first = found.numbers[0]
    assert (first.name, first.unit, len(first.truth)) == ("intrusion", "m", 4)
    said = model.predict({n: float(runs[n][14]) for n in model.parameters}, extrapolate=True)
    assert first.predictions["POD-GPR"][0] == pytest.approx(float(said["intrusion"]), rel=1e-5)
    assert first.half_width["POD-GPR"] > 0
    (curve,) = found.curves
    np.testing.assert_allclose(curve.truth[1], runs["history"].sel(channel="wall_force_x")[15], rtol=1e-5, atol=1.0)
    table = found.table()
    assert table["what"] == [*KPI, "history wall_force_x"]
    assert table["rating"][-1] == pytest.approx(0.7)
    for kind in (NUMBERS, HISTORIES):
        drawing = kind.select(SimpleNamespace(beside=found))  # type: ignore[arg-type]
        assert drawing is not None
        assert to_csv(drawing.numbers())
        assert drawn(drawing, Sheet())
        assert "POD-GPR" in drawing.caption()


def test_the_half_width_is_the_conformal_quantile() -> None:
    errors = [(-1) ** k * k for k in range(1, 20)]
    assert half_width(errors, 0.9) == 18
    assert half_width(errors, 0.5) == 10
    assert half_width(errors, 0.99) == 19
    assert half_width(errors[:7], 0.9) is None


@pytest.mark.parametrize(
    ("kpi", "said"),
    [
        ({"a": "max(displacement(part=door))"}, "no part 'door'"),
        ({"a": "airbag.max()"}, "airbag is no history, parameter or number"),
        ({"a": "internal_energy.max()"}, "internal_energy is no history"),  # in the dataset, but no target
        ({"a": "displacement()"}, "a value for each time and node"),
        ({"a": "import os"}, "is no formula"),
    ],
)
def test_formulas_are_tried_before_the_training(runs: xr.Dataset, kpi: dict[str, str], said: str) -> None:
    with pytest.raises(EvaluationError, match=said):
        crashkit.train(runs, model="pod-gpr", settings={"kpi": kpi})


def test_formulas_in_flow_yaml_are_read_whole(tmp_path: Path) -> None:
    text = "kpi: {intrusion: max(displacement(part=box, along=x)), peak: cfc60(wall_force).max()}\n"
    (tmp_path / "settings.yaml").write_text(text, encoding="utf-8")
    assert dict(settings("pod-gpr", file=tmp_path / "settings.yaml").kpi) == {
        "intrusion": "max(displacement(part=box, along=x))", "peak": "cfc60(wall_force).max()",
    }  # fmt: skip
    with pytest.raises(SurrogateError, match="lacks displacement"):
        settings("pod-gpr", overrides=["targets=[plastic_strain]"])


def test_histories_of_runs_with_other_times_come_on_common_ones(runs: xr.Dataset) -> None:
    time, known = histories(runs)
    assert time is not None
    other = runs.copy(deep=True)
    other["history_time"][3] = other["history_time"][3] * 0.5  # a run that ends early
    _, found = histories(other)
    late = time > 0.5 * time[-1] + np.diff(time).max()
    assert np.isnan(found[0][2][3, late]).all()
    np.testing.assert_allclose(found[0][2][4], known[0][2][4])
    half = time < 0.45 * time[-1]
    np.testing.assert_allclose(found[0][2][3][half], np.interp(time[half] * 2, time, known[0][2][3]), rtol=1e-6)


def test_samples_that_are_late_by_a_time_step_come_on_even_times(runs: xr.Dataset) -> None:
    time, known = histories(runs)
    assert time is not None
    late = runs.copy(deep=True)
    shift = 0.03 * np.diff(time).mean() * np.random.default_rng(0).random(len(time) - 2)
    late["history_time"][:, 1:-1] = late["history_time"].values[:, 1:-1] + shift
    even, found = histories(late)
    assert even is not None
    np.testing.assert_allclose(np.diff(even), np.diff(even).mean(), rtol=1e-9)
    own = late["history_time"].values[2]
    np.testing.assert_allclose(found[0][2][2], np.interp(even, own, known[0][2][2]), rtol=1e-5, atol=1e-3)
