"""The main job on the committed room, in background Blender: ``make demo``.

Imports the splats and the 63 cameras that trained them as objects, scores, prunes half, exports,
all by the operators behind the panel's buttons. Leaves in ``out/``: the pruned PLY, a report, and
what one of the cameras sees before, after, and as a heat map. ``docs/demo.py 200`` makes larger
pictures.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

PROJECT = Path(__file__).resolve().parent.parent
ROOM = PROJECT / "tests/data/room_small"
OUT = PROJECT / "out"
from collections.abc import Iterator

CAMERA = "018"
PERCENTAGE = int(sys.argv[1]) if len(sys.argv) > 1 else 75
"""Size of the pictures; those of the README are 200 % of what the cameras saw."""

# Before bpy is imported, so that nobody's own Blender settings are read or written.
RESOURCES = tempfile.mkdtemp(prefix="refine-demo-")
os.environ["BLENDER_USER_RESOURCES"] = RESOURCES
sys.path.insert(0, str(PROJECT))

import bpy
import numpy as np

import refine_addon
from refine_addon.core.splats import SH_C0
from refine_addon.mesh import scores as mesh_scores
from refine_addon.mesh.attributes import read_attribute, write_attribute
from refine_addon.ui.render_operators import IMAGE
from refine_addon.viewport.arrays import ramp


def training_cameras(path: Path) -> int:
    """Write the cameras that trained the room to `path`; return how many."""
    names = json.loads((ROOM / "split.json").read_text())["train"]
    cameras = json.loads((ROOM / "cameras.json").read_text())
    chosen = [camera for camera in cameras if camera["img_name"] in names]
    path.write_text(json.dumps(chosen))
    return len(chosen)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep what Blender prints while rendering off the terminal; it bypasses Python's stdout."""
    sys.stdout.flush()
    kept = os.dup(1)
    with Path(os.devnull).open("w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def picture(name: str) -> Path:
    """Render what the camera sees of the splats into ``out/``; return the file."""
    with quiet():
        bpy.ops.refine.render()
    bpy.data.images[IMAGE].save(filepath=str(OUT / name))
    return OUT / name


def heat_map(name: str) -> Path:
    """Do the same with each splat in the colour of its rank."""
    obj, own = bpy.context.object, bpy.context.object.data
    obj.data = own.copy()
    colors = ramp()[(255 * read_attribute(obj.data, "refine_rank") + 0.5).astype(np.uint8)]
    for channel in range(3):
        coefficients = (colors[:, channel] - 0.5) / SH_C0
        write_attribute(obj.data, f"f_dc_{channel}", "FLOAT", coefficients)
    for attribute in [a.name for a in obj.data.attributes if a.name.startswith("f_rest_")]:
        write_attribute(obj.data, attribute, "FLOAT", np.zeros(len(colors)))
    path = picture(name)
    obj.data = own
    return path


def side_by_side(pictures: list[Path], target: Path) -> None:
    """Join pictures of one size from left to right."""
    pixels = []
    for path in pictures:
        image = bpy.data.images.load(str(path))
        width, height = image.size
        values = np.empty(width * height * 4, np.float32)
        image.pixels.foreach_get(values)
        pixels.append(values.reshape(height, width, 4))
    joined = np.hstack(pixels)
    image = bpy.data.images.new("joined", joined.shape[1], joined.shape[0])
    image.pixels.foreach_set(joined.ravel())
    image.file_format = "JPEG"
    image.filepath_raw = str(target)
    image.save(quality=85)


def main() -> None:
    """Run the demo and say what happened."""
    start = time.perf_counter()
    OUT.mkdir(exist_ok=True)
    cameras = OUT / "training_cameras.json"
    number = training_cameras(cameras)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.refine.import_ply(filepath=str(ROOM / "point_cloud.ply"))
    splats = bpy.context.object
    before = len(splats.data.vertices)
    print(f"imported {before:,} splats and {number} cameras into Blender {bpy.app.version_string}")
    bpy.ops.refine.import_cameras(filepath=str(cameras), set_resolution=True)
    scene = bpy.context.scene
    scene.camera = bpy.data.objects[CAMERA]
    scene.render.resolution_percentage = PERCENTAGE

    scored = time.perf_counter()
    bpy.ops.refine.score()
    scored = time.perf_counter() - scored
    record = mesh_scores.record(splats.data)
    print(f"scored by {record['views_used']} views in {scored:.2f} s")
    pictures = [picture("before.png"), heat_map("heat_map.png")]

    scene.refine.ratio = 0.5
    bpy.ops.refine.apply()
    after = len(splats.data.vertices)
    pictures.append(picture("after.png"))
    bpy.ops.refine.export_ply(filepath=str(OUT / "room_half.ply"), overwrite=True)
    before_after = [pictures[0], pictures[2], pictures[1]]
    side_by_side(before_after, OUT / "demo.jpg")
    sizes = [path.stat().st_size for path in (ROOM / "point_cloud.ply", OUT / "room_half.ply")]
    print(f"kept {after:,} of {before:,} splats: {sizes[0] / 1e6:.1f} -> {sizes[1] / 1e6:.1f} MB")

    report = {
        "blender": bpy.app.version_string,
        "splats": {"before": before, "kept": after, "removed": before - after},
        "bytes": {"before": sizes[0], "after": sizes[1]},
        "scores": record,
        "seconds": {"score": scored, "all": time.perf_counter() - start},
        "pictures": [path.name for path in pictures],
    }
    (OUT / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    print(f"all of it took {report['seconds']['all']:.1f} s; see {OUT}:")
    print("  " + ", ".join(sorted(path.name for path in OUT.iterdir())))


if __name__ == "__main__":
    refine_addon.register()
    try:
        main()
    finally:
        refine_addon.unregister()
        shutil.rmtree(RESOURCES, ignore_errors=True)
