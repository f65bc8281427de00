"""Count the words that names, messages, comments and documents avoid, and list those outside their allowed places.

    python benchmarks/glossary.py [--house FOLDER] [--list WORD] [--quick]

Names are split at underscores and capitals: `WORDS` are avoided in any part of a name, `ALONE` as a whole name, `PROSE` in
docstrings, comments, messages and Markdown. `ALLOWED` has the places where such a word is the right one. The script prints
one row for each word and ends with code 1 if a word is outside its places. `--list` prints where a word occurs. `--quick`
does the same; the whole run takes seconds.
"""

from __future__ import annotations

import argparse
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

DOCUMENTS = ("*.md", "docs/**/*.md", "benchmarks/*.md")
CODE = ("mitsonar", "plugins", "scenes", "benchmarks", "docs", "tests")

WORDS = {
    **dict.fromkeys(("told", "tells", "said"), "given, reported, stated"),
    "asked": "requested",
    "ways": "paths, directions",
    "heard": "received, at_frequency_of",
    "honest": "inflated",
    "alike": "correlated, similar",
    "believed": "valid",
    "stands": "is, assumed",
    "beside": "adjacent, neighbours",
}
"""Avoided in any part of a name, with what to write instead."""

ALONE = {
    **dict.fromkeys(("found", "wanted", "kept", "own", "made", "held"), "the noun: what was found, wanted, kept"),
    "now": "current, time_s",
    "at": "index, position",
    "pull": "jacobian, force",
    "Made": "Report",
}
"""Avoided as a whole name, with or without a leading underscore."""

PROSE = ("told", "tells", "said", "asked", "ways", "heard", "honest", "alike", "believed", "stands")

DISK = "a key on disk, which older files have"
METHOD = "a method that reads as English: path.at(time_s)"
TESTS = "names of tests are sentences; their values are counted, not refused"
ALLOWED: dict[tuple[str, str], str] = {
    **{("asked", place): DISK for place in ("mitsonar/io/runs.py", "mitsonar/cli/live.py", "docs/reference/files.md")},
    **{("asked", place): DISK for place in ("benchmarks/reproduce/", "benchmarks/reproduced.py")},
    **{("told", place): DISK for place in ("mitsonar/estimation/compare.py", "mitsonar/training/evaluate.py")},
    **{("believed", place): DISK for place in ("mitsonar/estimation/height.py", "mitsonar/mapping/odometry_run.py")},
    **{("believed", place): DISK for place in ("mitsonar/motion/errors.py", "benchmarks/bench_")},
    **{("found", place): DISK for place in ("mitsonar/records/soundings.py", "mitsonar/plotting/figures.py")},
    ("found", "mitsonar/simulation/instrument_runs.py"): DISK,
    **{("said", place): DISK for place in ("benchmarks/gpu/run.py",)},
    ("at", ""): METHOD,
    ("ways", "CHANGELOG.md"): "the old name of an attribute",
    **{(word, "tests/"): TESTS for word in (*WORDS, *ALONE)},
}
"""Word and start of a path (a file or a folder), with the reason."""


class Use(NamedTuple):
    """A word in a place: in a name, or in prose."""

    word: str
    path: str
    line: int
    text: str


def main() -> None:
    """Print the counts; end with code 1 if a word is outside its allowed places."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--house", type=Path, default=Path(__file__).resolve().parents[1], help="a checkout of mitsonar")
    parser.add_argument("--list", help="print where this word occurs")
    parser.add_argument("--quick", action="store_true", help="the same")
    arguments = parser.parse_args()
    uses = list(uses_in(arguments.house))
    if arguments.list:
        print("\n".join(f"{use.path}:{use.line}: {use.text}" for use in uses if use.word == arguments.list))
        return
    outside = [use for use in uses if not allowed(use)]
    rooms = [(name, Counter(use.word for use in uses if use.path.split("/")[0] == name)) for name in CODE]
    print(f"| word | {' | '.join(name for name, _ in rooms)} | other pages | not allowed |")
    print("|---" * (len(rooms) + 3) + "|")
    for word in dict.fromkeys([*WORDS, *ALONE]):
        counts = [count[word] for _, count in rooms]
        pages = sum(use.word == word for use in uses) - sum(counts)
        print(f"| {word} | {' | '.join(map(str, counts))} | {pages} | {sum(use.word == word for use in outside)} |")
    for use in outside:
        print(f"{use.path}:{use.line}: {use.word} in {use.text!r}", file=sys.stderr)
    sys.exit(1 if outside else 0)


def allowed(use: Use) -> bool:
    """Return whether a word is in one of its allowed places."""
    return any(use.word == word and use.path.startswith(place) for word, place in ALLOWED)


def uses_in(house: Path) -> Iterator[Use]:
    """Yield each use of an avoided word in code and documents of a checkout."""
    for folder in CODE:
        for path in sorted((house / folder).rglob("*.py")):
            if path.resolve() == path and path.name not in ("glossary.py",):
                yield from uses_in_code(path, path.relative_to(house).as_posix())
    for pattern in DOCUMENTS:
        for path in sorted(house.glob(pattern)):
            for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
                yield from uses_in_prose(line, path.relative_to(house).as_posix(), number)


def uses_in_code(path: Path, name: str) -> Iterator[Use]:
    """Yield the uses in names, strings and comments of one file."""
    with path.open("rb") as file:
        for token in tokenize.tokenize(file.readline):
            if token.type == tokenize.NAME:
                parts = re.sub(r"([a-z])([A-Z])", r"\1_\2", token.string).lower().split("_")
                avoided = dict.fromkeys(word for word in parts if word in WORDS)
                if token.string.strip("_") in ALONE:
                    avoided[token.string.strip("_")] = None
                yield from (Use(word, name, token.start[0], token.string) for word in avoided)
            elif token.type in (tokenize.STRING, tokenize.COMMENT):
                for offset, line in enumerate(token.string.splitlines()):
                    yield from uses_in_prose(line, name, token.start[0] + offset)


def uses_in_prose(line: str, name: str, number: int) -> Iterator[Use]:
    """Yield the uses in one line of prose."""
    for word in re.findall(r"[a-z]+", line.lower()):
        if word in PROSE:
            yield Use(word, name, number, line.strip()[:100])


if __name__ == "__main__":
    main()
