"""Estimates of a comparison on disk, written as they come, so that an interrupted comparison resumes."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.estimation.benchmark import Answers
from mitsonar.estimation.benchmark_tables import table_lines
from mitsonar.estimation.estimator import AnyEstimator, PlainTable
from mitsonar.io.files import read_json, read_npz, write_json, write_whole
from mitsonar.io.runs import RunDirectory, RunKind

__all__ = ["COMPARISON", "AnswerFolder", "kept_answers"]

Array = NDArray[np.float64]

COMPARISON = RunKind(
    "comparison",
    outputs=("answers-*.npz", "limit-*.json", "table.md", "table.json"),
    notes={},
    packages=("mitsonar", "numpy", "opencv-python-headless", "torch"),
    deciding=("mitsonar",),
    replaced=False,
)


class AnswerFolder:
    """The store of a comparison without a folder: it keeps nothing."""

    def load(self, level: str, variation: str, methods: Mapping[str, AnyEstimator], count: int) -> dict[str, Answers] | None:
        """Return the estimates of an earlier run of ``count`` pairs; None where there are none."""
        return None

    def keep(self, level: str, variation: str, answers: dict[str, Answers]) -> None:
        """Store all estimates made so far."""

    def load_bounds(self, level: str, count: int) -> dict[str, Array] | None:
        """Return the bounds of an earlier run; None where there are none."""
        return None

    def keep_bounds(self, level: str, count: int, bounds: dict[str, Array]) -> None:
        """Store bounds."""

    def finish(self, report: PlainTable) -> None:
        """Write the tables."""


class AnswersOnDisk(AnswerFolder):
    """A folder of estimates.

    Args:
        run: the folder.
    """

    def __init__(self, run: RunDirectory) -> None:
        self.run = run

    def _path(self, name: str, ending: str) -> Path:
        return self.run.path / (re.sub(r"[^\w.-]+", "-", name.replace("%", "percent")) + ending)

    def load(self, level: str, variation: str, methods: Mapping[str, AnyEstimator], count: int) -> dict[str, Answers] | None:
        """Return the estimates of an earlier run of ``count`` pairs; None where there are none.

        Raises:
            MitsonarError: the file is damaged.
        """
        path = self._path(f"answers {level} {variation}", ".npz")
        if not path.exists():
            return None
        try:
            table = read_npz(path)
            found = {name: Answers.from_arrays(table, name) for name in methods}
            if any(len(values) != count for one in found.values() for values in vars(one).values()):
                raise ValueError("it holds other numbers of pairs")
            return found
        except Exception as error:  # a damaged zip may raise anything
            raise MitsonarError(f"{path} is damaged ({error}): remove it, it is made again") from None

    def keep(self, level: str, variation: str, answers: dict[str, Answers]) -> None:
        """Store all estimates made so far."""
        buffer = io.BytesIO()
        arrays: dict[str, NDArray[np.generic]] = {}
        for name, one in answers.items():
            arrays |= one.arrays(name)
        np.savez(buffer, **arrays)  # type: ignore[arg-type]
        write_whole(self._path(f"answers {level} {variation}", ".npz"), buffer.getvalue())

    def load_bounds(self, level: str, count: int) -> dict[str, Array] | None:
        """Return the bounds of an earlier run; None where there are none.

        Raises:
            MitsonarError: the file is damaged.
        """
        path = self._path(f"limit {level} {count}", ".json")
        if not path.exists():
            return None
        found = read_json(path)
        try:
            bounds = {law: np.array(std, dtype=float) for law, std in found.items()}
            if not bounds or any(std.shape != (3,) for std in bounds.values()):
                raise ValueError("a bound is three numbers")
        except (AttributeError, ValueError, TypeError) as error:
            raise MitsonarError(f"{path} is damaged ({error}): remove it, it is made again") from None
        return bounds

    def keep_bounds(self, level: str, count: int, bounds: dict[str, Array]) -> None:
        """Store bounds."""
        write_json(self._path(f"limit {level} {count}", ".json"), {law: std.tolist() for law, std in bounds.items()})

    def finish(self, report: PlainTable) -> None:
        """Write the tables."""
        lines = [line for table in report["tables"] for line in table_lines(table)]
        write_whole(self.run.path / "table.md", ("\n".join(lines) + "\n").encode())
        write_json(self.run.path / "table.json", report)
        self.run.finish()


def kept_answers(out: str | Path | None, settings: PlainTable) -> AnswerFolder:
    """Open the store of a comparison: a folder, new or to be resumed, or none.

    Raises:
        MitsonarError: the folder holds something else, or another comparison.
    """
    if out is None:
        return AnswerFolder()
    run = RunDirectory.begin(out, COMPARISON, settings, resume=True)
    run.start()
    return AnswersOnDisk(run)
