"""crashkit's regression beside one of scikit-learn's, judged by scikit-learn's own cross-validation.

    python examples/cross_validate.py kart.zarr 27:36

The second argument names the test runs, which take no part in it.
"""

import sys

import numpy as np
from sklearn.dummy import DummyRegressor
from sklearn.linear_model import Ridge
from sklearn.metrics import make_scorer, r2_score
from sklearn.model_selection import GridSearchCV, KFold, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures, StandardScaler

import crashkit

train, test = crashkit.open_dataset(sys.argv[1]).crash.split(test=sys.argv[2] if len(sys.argv) > 2 else 0.25)
names = train.crash.parameters
parameters = np.stack([train[name].values for name in names], axis=1)  # (run, parameter)
fields = train.displacement.isel(time=slice(None, None, 5)).values  # (run, state, node, xyz), m
flat = fields.reshape(len(fields), -1)

parts = KFold(5, shuffle=True, random_state=0)
quadratic = make_pipeline(StandardScaler(), PolynomialFeatures(2), Ridge(1e-2))
alike = make_scorer(r2_score, multioutput="variance_weighted")  # the same measure for all
for name, model in (
    ("mean of the runs", DummyRegressor()),
    ("quadratic", quadratic),
    ("crashkit.Surrogate", crashkit.Surrogate()),
):
    scores = cross_val_score(model, parameters, flat, cv=parts, scoring=alike)
    print(f"{name:<20} R² {scores.mean():6.3f} ({scores.min():.3f} to {scores.max():.3f})")

search = GridSearchCV(crashkit.Surrogate(), {"model": ["pod-gpr", "pod-rbf"], "modes": [4, 16, 48]}, cv=parts)
print("best:", search.fit(parameters, fields).best_params_)
