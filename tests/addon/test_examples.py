"""Examples in the docstrings of what needs Blender."""

import doctest
import importlib

import pytest

from tests.examples import modules_with_examples

from .conftest import ROOT

NAMES = [n for n in modules_with_examples(ROOT / "refine_addon", "") if not n.startswith(".core.")]


@pytest.mark.parametrize("name", NAMES)
def test_examples_in_docstrings_give_what_they_promise(name, addon):
    result = doctest.testmod(importlib.import_module(name, addon.__name__))

    assert result.attempted > 0
    assert result.failed == 0
