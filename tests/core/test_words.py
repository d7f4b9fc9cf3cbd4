"""The words of the glossary (docs/conventions.md) are those of the code."""

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
