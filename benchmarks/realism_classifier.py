"""How well a classifier separates simulated frames from real ones: logistic regression on patches, by group of features."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy import stats

__all__ = ["GROUPS", "accuracies", "control_accuracies"]

Array = NDArray[np.float64]

PATCH = (32, 16)
"""Bins and beams of a patch."""

LAGS = ((1, 0), (2, 0), (3, 0), (0, 1), (0, 2), (0, 3), (1, 1), (1, -1), (2, 1))
"""Lags at which the grain is correlated: bins and beams."""

GROUPS: dict[str, slice] = {
    "level": slice(0, 4),
    "grain": slice(4, 9),
    "correlation": slice(9, 18),
    "rows, columns": slice(18, 22),
    "all": slice(0, 22),
}
"""Features of a patch by group: level and span; law of the grain; its correlation; means of bins and beams."""

STRENGTH = 0.3
"""Inverse weight of the penalty on the coefficients: halves of a recording hold some hundred patches."""


def patches(level: Array) -> Iterator[Array]:
    """Yield the patches ``PATCH`` of levels ``(frames, bins, beams)`` [dB] that hold more than the floor."""
    bins, beams = PATCH
    floor = level.min()
    for frame in level:
        for row in range(0, frame.shape[0] - bins + 1, bins):
            for column in range(0, frame.shape[1] - beams + 1, beams):
                patch = frame[row : row + bins, column : column + beams]
                if (patch > floor).mean() > 0.5:
                    yield patch


def features(patch: Array) -> Array:
    """Return the features of a patch ``(22,)``, in the order of :data:`GROUPS`."""
    # 1. Level and span.
    low, middle, high = np.percentile(patch, (5, 50, 95))
    level = [patch.mean(), patch.std(), high - middle, middle - low]
    # 2. Grain: what is left without a plane.
    rows, columns = (np.linspace(-1, 1, size) for size in patch.shape)
    rest = patch - patch.mean()
    rest = rest - np.outer(rows, np.ones(len(columns))) * (rest.mean(axis=1) @ rows / (rows @ rows))
    rest = rest - np.outer(np.ones(len(rows)), columns) * (rest.mean(axis=0) @ columns / (columns @ columns))
    spread = rest.std() + 1e-6
    power = 10 ** (rest / 10)
    grain = [spread, stats.skew(rest, axis=None), stats.kurtosis(rest, axis=None), power.std() / power.mean()]
    grain.append(np.abs(np.diff(np.sort(np.abs(rest).ravel()))).max())
    # 3. Its correlation.
    correlation = []
    for bins, beams in LAGS:
        one = rest[: rest.shape[0] - bins, max(0, -beams) : rest.shape[1] - max(0, beams)]
        other = rest[bins:, max(0, beams) : rest.shape[1] + min(0, beams)]
        correlation.append((one * other).mean() / spread**2)
    # 4. Means of bins and of beams, and how they change from one to the next.
    means = (rest.mean(axis=1), rest.mean(axis=0))
    sides = [float(value) for mean in means for value in (mean.std(), np.diff(mean).std())]
    return np.asarray(np.nan_to_num([*level, *grain, *correlation, *sides]), dtype=np.float64)


def accuracies(real: Array, simulated: Array, *, shuffled: int | None = None) -> dict[str, float]:
    """Train on one half of the beams, test on the other, and the reverse; return the mean accuracy of each group.

    Args:
        real: levels ``(frames, bins, beams)`` [dB].
        simulated: likewise.
        shuffled: seed of a permutation of the labels in training, a control that should give 0.5; default: none.
    """
    half = real.shape[2] // 2
    sides = [slice(half), slice(half, 2 * half)]
    table = [[np.stack([*map(features, patches(one[:, :, side]))]) for one in (real, simulated)] for side in sides]
    return {name: _accuracy(table, columns, shuffled) for name, columns in GROUPS.items()}


def _accuracy(table: list[list[Array]], columns: slice, shuffled: int | None) -> float:
    from sklearn.linear_model import LogisticRegression
    from sklearn.metrics import balanced_accuracy_score
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    scores = []
    for train, test in (table, table[::-1]):
        samples, labels = (np.concatenate([one[:, columns] for one in side]) for side in (train, test)), []
        for side in (train, test):
            labels.append(np.repeat([0, 1], [len(one) for one in side]))
        training, tested = samples
        if shuffled is not None:
            labels[0] = np.random.default_rng(shuffled).permutation(labels[0])
        model = make_pipeline(StandardScaler(), LogisticRegression(C=STRENGTH, class_weight="balanced", max_iter=1000))
        model.fit(training, labels[0])
        scores.append(balanced_accuracy_score(labels[1], model.predict(tested)))
    return float(np.mean(scores))


def control_accuracies(real: Array, simulated: Array) -> Mapping[str, float]:
    """Return the accuracies of two controls that should be near 0.5: shuffled labels, and real frames against real ones."""
    shuffled = np.mean([accuracies(real, simulated, shuffled=seed)["all"] for seed in range(4)])
    return {"shuffled": float(shuffled), "real against real": accuracies(real[::2], real[1::2])["all"]}
