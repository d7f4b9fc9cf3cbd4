"""The interface in another language, in real Blenders: the module has none."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from blenders import Binary


def test_blender_shows_german_while_the_extension_is_enabled(binary: Binary):
    found = binary.step("german")

    assert found["with"] == ["Aufnehmen", "Schwebende finden", "Wie viele Splats bleiben"]
    assert found["without"] == ["Absorb", "Find Floaters", "How many splats stay"]
