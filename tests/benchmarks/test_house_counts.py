"""The paths through the house stay as short as they are."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

import glossary
import trace_house

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.thorough
def test_a_command_enters_few_files_and_runs_few_lines() -> None:
    traced = dict(trace_house.paths(ROOT, len(trace_house.BUDGET)))
    assert traced.keys() == trace_house.BUDGET.keys()
    over = {
        name: (len(lines), sum(lines.values())) for name, lines in traced.items() if trace_house.exceeds_budget(name, lines)
    }
    assert not over, f"files and lines over their budget and a tenth: {over}"


def test_a_path_over_its_budget_is_noticed() -> None:
    files, lines = trace_house.BUDGET["XML to frames"]
    within = {f"{number}.py": lines // files for number in range(files)}
    assert not trace_house.exceeds_budget("XML to frames", within)
    assert trace_house.exceeds_budget("XML to frames", within | {f"{number}.py": 0 for number in range(2 * files)})
    assert trace_house.exceeds_budget("XML to frames", within | {"0.py": lines})


@pytest.mark.thorough
def test_words_that_are_avoided_stay_in_their_places() -> None:
    outside = [use for use in glossary.uses_in(ROOT) if not glossary.allowed(use)]
    assert not outside, outside[:20]


def test_a_word_of_the_dialect_is_found(tmp_path: Path) -> None:
    (tmp_path / "mitsonar").mkdir()
    (tmp_path / "mitsonar" / "new.py").write_text('def format_snr(told):\n    """It tells."""\n    found = told\n')
    assert [use.word for use in glossary.uses_in(tmp_path)] == ["told", "tells", "found", "told"]
