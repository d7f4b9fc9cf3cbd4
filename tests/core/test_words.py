"""The words of the glossary (docs/conventions.md) are those of the code, and old ones are gone."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
GLOSSARY = (ROOT / "docs/conventions.md").read_text(encoding="utf-8").partition("## Glossary")[2]
ROWS = [
    [cell.strip() for cell in line.strip("|").split(" | ")]
    for line in GLOSSARY.splitlines()
    if line.startswith("| ") and not line.startswith("| word ")
]
TEXTS = [
    path
    for folder in ("refine_addon", "docs", "tests", "benchmarks", ".ci")
    for path in (ROOT / folder).rglob("*")
    if path.suffix in {".py", ".md"} and path != Path(__file__)
] + [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "Makefile", "pyproject.toml")]
OLD = {
    "ray": ("line of sight", "lines of sight", "sight_line", "sightline", "sight line"),
    "hit": ("what they meet", "what it meets", "what lines meet", "what is met"),
    "ray sample": ("sights",),
    "scoring rays": ("ranking lines",),
    "depth complexity": ("crowding",),
    "validation views": ("judges", "view that judge", "views that judge"),
    "nearest kept hit": (" heir", "_heir", "taken_over"),
    "removal rounds": ("thinning",),
}
"""New word -> the old ones, in lower case."""


@cache
def texts():
    """Return all that people write here, in lower case."""
    return {path: path.read_text("utf-8").lower() for path in TEXTS}


def test_the_glossary_is_sorted_and_has_each_word_once():
    """As readers look for them."""
    words = [word.lower() for word, _, _ in ROWS]

    assert len(words) > 1
    assert words == sorted(set(words))


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_each_word_has_a_meaning_and_a_place_in_code(row):
    """That the place exists, `test_documents` says."""
    _, meaning, places = row

    assert meaning
    assert re.search(r"`[\w./-]+(?:\.py|/)(?:::\w+)?`", places)


@pytest.mark.parametrize("word", OLD)
def test_no_old_word_is_left(word):
    """Each was a private name of what the field has a word for."""
    found = [
        f"{path.relative_to(ROOT)}: {old!r}"
        for path, text in texts().items()
        for old in OLD[word]
        if old in text
    ]

    assert found == []
