"""Coarse runs beneath fine ones: what they bring where they say something, and nothing where they do not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import plate
import pytest
from numpy.typing import NDArray
from scipy import sparse

from surrogates.data.campaign import CoarseRuns
from surrogates.errors import ModelFolderError, SurrogateError
from surrogates.models.pod_regression import PodRegression
from surrogates.queries.points import AtPoints
from surrogates.regression.beneath import ALONE, OF_QUERY
from surrogates.settings import settings
from surrogates.storage.browser import browsable
from surrogates.storage.card import card
from surrogates.storage.folder import load, save
from surrogates.surrogate import Surrogate
from surrogates.training.train import train_surrogate

OFF = ["physics.clock=off", "physics.symmetry=off", "inputs.derived=off", "pod.modes=[16]"]
LEVEL = plate.levels()[0]


def trained(coarse: Callable[[NDArray[np.float64]], NDArray[np.float32]] | None) -> Surrogate:
    campaign = replace(plate.waving_campaign(10, coarse), levels=())
    return train_surrogate(campaign, settings("pod-gpr", overrides=OFF))


def error(surrogate: Surrogate) -> float:
    mu = plate.parameters(20, seed=9)
    return float(np.linalg.norm(surrogate.predict(mu) - plate.waving(mu), axis=-1).mean())


@pytest.fixture(scope="module")
def alone() -> Surrogate:
    return trained(None)


@pytest.fixture(scope="module")
def helped() -> Surrogate:
    return trained(plate.seen_coarsely)


def test_coarse_runs_that_know_more_lower_the_error(alone: Surrogate, helped: Surrogate) -> None:
    assert error(helped) < 0.5 * error(alone)
    errors = helped.record.coarse["errors"]
    assert errors[helped.record.coarse["way"]] < 0.5 * errors[ALONE]
    assert max(helped.record.coarse["slopes"]) > 0.5


def test_coarse_runs_that_say_nothing_change_nothing(alone: Surrogate) -> None:
    useless = trained(plate.noise)
    mu = plate.parameters(5, seed=9)
    assert useless.record.coarse["way"] == ALONE
    assert any("fine runs alone are kept" in note for note in useless.record.notes)
    np.testing.assert_array_equal(useless.predict(mu), alone.predict(mu))
    with pytest.raises(SurrogateError, match="did not pay"):
        useless.predict_from_coarse(mu[0], plate.noise(mu)[0], plate.TIME)


def test_a_coarse_run_of_the_query_is_taken_over(helped: Surrogate) -> None:
    mu = plate.parameters(20, seed=9)
    from_itself = np.stack(
        [helped.predict_from_coarse(p, seen, plate.TIME) for p, seen in zip(mu, plate.seen_coarsely(mu), strict=True)]
    )
    assert np.linalg.norm(from_itself - plate.waving(mu), axis=-1).mean() < error(helped)
    assert helped.record.coarse["errors"][OF_QUERY] < helped.record.coarse["errors"][ALONE]


def test_another_coarse_run_says_something_else(helped: Surrogate) -> None:
    mu = plate.parameters(2, seed=9)
    one, other = (helped.predict_from_coarse(mu[0], seen, plate.TIME) for seen in plate.seen_coarsely(mu))
    assert np.abs(one - other).max() > 0.01


def test_the_folder_needs_no_coarse_runs_and_predicts_the_same(helped: Surrogate, tmp_path: Path) -> None:
    again = load(save(helped, tmp_path / "m"))
    mu = plate.parameters(3, seed=9)
    seen = plate.seen_coarsely(mu)[0]
    np.testing.assert_allclose(again.predict(mu), helped.predict(mu), atol=1e-7)
    np.testing.assert_allclose(
        again.predict_from_coarse(mu[0], seen, plate.TIME),
        helped.predict_from_coarse(mu[0], seen, plate.TIME),
        atol=1e-7,
    )
    np.testing.assert_array_equal(
        again.band(0.9, parameters=mu[0], from_coarse=True), helped.band(0.9, parameters=mu[0], from_coarse=True)
    )
    assert again.record.coarse == helped.record.coarse


def test_a_map_that_points_nowhere_is_refused(helped: Surrogate, tmp_path: Path) -> None:
    assert isinstance(helped.core, PodRegression)
    assert helped.core.base is not None
    right, wrong = helped.core.base, helped.core.base.mesh.to_fine.copy()
    wrong.indices[0] = 10_000
    helped.core.base = replace(right, mesh=replace(right.mesh, to_fine=wrong))
    try:
        save(helped, tmp_path / "m")
    finally:
        helped.core.base = right
    with pytest.raises(ModelFolderError, match="coarse mesh"):
        load(tmp_path / "m")


def test_the_card_says_what_coarse_runs_there_were(helped: Surrogate) -> None:
    text = card(helped)
    assert "60 runs of" in text
    assert "checksum facade" in text
    assert "slopes of the first modes" in text


def test_at_training_runs_the_fold_knows_no_coarse_run_of_its_own(helped: Surrogate) -> None:
    errors = helped.record.coarse["errors"]
    assert errors[OF_QUERY] != errors[helped.record.coarse["way"]]
    assert helped.record.coarse["twins"] == 10


def test_points_are_predicted_as_the_whole_mesh_is(helped: Surrogate) -> None:
    mu = plate.parameters(3, seed=9)
    nodes = np.array([3, 40, 77])
    where = sparse.csr_matrix((np.ones(3), (np.arange(3), nodes)), shape=(3, 81))
    found = AtPoints(helped, where, plate.TIME)(mu)
    np.testing.assert_allclose(found, helped.predict(mu)[:, :, nodes], atol=1e-5)


def test_a_page_with_sliders_sums_the_processes(helped: Surrogate) -> None:
    found = browsable(helped, "m", "m_")
    assert [term["samples"] for term in found.about["added"]] == [10, 60]
    assert all(name in found.arrays for term in found.about["added"] for name in term["arrays"].values())


def test_other_models_refuse_coarse_runs() -> None:
    campaign = plate.campaign(6)
    with pytest.raises(SurrogateError, match="coarse runs go beneath mh and pod-gpr"):
        train_surrogate(replace(campaign, coarse=CoarseRuns(campaign, LEVEL.to_full)), settings("pod-rbf"))
