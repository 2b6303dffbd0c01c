"""`crashkit.Surrogate` keeps scikit-learn's manners."""

from __future__ import annotations

import numpy as np
import plate
import pytest
from sklearn.model_selection import GridSearchCV, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils.estimator_checks import check_estimator

import crashkit

MU = plate.parameters(30)
FIELDS = plate.displacement(MU)


def test_it_passes_the_checks_of_scikit_learn() -> None:
    found = check_estimator(crashkit.Surrogate(), on_fail=None, on_skip=None)
    failed = {str(one["check_name"]): str(one["exception"]) for one in found if one["status"] == "failed"}
    assert failed == {}
    assert len(found) > 40


@pytest.mark.parametrize("model", ["pod-gpr", "pod-rbf"])
def test_fields_of_any_shape_come_back_in_it(model: str) -> None:
    fitted = crashkit.Surrogate(model).fit(MU[:24], FIELDS[:24])
    said = fitted.predict(MU[24:])
    assert said.shape == FIELDS[24:].shape
    assert np.linalg.norm(said - FIELDS[24:], axis=-1).mean() < 0.1 * np.linalg.norm(FIELDS[24:], axis=-1).mean()
    assert fitted.score(MU[24:], FIELDS[24:]) > 0.95


def test_it_stands_in_cross_validation_pipelines_and_searches() -> None:
    scores = cross_val_score(crashkit.Surrogate(), MU, FIELDS, cv=3)
    assert scores.min() > 0.9
    piped = make_pipeline(StandardScaler(), crashkit.Surrogate())
    np.testing.assert_allclose(cross_val_score(piped, MU, FIELDS, cv=3), scores, atol=1e-4)
    search = GridSearchCV(crashkit.Surrogate(), {"modes": [1, 16]}, cv=3).fit(MU, FIELDS)
    assert search.best_params_ == {"modes": 16}


def test_what_cannot_be_is_said() -> None:
    with pytest.raises(ValueError, match="choose pod-gpr or pod-rbf"):
        crashkit.Surrogate("mh").fit(MU, FIELDS)
    with pytest.raises(ValueError, match="inconsistent numbers of samples"):
        crashkit.Surrogate().fit(MU, FIELDS[:3])
    with pytest.raises(ValueError, match="NaN"):
        crashkit.Surrogate().fit(MU, np.full(30, np.nan))
