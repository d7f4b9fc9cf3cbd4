"""What is drawn of splats that change while they are drawn."""

from concurrent.futures import Future

import bpy
import numpy as np


class Packing:
    """The thread that packs splats, by hand."""

    def __init__(self):
        self.waiting = []

    def submit(self, *call):
        self.waiting.append((Future(), call))
        return self.waiting[-1][0]

    def run(self):
        for future, (work, *values) in self.waiting:
            future.set_result(work(*values))
        self.waiting.clear()


def test_splats_are_drawn_as_they_are_packed(addon, few, monkeypatch):
    """100 splats deleted: the old ones are drawn meanwhile, with as many ranks as they are.
    New ranks of the same splats are drawn anew, or *Heat* would not be coloured again."""
    monkeypatch.setattr(addon.viewport.content.shader, "texture", lambda texels, *_: texels)
    content, packing = addon.viewport.content.Content(), Packing()  # there is no graphics card
    content.pool = packing

    def drawn():
        content.has_changed()
        key = ((few.session_uid,), few.data.session_uid)
        places = addon.objects.instances.placings(bpy.context.evaluated_depsgraph_get())
        return content.atlas.slots[key] if content.update(places) else None

    bpy.ops.refine.score()
    assert drawn() is None
    packing.run()
    slot = drawn()
    ranks, marked = slot.held.marks.ranks, slot.held.marked
    keep = np.arange(3976) >= 100
    stay = keep[slot.packed.vertices]
    assert drawn().held.marked == marked
    addon.objects.splat_group.delete_splats(addon.mesh.layout.check(few), keep)
    slot = drawn()
    assert slot.packed.vertices.max() == 3975
    np.testing.assert_array_equal(slot.held.marks.ranks, ranks)
    packing.run()
    slot = drawn()
    assert slot.packed.vertices.max() == 3875
    np.testing.assert_array_equal(slot.held.marks.ranks, ranks[stay])

    marked, values = slot.held.marked, few.data.attributes[addon.mesh.scores.RANK].data
    values[0].value = 1.0 - values[0].value
    assert drawn().held.marked == marked + 1

    for row in (0, 1):  # selected splats are tinted, but not once graded
        addon.mesh.selection.select(few, np.arange(3876) == row)
        drawn()
        assert content.selection().any()
        content.untint()
        drawn()
        assert not content.selection().any()
