"""What is drawn of splats that change while they are drawn."""

from __future__ import annotations

from concurrent.futures import Future

import bpy
import numpy as np
import pytest


class Packing:
    """The thread that packs splats, by hand."""

    def __init__(self) -> None:
        self.waiting = []

    def submit(self, *call):
        """Take a call; it is not run before `run`."""
        self.waiting.append((Future(), call))
        return self.waiting[-1][0]

    def run(self):
        """Do what was taken."""
        for future, (work, *values) in self.waiting:
            future.set_result(work(*values))
        self.waiting.clear()


@pytest.fixture
def packing():
    """Give the thread, for the place of the one there is."""
    return Packing()


@pytest.fixture
def content(addon, packing, monkeypatch):
    """Give what views draw from, without textures: there is no graphics card in the background."""
    monkeypatch.setattr(addon.viewport.content.shader, "texture", lambda *_: None)
    content = addon.viewport.content.Content()
    content.pool = packing
    return content


def drawn(addon, content, obj):
    """Return what is drawn of an object, looked at again."""
    content.has_changed()
    key = (obj.session_uid, obj.data.session_uid)
    found = content.update(addon.viewport.content.placings([obj]), lambda: {key})
    return content.atlas.slots[key] if found else None


@pytest.mark.usefixtures("room_cameras")
def test_ranks_wait_until_the_splats_that_they_belong_to_are_packed(addon, room, content, packing):
    """1,000 splats deleted: the old ones are drawn meanwhile, with as many ranks as they are."""
    bpy.ops.refine.score()
    assert drawn(addon, content, room) is None
    packing.run()
    slot = drawn(addon, content, room)
    count, ranks = len(room.data.vertices), slot.held.marks.ranks
    keep = np.ones(count, np.bool_)
    keep[:1000] = False
    stay = keep[slot.packed.vertices]

    addon.objects.splat_group.delete_splats(addon.mesh.layout.check(room), keep)

    slot = drawn(addon, content, room)
    assert slot.packed.vertices.max() == count - 1
    np.testing.assert_array_equal(slot.held.marks.ranks, ranks)
    packing.run()
    slot = drawn(addon, content, room)
    assert slot.packed.vertices.max() == count - 1001
    np.testing.assert_array_equal(slot.held.marks.ranks, ranks[stay])


@pytest.mark.usefixtures("room_cameras")
def test_new_ranks_of_the_same_splats_are_drawn_anew(addon, room, content, packing):
    """Nothing else tells a view that *Heat* is to be coloured again; the same ranks do not."""
    bpy.ops.refine.score()
    drawn(addon, content, room)
    packing.run()
    before = drawn(addon, content, room).held.scored

    assert drawn(addon, content, room).held.scored == before
    ranks = room.data.attributes[addon.mesh.scores.RANK].data
    ranks[0].value = 1.0 - ranks[0].value

    assert drawn(addon, content, room).held.scored == before + 1


def test_splats_that_went_while_they_were_packed_are_not_waited_for(addon, room, content, packing):
    """As those of an import that is undone at once; a view would never be complete."""
    drawn(addon, content, room)
    assert content.pending()
    packing.run()

    content.update([], set)

    assert not content.pending()
