"""The ten classical regressors of Almanza-Medina, table 5.4, with scikit-learn in place of MATLAB's Regression Learner.

They read flattened matrices of 5.2.5. Details that Almanza-Medina does not give follow the Regression Learner: features
standardised for support vector machines and Gaussian processes, box constraint and half width of the insensitive tube from
the targets' interquartile range, kernel scale the root of the number of features (ours, MATLAB samples the data); boosting
by least squares with a learning rate of 0.1 and trees of at most ten splits; bagged trees see all features. The Gaussian
process is fitted by maximum likelihood.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, suggest_names

if TYPE_CHECKING:
    from mitsonar.datasets.responses import ImpulseSamples

__all__ = ["NORMAL_IQR", "REGRESSORS", "Regression", "RegressionScore", "flattened", "score_all"]

Array = NDArray[np.float64]

LEARNERS, LEAF, SPLITS = 30, 8, 10
"""Trees of an ensemble, the fewest samples of their leaves, and the most splits of a boosted one."""

NORMAL_IQR = 1.349
"""Interquartile range of a Gaussian over its standard deviation, with which the Regression Learner scales."""


class Regression(Protocol):
    """Interface of scikit-learn's regressors."""

    def fit(self, X: Array, y: Array) -> object:
        """Learn from features ``(n, features)`` and targets ``(n,)``."""

    def predict(self, X: Array) -> Array:
        """Predict the targets ``(n,)`` of features ``(n, features)``."""


def _linear(targets: Array) -> Regression:
    from sklearn.linear_model import LinearRegression

    return LinearRegression()  # type: ignore[no-any-return]


def _tree(leaf: int) -> Callable[[Array], Regression]:
    def build(targets: Array) -> Regression:
        from sklearn.tree import DecisionTreeRegressor

        return DecisionTreeRegressor(min_samples_leaf=leaf, random_state=0)  # type: ignore[no-any-return]

    return build


def _svm(degree: int) -> Callable[[Array], Regression]:
    def build(targets: Array) -> Regression:
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler
        from sklearn.svm import SVR

        spread = float(np.subtract(*np.percentile(targets, [75, 25]))) / NORMAL_IQR or 1.0
        constant = 0.0 if degree == 1 else 1.0  # (1 + x x')^degree
        machine = SVR(kernel="poly", degree=degree, coef0=constant, gamma="auto", C=spread, epsilon=spread / 10)
        return make_pipeline(StandardScaler(), machine)  # type: ignore[no-any-return]

    return build


def _boosted(targets: Array) -> Regression:
    from sklearn.ensemble import GradientBoostingRegressor

    return GradientBoostingRegressor(  # type: ignore[no-any-return]
        n_estimators=LEARNERS,
        learning_rate=0.1,
        min_samples_leaf=LEAF,
        max_depth=None,
        max_leaf_nodes=SPLITS + 1,
        random_state=0,
    )


def _bagged(targets: Array) -> Regression:
    from sklearn.ensemble import BaggingRegressor
    from sklearn.tree import DecisionTreeRegressor

    tree = DecisionTreeRegressor(min_samples_leaf=LEAF)
    return BaggingRegressor(tree, n_estimators=LEARNERS, random_state=0)  # type: ignore[no-any-return]


def _rational_quadratic(targets: Array) -> Regression:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import ConstantKernel, RationalQuadratic, WhiteKernel
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    kernel = ConstantKernel() * RationalQuadratic(length_scale=100.0, length_scale_bounds=(1e-2, 1e5)) + WhiteKernel(0.1)
    process = GaussianProcessRegressor(kernel, normalize_y=True, random_state=0)
    return make_pipeline(StandardScaler(), Turned(), process)  # type: ignore[no-any-return]


class Turned:
    """Projection on the span of the training samples, with the norm of the residual as one further feature.

    Distances to training samples are preserved, at less cost if there are many features.
    """

    def fit(self, X: Array, y: Array | None = None) -> Turned:
        """Compute an orthonormal basis of the span of samples ``(n, f)``."""
        self.mean = X.mean(axis=0)
        self.axes = np.linalg.qr((X - self.mean).T)[0]
        return self

    def transform(self, X: Array) -> Array:
        """Project samples ``(n, f)`` on this basis, and append the norm of the residual ``(n, min(n, f) + 1)``."""
        projected = (X - self.mean) @ self.axes
        rest = ((X - self.mean) ** 2).sum(axis=1) - (projected**2).sum(axis=1)
        return np.column_stack([projected, np.sqrt(np.maximum(rest, 0))])


REGRESSORS: dict[str, Callable[[Array], Regression]] = {
    "Linear Regression": _linear,
    "Fine Tree": _tree(4),
    "Medium Tree": _tree(12),
    "Coarse Tree": _tree(36),
    "Linear SVM": _svm(1),
    "Quadratic SVM": _svm(2),
    "Cubic SVM": _svm(3),
    "Ensemble (Boosted trees)": _boosted,
    "Ensemble (Bagged trees)": _bagged,
    "Rational Quadratic GPR": _rational_quadratic,
}
"""Functions that make a regressor for training targets ``(n,)`` [mm], keyed by the names of table 5.4."""


@dataclass(frozen=True)
class RegressionScore:
    """Accuracy and time of one regressor.

    Attributes:
        name: of :data:`REGRESSORS`, or ``zero``.
        rmse_mm: on the validation samples.
        zero_mm: RMSE of always estimating no motion.
        fit_s, answer_s: seconds for all training samples, and for all validation samples.
        features: number of features.
    """

    name: str
    rmse_mm: float
    zero_mm: float
    fit_s: float
    answer_s: float
    features: int


def flattened(samples: ImpulseSamples, numbers: Iterable[int] | None = None) -> tuple[NDArray[np.float32], Array]:
    """Return packed matrices as rows ``(n, taps 2 M Q)``, and the displacements ``(n, 2 or 3)`` [m, m, rad].

    Args:
        samples: of a data set.
        numbers: of the samples; default: all.
    """
    indices = range(len(samples)) if numbers is None else list(numbers)
    rows = np.stack([samples.matrix(index) for index in indices])
    return rows.reshape(len(rows), -1), np.array([samples.target(index) for index in indices])


def score_all(
    train: tuple[NDArray[np.float32], Array],
    test: tuple[NDArray[np.float32], Array],
    *,
    axis: int = 1,
    names: Sequence[str] | None = None,
    components: int | None = None,
    progress: Callable[[RegressionScore], object] = lambda score: None,
) -> list[RegressionScore]:
    """Fit regressors and score them on one axis; default: forward, as Almanza-Medina.

    Args:
        train: features ``(n, f)`` and displacements ``(n, 2 or 3)`` [m, m, rad] of :func:`flattened`.
        test: the same, of samples that are not used for training.
        axis: 0 sideways, 1 forward.
        names: of :data:`REGRESSORS`; default: all.
        components: number of principal components of the training features that replace all features, for speed. Since
            they are standardised, small ones get the same weight as large ones, and estimates get worse.
        progress: called with each score.

    Raises:
        MitsonarError: unknown name, no scikit-learn, samples that do not fit.
    """
    chosen = list(REGRESSORS) if names is None else list(names)
    for name in chosen:
        if name not in REGRESSORS:
            raise MitsonarError(f"unknown regressor {name!r}: {suggest_names(name, REGRESSORS)}")
    if axis not in (0, 1):
        raise MitsonarError(f"axis must be 0 (sideways) or 1 (forward): got {axis}")
    features, test_features = (np.asarray(part[0], dtype=np.float64) for part in (train, test))
    train_targets, test_targets = (1e3 * np.asarray(part[1], dtype=np.float64)[:, axis] for part in (train, test))
    if len(features) < 2 or not len(test_features) or features.shape[1:] != test_features.shape[1:]:
        raise MitsonarError(
            f"regressors need two training samples and one test sample, with the same features: got {features.shape} and "
            f"{test_features.shape}"
        )
    features, test_features = _reduced(features, test_features, components)
    zero = float(np.sqrt((test_targets**2).mean()))
    scores = []
    for name in chosen:
        scores.append(_score(name, features, train_targets, test_features, test_targets, zero))
        progress(scores[-1])
    return scores


def _score(
    name: str, features: Array, train_targets: Array, test_features: Array, test_targets: Array, zero: float
) -> RegressionScore:
    """Fit one regressor and score it."""
    try:
        regressor = REGRESSORS[name](train_targets)
    except ModuleNotFoundError:
        raise MitsonarError("classical regressors need scikit-learn: pip install 'mitsonar[learn]'") from None
    started = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numbers at the ends of their intervals, iterations that ended
        regressor.fit(features, train_targets)
    fitted = time.perf_counter()
    error = regressor.predict(test_features) - test_targets
    answered = time.perf_counter()
    rmse = float(np.sqrt((error**2).mean()))
    return RegressionScore(name, rmse, zero, fitted - started, answered - fitted, features.shape[1])


def _reduced(features: Array, test_features: Array, components: int | None) -> tuple[Array, Array]:
    """Drop features that are constant in training; then project on principal components, if a number is given."""
    varying = np.ptp(features, axis=0) > 0
    features, test_features = features[:, varying], test_features[:, varying]
    if components is None:
        return features, test_features
    if not 1 <= components <= min(features.shape):
        raise MitsonarError(f"components must be 1 to {min(features.shape)} for these samples: got {components}")
    mean = features.mean(axis=0)
    _, _, directions = np.linalg.svd(features - mean, full_matrices=False)
    return (features - mean) @ directions[:components].T, (test_features - mean) @ directions[:components].T
