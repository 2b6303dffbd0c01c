"""`crashkit scatter` on a plate whose answers are known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import plate
import pytest
from typer.testing import CliRunner

import crashkit
from crashkit.api.scatter import scatter
from crashkit.cli import app
from crashkit.errors import DataError, OutputError
from crashkit.writers.paraview import read_state
from evaluation.errors import EvaluationError
from evaluation.scatter.draws import draw
from evaluation.scatter.result import ScatterResult
from surrogates.data.campaign import Labels
from surrogates.doubt import BandDoubt, ProcessDoubt, doubt_of
from surrogates.settings import settings
from surrogates.surrogate import Surrogate
from surrogates.training.train import train_surrogate
from surrogates.uncertainty import Spread

VARY = {"impact_speed": "5%", "impact_angle": "2degree"}
CENTRE = plate.SIDES[0] ** 2 // 2


def labels() -> Labels:
    faces = len(plate.quads(plate.SIDES[0]))
    part = (np.arange(faces) >= faces // 2).astype(np.int64)
    return Labels(1000 + np.arange(81), part, np.array([1, 2]), ("left", "right"))


@pytest.fixture(scope="module")
def model() -> crashkit.Model:
    return crashkit.Model(train_surrogate(plate.campaign(24, labels=labels()), settings("pod-gpr")))


@pytest.fixture(scope="module")
def found(model: crashkit.Model) -> ScatterResult:
    return scatter(
        model, VARY, draws=400, numbers={"dent": f"max(displacement(node={1000 + CENTRE}, along=-z))"},
        limits=["dent < 0.32 m", "displacement(part=right) < 300 mm"],
    )  # fmt: skip


def truth(draws: np.ndarray) -> np.ndarray:
    return plate.displacement(np.column_stack([draws, np.full(len(draws), 3e8)]))


def test_numbers_and_fields_are_those_of_the_true_plate(found: ScatterResult) -> None:
    true = truth(found.draws)
    dent = -true[:, :, CENTRE, 2].min(axis=1)
    assert found.numbers[1].name == "dent"
    np.testing.assert_allclose(found.numbers[1].values, dent, atol=5e-3)
    np.testing.assert_allclose(found.mean, true.mean(axis=0), atol=3e-3)
    spread = np.sqrt(true.var(axis=0).sum(axis=-1))
    np.testing.assert_allclose(found.deviation, spread, atol=3e-3)
    assert found.limits[0].probability.value == pytest.approx(np.mean(dent >= 0.32), abs=0.06)


def test_the_interval_holds_the_true_probability(found: ScatterResult) -> None:
    many = draw(found.scatter, 20_000, 5)
    dent = -truth(many)[:, -1, CENTRE, 2]
    chance = found.limits[0].probability
    assert chance.both[0] <= np.mean(dent >= 0.32) <= chance.both[1]
    assert chance.model is not None


def test_a_limit_on_every_node_says_where_it_is_broken(found: ScatterResult) -> None:
    limit = found.limits[1]
    assert limit.ever is not None
    right = np.unique(plate.quads(plate.SIDES[0])[labels().face_part == 1])
    assert np.isfinite(limit.ever[right]).all()
    assert np.isnan(np.delete(limit.ever, right)).all()
    size = np.linalg.norm(truth(found.draws), axis=-1)[:, :, right].max(axis=1)
    np.testing.assert_allclose(limit.ever[right], (size >= 0.3).mean(axis=0), atol=0.08)
    assert limit.probability.value == pytest.approx((size >= 0.3).any(axis=1).mean(), abs=0.06)


def test_the_speed_makes_the_dent(found: ScatterResult) -> None:
    total = dict(zip(VARY, found.indices.total[1], strict=True))
    assert total["impact_speed"] > 0.7 > total["impact_angle"]


def test_parts_are_those_of_the_model(found: ScatterResult) -> None:
    assert found.differences.names == ("left", "right")
    assert found.folding.count == 1


def test_draws_do_not_depend_on_how_many_are_in_memory(
    model: crashkit.Model, found: ScatterResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("crashkit.api.scatter._AT_ONCE", 7 * 7 * 81 * 12)
    again = scatter(model, VARY, draws=400)
    np.testing.assert_allclose(again.numbers[0].values, found.numbers[0].values, rtol=1e-5)
    np.testing.assert_allclose(again.deviation, found.deviation, rtol=1e-3, atol=1e-7)


def test_draws_outside_the_trained_range_are_told(model: crashkit.Model) -> None:
    wide = scatter(
        model, {"impact_speed": "20%:uniform"}, at={"impact_speed": 28}, draws=64, limits=["displacement() < 0.4 m"]
    )
    assert "% of the draws of impact_speed lie outside the trained range" in wide.warnings[-1]
    assert 0 < wide.inside.mean() < 1
    assert wide.scatter[0].shape == "uniform"
    assert wide.scatter[0].width == pytest.approx(5.6)
    assert wide.limits[0].outside > 0


def test_a_draw_at_which_the_model_has_no_numbers_is_named(
    model: crashkit.Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    predicted = Surrogate.predict_full

    def slow_is_nan(self: Surrogate, parameters: np.ndarray, *more: object) -> np.ndarray:
        out = predicted(self, parameters, *more)  # type: ignore[arg-type]
        out[parameters[:, 0] < 10.0] = np.nan
        return out

    monkeypatch.setattr(Surrogate, "predict_full", slow_is_nan)
    with pytest.raises(DataError, match=r"a draw with impact_speed \d.* m s-1 gives numbers that are not finite"):
        scatter(model, {"impact_speed": "40%"}, draws=64)


@pytest.mark.parametrize(
    ("vary", "more", "said"),
    [
        ({"speed": "5%"}, {}, "parameter 'speed' is not known"),
        ({}, {}, "nothing scatters"),
        ({"impact_angle": "5%"}, {"at": {"impact_angle": 0}}, "the nominal value is zero"),
        ({"impact_speed": "2kg"}, {}, "the unit 'kg' is not one of impact_speed"),
        ({"impact_speed": "2furlongs"}, {}, "impact_speed=2furlongs: unit 'furlongs' is not known"),
        ({"impact_speed": "5%:triangle"}, {}, "'triangle' is no kind of scatter"),
        ({"impact_speed": "0"}, {}, "expected a width above zero"),
        ({"impact_speed": "1"}, {"at": {"impact_speed": 99}}, "far outside"),
        ({"impact_speed": "1"}, {"limits": ["dent < 3"]}, "dent is no history, parameter or number"),
        ({"impact_speed": "1"}, {"limits": ["max(displacement()) < 3 N"]}, "the limit is in N"),
        ({"impact_speed": "1"}, {"numbers": {"a": "displacement(part=door).max()"}}, "no part 'door'"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_predicted(
    model: crashkit.Model, vary: dict[str, str], more: dict[str, object], said: str
) -> None:
    with pytest.raises((DataError, EvaluationError), match=said):
        scatter(model, vary, draws=8, **more)  # type: ignore[arg-type]


def test_errors_drawn_from_the_posterior_are_as_large_as_those_on_runs_that_were_left_out(
    model: crashkit.Model,
) -> None:
    surrogate = model.surrogate
    runs = plate.parameters(60, seed=9)
    doubt = doubt_of(surrogate, runs, plate.TIME, 30, 0, 0)
    assert isinstance(doubt, ProcessDoubt)
    nodes = np.arange(81)
    drawn = np.mean([np.linalg.norm(doubt.draw(j, slice(None), nodes), axis=-1).mean() for j in range(30)])
    expected = np.mean([error for error, _ in surrogate.record.left_out.values()])
    assert drawn == pytest.approx(expected, rel=0.4)
    some = doubt.draw(3, slice(5, 9), nodes[10:14])
    np.testing.assert_allclose(some, doubt.draw(3, slice(None), nodes)[5:9][:, :, 10:14], atol=1e-6)


@pytest.mark.parametrize("spread", ["size", "local"])
def test_a_model_without_a_posterior_is_doubted_by_its_band(spread: Spread) -> None:
    surrogate = train_surrogate(plate.campaign(16), settings("pod-rbf"))
    surrogate.bands[0, False] = replace(surrogate.bands[0, False], spread=spread, local=surrogate.local_errors())
    runs = plate.parameters(4, seed=9)
    doubt = doubt_of(surrogate, runs, plate.TIME, 400, 0, 0)
    assert isinstance(doubt, BandDoubt)
    length = np.stack([np.linalg.norm(doubt.draw(j, slice(0, 1), np.arange(81))[0], axis=-1) for j in range(400)])
    within = (length <= surrogate.band(0.9, plate.TIME, parameters=runs[0])).mean()
    assert within == pytest.approx(0.9, abs=0.05)


def test_the_command_writes_page_tables_and_fields(model: crashkit.Model, tmp_path: Path) -> None:
    model.save(tmp_path / "gpr")
    out = tmp_path / "scatter"
    arguments = [
        "scatter",
        str(tmp_path / "gpr"),
        "--vary",
        "impact_speed=5%,impact_angle=2degree",
        "-n",
        "64",
        "-o",
        str(out),
    ]
    arguments += ["--number", "dent=max(displacement(along=-z))", "--limit", "displacement(part=right) < 300 mm"]
    told = CliRunner().invoke(app, [*arguments, "--json"])
    assert told.exit_code == 0, told.output
    said = json.loads(told.stdout)
    assert said["numbers"]["number"] == ["largest_displacement", "dent"]
    assert 0 <= said["limits"][0]["both"][0] <= said["limits"][0]["value"] <= said["limits"][0]["both"][1] <= 1
    assert "posterior" in said["doubt"]
    assert len(pd.read_csv(out / "draws.csv")) == 64
    _, grid = read_state(out / "fields.pvd")
    for name in ("displacement", "deviation", "probability_1", "probability_1_ever", "node_id"):
        assert name in grid.point_data
    page = (out / "scatter.html").read_text(encoding="utf-8")
    assert "http" not in page.replace("http://www.w3.org", "")
    again = CliRunner().invoke(app, arguments)
    assert again.exit_code == 1
    assert "holds a scatter already" in again.stderr


def test_a_table_that_is_there_is_not_lost(model: crashkit.Model, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("notes", encoding="utf-8")
    with pytest.raises(OutputError, match=r"holds no scatter\.json"):
        scatter(model, VARY, tmp_path, draws=8)
    assert (tmp_path / "mine.txt").exists()


def test_few_draws_are_told_and_nominal_values_are_printed(model: crashkit.Model, tmp_path: Path) -> None:
    model.save(tmp_path / "model")
    told = CliRunner().invoke(
        app, ["scatter", str(tmp_path / "model"), "--vary", "impact_speed=5%", "-n", "2", "-o", str(tmp_path / "out")]
    )
    assert told.exit_code == 0, told.output
    said = " ".join(told.output.split())
    assert "2 draws are few" in said
    assert "nominal: impact_speed" in said


def test_a_place_that_cannot_be_written_is_refused_before_drawing(
    model: crashkit.Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("crashkit.api.scatter._Study.check", lambda *_: pytest.fail("it went on"))
    with pytest.raises(OutputError, match="no folder can be made there"):
        scatter(model, VARY, tmp_path / "file" / "out", draws=100)


def test_a_negative_scatter_is_explained(model: crashkit.Model) -> None:
    with pytest.raises(DataError, match="a scatter has no sign, it goes to both sides; write impact_speed=5%"):
        scatter(model, {"impact_speed": "-5%"}, draws=100)
