"""The page of results follows from its JSON files, and a malformed file is answered with a sentence."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from mitsonar.errors import MitsonarError

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

import tables


def test_the_page_is_that_of_the_results() -> None:
    assert tables.page(tables.RESULTS) == tables.PAGE.read_text(encoding="utf-8")


ONE = {
    "title": "Some results",
    "anchor": "some-results",
    **{"note": "What.", "machine": "AMD EPYC", "date": "2026-11-26", "command": "python x.py"},
    "columns": ["a", "b"],
    "rows": [["1", "2"]],
}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"anchor": "other"}, "the anchor of 'Some results' is 'some-results'"),
        ({"note": ""}, "must have a text under 'note'"),
        ({"rows": [["1"]]}, "row 1 must be 2 texts"),
        ({"rows": []}, "at least one row"),
        ({"columns": None}, "'columns' must be texts"),
        ({"tables": []}, "at least one table"),
    ],
)
def test_malformed_results_are_refused(change: dict[str, object], words: str, tmp_path: Path) -> None:
    path = tmp_path / "one.json"
    path.write_text(json.dumps(ONE))
    assert "| 1 | 2 |" in tables.section(path)
    path.write_text(json.dumps(ONE | change))
    with pytest.raises(MitsonarError, match=words):
        tables.section(path)
