"""The words of the glossary (docs/conventions.md) are those of the code, and old ones are gone."""

from __future__ import annotations

import re
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
    "ray": r"lines? of sight|sight[_ ]?lines?|ranking lines",
    "hit": r"what (is|they|it|lines|a line) meets?\b|what is met\b",
    "ray sample": r"\bsights\b",
    "depth complexity": r"\bcrowding\b",
    "validation views": r"\bjudges\b|\bviews? (that|which) judges?\b",
    "nearest kept hit": r"\bheirs?\b|taken_over",
    "removal rounds": r"\bthinning\b",
}
"""New word -> pattern of the old one."""


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
        f"{path.relative_to(ROOT)}: {match[0]!r}"
        for path in TEXTS
        for match in re.finditer(OLD[word], path.read_text("utf-8"), re.IGNORECASE)
    ]

    assert found == []
