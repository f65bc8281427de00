"""The ten classical regressors of Almanza-Medina, table 5.4, with scikit-learn in place of MATLAB's Regression Learner.

They read flattened matrices of 5.2.5. Details that Almanza-Medina does not give follow the Regression Learner: features
standardised for support vector machines and Gaussian processes, box constraint and half width of the insensitive tube from
the targets' interquartile range, kernel scale the root of the number of features (ours, MATLAB samples the data); boosting
by least squares with a learning rate of 0.1 and trees of at most ten splits; bagged trees see all features. The Gaussian
process finds its numbers by maximum likelihood.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, nearest_names

if TYPE_CHECKING:
    from mitsonar.datasets.responses import ImpulseSamples

__all__ = ["NORMAL_IQR", "REGRESSORS", "Regression", "RegressionScore", "flattened", "score_all"]

Array = NDArray[np.float64]

LEARNERS, LEAF, SPLITS = 30, 8, 10
"""Trees of an ensemble, the fewest samples of their leaves, and the most splits of a boosted one."""

NORMAL_IQR = 1.349
"""Interquartile range of a Gaussian over its standard deviation, with which the Regression Learner scales."""


class Regression(Protocol):
    """What scikit-learn's regressors do."""

    def fit(self, X: Array, y: Array) -> object:
        """Learn from features ``(n, features)`` and targets ``(n,)``."""

    def predict(self, X: Array) -> Array:
        """Targets of features."""


def _linear(targets: Array) -> Regression:
    from sklearn.linear_model import LinearRegression

    return LinearRegression()  # type: ignore[no-any-return]


def _tree(leaf: int) -> Callable[[Array], Regression]:
    def made(targets: Array) -> Regression:
        from sklearn.tree import DecisionTreeRegressor

        return DecisionTreeRegressor(min_samples_leaf=leaf, random_state=0)  # type: ignore[no-any-return]

    return made


def _svm(degree: int) -> Callable[[Array], Regression]:
    def made(targets: Array) -> Regression:
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler
        from sklearn.svm import SVR

        spread = float(np.subtract(*np.percentile(targets, [75, 25]))) / NORMAL_IQR or 1.0
        constant = 0.0 if degree == 1 else 1.0  # (1 + x x')^degree
        machine = SVR(kernel="poly", degree=degree, coef0=constant, gamma="auto", C=spread, epsilon=spread / 10)
        return make_pipeline(StandardScaler(), machine)  # type: ignore[no-any-return]

    return made


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
    """Features in as many directions as there are samples of training, and what another sample has beside these, as one
    number more: distances to samples of training stay what they are, and cost less where features are many."""

    def fit(self, X: Array, y: Array | None = None) -> Turned:
        """Find the directions that samples ``(n, f)`` span."""
        self.mean = X.mean(axis=0)
        self.axes = np.linalg.qr((X - self.mean).T)[0]
        return self

    def transform(self, X: Array) -> Array:
        """Project samples ``(n, f)`` on these directions ``(n, min(n, f) + 1)``."""
        turned = (X - self.mean) @ self.axes
        rest = ((X - self.mean) ** 2).sum(axis=1) - (turned**2).sum(axis=1)
        return np.column_stack([turned, np.sqrt(np.maximum(rest, 0))])


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
"""By the names of table 5.4: from the targets of training ``(n,)`` [mm] to a regressor."""


@dataclass(frozen=True)
class RegressionScore:
    """How one regressor did.

    Attributes:
        name: of :data:`REGRESSORS`, or ``zero``.
        rmse_mm: on the samples for validation.
        zero_mm: of always answering no motion.
        fit_s, answer_s: seconds for all samples of training, and for all of validation.
        features: that it was given.
    """

    name: str
    rmse_mm: float
    zero_mm: float
    fit_s: float
    answer_s: float
    features: int


def flattened(samples: ImpulseSamples, numbers: Iterable[int] | None = None) -> tuple[NDArray[np.float32], Array]:
    """Packed matrices as rows ``(n, taps 2 M Q)``, and the displacements ``(n, 2 or 3)`` [m, m, rad].

    Args:
        samples: of a data set.
        numbers: of the samples; default: all.
    """
    wanted = range(len(samples)) if numbers is None else list(numbers)
    rows = np.stack([samples.matrix(number) for number in wanted])
    return rows.reshape(len(rows), -1), np.array([samples.target(number) for number in wanted])


def score_all(
    train: tuple[NDArray[np.float32], Array],
    test: tuple[NDArray[np.float32], Array],
    *,
    axis: int = 1,
    names: Sequence[str] | None = None,
    components: int | None = None,
    progress: Callable[[RegressionScore], object] = lambda score: None,
) -> list[RegressionScore]:
    """Fit regressors and score them, in one direction; default: forward, as Almanza-Medina.

    Args:
        train: features ``(n, f)`` and displacements ``(n, 2 or 3)`` [m, m, rad] of :func:`flattened`.
        test: the same, of samples that are not learnt from.
        axis: 0 sideways, 1 forward.
        names: of :data:`REGRESSORS`; default: all.
        components: so many principal components of the training's features in place of all features, for speed;
            standardised, the small ones count as much as the large ones, and answers get worse.
        progress: called with each score.

    Raises:
        MitsonarError: unknown name, no scikit-learn, samples that do not fit.
    """
    wanted = list(REGRESSORS) if names is None else list(names)
    for name in wanted:
        if name not in REGRESSORS:
            raise MitsonarError(f"unknown regressor {name!r}: {nearest_names(name, REGRESSORS)}")
    if axis not in (0, 1):
        raise MitsonarError(f"axis must be 0 (sideways) or 1 (forward): got {axis}")
    features, others = (np.asarray(part[0], dtype=np.float64) for part in (train, test))
    learnt, truth = (1e3 * np.asarray(part[1], dtype=np.float64)[:, axis] for part in (train, test))
    if len(features) < 2 or not len(others) or features.shape[1:] != others.shape[1:]:
        raise MitsonarError(
            f"regressors need two samples to learn from and one to answer, with the same features: got {features.shape} and "
            f"{others.shape}"
        )
    features, others = _fewer(features, others, components)
    zero = float(np.sqrt((truth**2).mean()))
    scores = []
    for name in wanted:
        scores.append(_score(name, features, learnt, others, truth, zero))
        progress(scores[-1])
    return scores


def _score(name: str, features: Array, learnt: Array, others: Array, truth: Array, zero: float) -> RegressionScore:
    """One regressor."""
    try:
        regressor = REGRESSORS[name](learnt)
    except ModuleNotFoundError:
        raise MitsonarError("classical regressors are scikit-learn's: pip install 'mitsonar[learn]'") from None
    begun = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numbers at the ends of their intervals, iterations that ended
        regressor.fit(features, learnt)
    fitted = time.perf_counter()
    error = regressor.predict(others) - truth
    answered = time.perf_counter()
    rmse = float(np.sqrt((error**2).mean()))
    return RegressionScore(name, rmse, zero, fitted - begun, answered - fitted, features.shape[1])


def _fewer(features: Array, others: Array, components: int | None) -> tuple[Array, Array]:
    """Features that are the same in all samples of training left out; then principal components, if so many are asked."""
    kept = np.ptp(features, axis=0) > 0
    features, others = features[:, kept], others[:, kept]
    if components is None:
        return features, others
    if not 1 <= components <= min(features.shape):
        raise MitsonarError(f"components must be 1 to {min(features.shape)} of these samples: got {components}")
    mean = features.mean(axis=0)
    _, _, axes = np.linalg.svd(features - mean, full_matrices=False)
    return (features - mean) @ axes[:components].T, (others - mean) @ axes[:components].T
