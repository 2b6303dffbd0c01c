"""The data card: numbers of real runs, and runs that are not like the others."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from crashkit.errors import OutputError
from evaluation.figures.outliers import robust_score
from evaluation.report.datacard import card_drawings, card_statements, summarise, surprise, write_card


def test_the_card_is_complete(reference, tmp_path):
    page = write_card(reference, tmp_path / "card", about={"Path": "kart.zarr"})
    text = page.read_text(encoding="utf-8")
    for name in ("envelopes", "coverage", "singular_values", "outliers"):
        assert f'id="figure-{name}"' in text
        assert (tmp_path / "card" / "figures" / f"{name}.csv").stat().st_size > 0
    numbers = json.loads((tmp_path / "card" / "card.json").read_text(), parse_constant=pytest.fail)
    assert numbers["runs"]["run"] == list(reference.runs)
    assert numbers["singular_values_normalised"][0] == 1
    assert "kart.zarr" in text


def test_displacements_and_speeds_are_those_of_the_runs(reference):
    found = summarise(reference, count=5)
    u = reference.displacement(3).astype(float)
    np.testing.assert_allclose(found.mean[3], np.linalg.norm(u, axis=-1).mean(axis=1))
    np.testing.assert_allclose(found.largest[3], np.linalg.norm(u, axis=-1).max(axis=1))
    steps = np.linalg.norm(np.diff(u, axis=0), axis=-1) / np.diff(reference.time)[:, None]
    assert found.speed[3] == pytest.approx(steps.max())
    assert not found.lost.any()


def test_gone_nodes_are_counted_and_not_zero(eroded, reference):
    found = summarise(eroded, count=5)
    np.testing.assert_allclose(found.lost, 50 / reference.n_nodes)
    u = reference.displacement(0)[-1, 50:].astype(float)
    assert found.mean[0, -1] == pytest.approx(np.linalg.norm(u, axis=-1).mean())


def test_leaving_a_run_out_is_what_refitting_without_it_gives():
    rng = np.random.default_rng(0)
    parameters = rng.uniform(-1, 1, (14, 1))
    samples = rng.normal(size=(14, 2, 3, 3))
    x = 2 * (parameters - parameters.min()) / np.ptp(parameters) - 1
    basis = np.column_stack([np.ones(14), x, x**2])  # 14 runs carry three terms
    for run in (0, 5, 13):
        rest = np.arange(14) != run
        fit, *_ = np.linalg.lstsq(basis[rest], samples[rest].reshape(13, -1), rcond=None)
        expected = np.linalg.norm((samples[run].ravel() - basis[run] @ fit).reshape(2, 3, 3), axis=-1).mean()
        assert surprise(parameters, samples)[run] == pytest.approx(expected)


def test_a_run_with_wrong_parameters_stands_out():
    rng = np.random.default_rng(1)
    parameters = rng.uniform(-1, 1, (30, 2))
    modes = rng.normal(size=(2, 3, 4, 3))
    samples = np.einsum("rp,psnd->rsnd", parameters, modes) + 0.05 * rng.normal(size=(30, 3, 4, 3))
    parameters[7] = [-0.5, 0.5] if parameters[7, 0] > 0 else [0.5, -0.5]
    score = robust_score(surprise(parameters, samples))
    assert int(np.argmax(score)) == 7
    assert score[7] > 5


def test_runs_that_are_all_alike_have_no_score():
    assert robust_score(np.ones(5)).tolist() == [0] * 5


def test_a_dataset_without_parameters_shows_no_coverage(reference):
    plain = replace(reference, parameters=np.empty((12, 0)), parameter_names=(), parameter_units=())
    names = [kind.name for kind, _ in card_drawings(plain, summarise(plain, count=5))]
    assert names == ["envelopes", "singular_values", "outliers"]


def test_a_single_run_has_no_outliers(reference):
    one = replace(reference, runs=("only",), parameters=reference.parameters[:1])
    summary = summarise(one, count=5)
    assert [kind.name for kind, _ in card_drawings(one, summary)] == ["envelopes", "coverage", "singular_values"]
    assert any("1 runs for 3 parameters" in s.text for s in card_statements(one, summary))


def test_a_card_that_fails_leaves_nothing(reference, tmp_path):
    def broken(run: int) -> np.ndarray:
        raise OSError(5, "cannot be read", "run.bin")

    with pytest.raises(OutputError):
        write_card(replace(reference, displacement=broken), tmp_path / "card")
    assert list(tmp_path.iterdir()) == []
