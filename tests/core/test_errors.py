"""Messages: one line, and nothing in it that a terminal would obey."""

from __future__ import annotations

import os

import pytest

from refine_addon.core import RefineError, read_cameras, read_ply
from refine_addon.core.whole_file import refuse_existing

ODD = "a\x1b[2Jb\nc\u202ed"
SHOWN = r"a\x1b[2Jb\nc\u202ed"


@pytest.mark.skipif(os.name != "posix", reason="names hold no such characters elsewhere")
@pytest.mark.parametrize("use", [read_ply, read_cameras])
@pytest.mark.parametrize("there", [False, True])
def test_control_characters_of_a_name_are_shown_and_not_sent(tmp_path, use, there):
    """The first clears a terminal, the second starts a line, the third turns the reading order."""
    if there:
        (tmp_path / ODD).write_bytes(b"nothing of ours")

    with pytest.raises(RefineError) as caught:
        use(tmp_path / ODD)

    assert str(caught.value).startswith(f"{tmp_path / SHOWN}: ")
    assert str(caught.value).isprintable()


def test_an_output_is_shown_the_same_way(tmp_path):
    with pytest.raises(RefineError) as caught:
        refuse_existing(tmp_path / ODD / "out.ply", overwrite=False)

    assert str(tmp_path / SHOWN / "out.ply") in str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("text", ["Müller – 部屋 🎈", "C:\\new\\table", "50\xa0% ", ""])
def test_what_can_be_read_stays_as_it_is(text):
    """Other scripts, backslashes and the spaces of typographers are no control characters."""
    assert str(RefineError(text)) == text


def test_half_a_surrogate_pair_can_be_printed():
    """Python keeps bytes of a name that are no text as these; no encoding writes them."""
    assert str(RefineError("a\udcffb")) == r"a\udcffb"
