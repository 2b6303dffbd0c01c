"""The POD regression as an estimator of scikit-learn: for cross-validation, pipelines and searches over arrays in hand."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils.validation import check_array, check_consistent_length, check_is_fitted, validate_data

from surrogates.data.inputs import over_range
from surrogates.regression.gaussian import Gaussian, RadialBasis

MODELS = ("pod-gpr", "pod-rbf")


class Surrogate(MultiOutputMixin, RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """POD modes of fields and a regression from parameters to their coefficients; a run is one sample.

    It knows arrays alone: nothing of meshes, times, parts, or of what `crashkit.train` knows beforehand. Use it to compare
    crashkit's regression with others under scikit-learn's own rules.

    Parameters
    ----------
    model
        pod-gpr: a Gaussian process with one kernel for all coefficients; pod-rbf: radial basis functions.
    modes
        Most POD modes.
    seed
        Of the samples by which the kernel's numbers are set.

    Attributes
    ----------
    modes_
        (mode, output) POD modes of the training fields about their mean.
    mean_
        (output,)
    field_shape_
        Shape of one run's field; predictions have it, too.
    n_features_in_
        Parameters.

    Notes
    -----
    The fields may have any shape behind the runs: (run, output), (run, state, node, 3), or one number (run,). `score` is R²,
    averaged over outputs by their variance.
    """

    def __init__(self, model: str = "pod-gpr", modes: int = 48, seed: int = 0) -> None:
        self.model = model
        self.modes = modes
        self.seed = seed

    def fit(self, X: ArrayLike, y: ArrayLike) -> Surrogate:
        """Fit to parameters X (run, parameter) and fields y (run, ...).

        Raises
        ------
        ValueError
            For arrays that do not fit, or an unknown model.
        """
        if self.model not in MODELS:
            raise ValueError(f"model {self.model!r} is not known; choose {' or '.join(MODELS)}")
        if self.modes < 1:
            raise ValueError(f"modes = {self.modes}: expected at least 1")
        if y is None:
            raise ValueError("requires y to be passed, but the target y is None: give the fields of the runs")
        x = validate_data(self, X, dtype=np.float64, ensure_min_samples=2)
        fields = check_array(y, dtype=np.float64, ensure_2d=False, allow_nd=True, input_name="y")
        check_consistent_length(x, fields)
        self.field_shape_ = fields.shape[1:]
        flat = fields.reshape(len(fields), -1)
        self.mean_ = flat.mean(axis=0)
        left, size, right = np.linalg.svd(flat - self.mean_, full_matrices=False)
        keep = max(1, min(self.modes, int((size > 1e-10 * max(size[0], 1e-300)).sum())))
        self.modes_ = right[:keep]
        self.values_ = left[:, :keep] * size[:keep]
        self.corners_ = np.stack([x.min(axis=0), x.max(axis=0)])
        inputs = over_range(x, self.corners_)
        machine: Any = RadialBasis(inputs) if self.model == "pod-rbf" else Gaussian(inputs)
        self.machine_ = machine.fit(self.values_, self.seed)
        return self

    def predict(self, X: ArrayLike) -> NDArray[np.float64]:
        """Fields (run, ...) at parameters X (run, parameter)."""
        check_is_fitted(self)
        x = validate_data(self, X, dtype=np.float64, reset=False)
        flat = self.machine_.weights(over_range(x, self.corners_)) @ self.values_ @ self.modes_ + self.mean_
        return np.asarray(flat.reshape(len(x), *self.field_shape_))

    def score(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> float:
        """R² of the predictions, outputs weighted by their variance: 1 is perfect, 0 no better than the mean."""
        from sklearn.metrics import r2_score

        said, true = self.predict(X), np.asarray(y, np.float64)
        flat = [a.reshape(len(true), -1) for a in (true, said)]
        return float(r2_score(*flat, sample_weight=sample_weight, multioutput="variance_weighted"))
