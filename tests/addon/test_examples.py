"""Examples in the docstrings of what needs Blender."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

from tests.examples import modules_with_examples

PACKAGE = Path(__file__).parents[2] / "refine_addon"


@pytest.mark.parametrize(
    "name", [n for n in modules_with_examples(PACKAGE, "") if not n.startswith(".core.")]
)
def test_examples_in_docstrings_give_what_they_promise(name, addon):
    """To the last digit that is written."""
    result = doctest.testmod(importlib.import_module(name, addon.__name__))

    assert result.attempted > 0
    assert result.failed == 0
