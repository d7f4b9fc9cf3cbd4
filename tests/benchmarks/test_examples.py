"""Examples in the docstrings of the benchmarks."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

pytest.importorskip("numba")
pytest.importorskip("skimage")

from tests.examples import modules_with_examples

PACKAGE = Path(__file__).parents[2] / "benchmarks"


@pytest.mark.parametrize("name", modules_with_examples(PACKAGE, "benchmarks"))
def test_examples_in_docstrings_give_what_they_promise(name):
    """To the last digit that is written."""
    result = doctest.testmod(importlib.import_module(name))

    assert result.attempted > 0
    assert result.failed == 0
