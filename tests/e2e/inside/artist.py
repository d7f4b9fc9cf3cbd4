"""An artist's walk in one window, from dropping the zip to the saved scene; then another's."""

from __future__ import annotations

import bpy
import extension
from hand import Hand, at_work, mask, price, until

NAME = "point_cloud"
AROUND = (0.42, 0.33), (0.6, 0.33), (0.6, 0.6), (0.42, 0.6)
"""Where a lasso goes over the view, as shares of its width and height."""

FOUND = {}
"""What there was after each step."""


def main(pictures, blend="", archive="", cloud="", cameras="", asset=""):
    """Drop ``archive``, ``cloud`` and ``cameras`` and save ``blend``, or export ``asset``."""
    yield 1.0
    hand = Hand(pictures)
    if asset:
        FOUND["enabled"] = extension.is_enabled()  # by the preferences of the window before
        yield from seen(hand, "20-reopened")
        yield from hand.open_tab()
        yield from hand.picture("21-panel", 1)
        FOUND["numbers"] = hand.numbers()
        hand.call(bpy.ops.refine.export_ply, filepath=asset)
        return FOUND
    yield from install(hand, archive)
    yield from bring_in(hand, cloud, cameras)
    yield from score(hand)
    yield from select(hand)
    yield from crop(hand)
    yield from apply(hand)
    hand.call(bpy.ops.wm.save_as_mainfile, filepath=blend)
    return FOUND


def seen(hand, name):
    """Take two pictures: one of the screen, and one of nothing but splats to be compared."""
    yield from hand.settle()
    yield from hand.picture(name, 1)
    overlay, space = hand.space.overlay, hand.space
    before = overlay.show_overlays, space.show_gizmo
    overlay.show_overlays = space.show_gizmo = False
    yield from hand.shown(f"only-{name}")
    overlay.show_overlays, space.show_gizmo = before
    FOUND[name] = scene()


def drop(hand, path):
    """Drop a file on the view, as the window manager tells Blender."""
    yield from hand.over()
    folder, _, name = path.rpartition("/")
    how = {"directory": f"{folder}/", "files": [{"name": name}]}
    hand.call(bpy.ops.wm.drop_import_file, "INVOKE_DEFAULT", **how)
    yield 0.5


def install(hand, archive):
    """Drop the zip and confirm; delete the cube that would stand in the room."""
    yield from hand.press("ESC")  # the splash screen
    yield from hand.over()
    hand.call(bpy.ops.extensions.package_install_files, "INVOKE_DEFAULT", url=archive)
    yield from hand.picture("01-zip", 1)
    yield from hand.press("RET")
    yield from until(extension.is_enabled, "it is installed")
    yield 0.5
    yield from hand.over()
    yield from hand.press("DEL")
    yield 0.5
    yield from hand.press("RET")
    yield from hand.open_tab()
    yield from hand.picture("02-installed", 1)
    FOUND["cube"] = "Cube" in bpy.data.objects


def bring_in(hand, cloud, cameras):
    """Drop splats, which bring the cameras beside them; adjust that; drop cameras; look by one."""
    yield from drop(hand, cloud)
    yield from hand.press("S")  # of the two that import such files, ours
    yield 0.5
    yield from hand.picture("03-dialog", 1)
    yield from hand.press("RET")
    yield from until(lambda: not at_work() and NAME in bpy.data.objects, "it is imported")
    yield from hand.settle()
    yield from hand.picture("04-imported", 1)
    FOUND["imported"] = scene()
    for upright in (True, False):
        yield from adjust(hand, upright)
        FOUND[f"upright {upright}"] = scene()
    yield from drop(hand, cameras)
    yield from hand.press("RET")
    wanted = FOUND["imported"]["cameras"] + 1
    yield from until(lambda: not at_work() and scene()["cameras"] >= wanted, "they are imported")
    yield 0.5
    FOUND["dropped"] = scene(), bpy.context.window_manager.operators[-1].bl_idname
    yield from hand.undo()
    yield from hand.over()
    yield from hand.press("NUMPAD_0")
    space = hand.space
    space.shading.background_type, space.shading.background_color = "VIEWPORT", (0, 0, 0)
    bpy.context.scene.camera.data.show_passepartout = False
    yield from seen(hand, "05-camera")
    FOUND["numbers"] = hand.numbers()


def adjust(hand, upright):
    """Have the last operation done again, otherwise, as its box (F9) does."""
    bpy.context.window_manager.operators[-1].properties.upright = upright
    hand.call(bpy.ops.ed.undo_redo, "EXEC_DEFAULT", True, kind="UI")  # with a step of its own
    yield 0.5


def score(hand):
    """Score, read the price, and look at the heat map."""
    yield from hand.click("refine.score(")
    yield 2.0
    yield from hand.picture("06-scoring", 1)
    yield from until(lambda: not at_work(), "there are scores")
    yield from seen(hand, "07-scored")
    yield from hand.scroll(down=True)
    yield from until(lambda: price(splats())["sentence"], "there is a price")
    yield from hand.picture("08-priced", 1)
    FOUND["priced"] = price(splats())
    yield from hand.scroll(down=False)
    yield from hand.click("refine.view(mode='HEAT'")
    yield from hand.settle()
    yield from hand.picture("09-heat", 1)
    yield from hand.click("refine.view(mode='SCENE'")


def select(hand):
    """Select with the lasso, delete what is selected, and take that back."""
    lasso = yield from hand.drag("lasso", *AROUND)
    FOUND["lasso"] = int(lasso.sum())
    yield from hand.settle()
    yield from hand.picture("10-selected", 1)
    yield from hand.press("DEL")
    yield 0.5
    yield from hand.press("A", alt=True)
    yield from seen(hand, "11-deleted")
    yield from hand.undo()
    yield from hand.undo()
    yield from until(lambda: scene()["splats"] > FOUND["11-deleted"]["splats"], "it is undone")
    FOUND["selected again"] = int(mask(splats()).sum())
    yield from hand.press("A", alt=True)
    yield from seen(hand, "12-back")


def crop(hand):
    """Keep what is in a box that is made smaller by hand, and delete the rest now."""
    hand.do(bpy.ops.wm.tool_set_by_id, name="builtin.select_box")
    hand.do(bpy.ops.refine.add_volume, role="KEEP", shape="BOX")
    yield from hand.over()
    yield from hand.press("S")
    for key, text in (("ZERO", "0"), ("PERIOD", "."), ("NINE", "9")):
        yield from hand.press(key, unicode=text)
    yield from hand.press("RET")
    yield 1.0
    for number, panel in ((13, "protect"), (14, "select")):
        x, _ = yield from hand.over()
        hand.call(bpy.ops.wm.call_panel, name=f"REFINE_PT_{panel}", keep_open=True)
        yield from hand.settle()
        yield from hand.picture(f"{number}-{panel}", 1)
        yield from hand.move(x, hand.region().y + 20)  # out of the panel
        yield from hand.press("ESC")
        yield 0.5
    hand.do(bpy.ops.refine.delete, what="VOLUMES")
    for item in bpy.context.scene.refine.volumes:
        item.object.hide_set(True)
    yield from seen(hand, "15-cropped")


def apply(hand):
    """Score again, apply, undo and redo."""
    yield from hand.click("refine.score(")
    yield 1.0
    yield from until(lambda: not at_work(), "there are scores")
    yield from hand.scroll(down=True)
    yield from hand.picture("16-scored", 1)
    before, drawn = FOUND["15-cropped"]["splats"], hand.draw.drawn(hand.region())
    yield from hand.click("refine.apply(")
    yield from until(lambda: not at_work() and scene()["splats"] < before, "it is applied")
    yield from seen(hand, "17-applied")
    yield from hand.undo()
    yield from until(lambda: hand.draw.drawn(hand.region()) == drawn, "all are drawn again")
    yield from seen(hand, "18-undone")
    yield from hand.undo(redo=True)
    yield from until(lambda: scene()["splats"] < before, "it is redone")
    yield from seen(hand, "19-redone")


def splats():
    """Return the object, which undo replaces."""
    return bpy.data.objects[NAME]


def scene():
    """Return what there is."""
    render = bpy.context.scene.render
    return {
        "splats": len(splats().data.vertices),
        "cameras": sum(obj.type == "CAMERA" for obj in bpy.context.scene.objects),
        "turned": round(splats().matrix_world[2][1]) == -1,
        "size": [render.resolution_x, render.resolution_y],
    }
