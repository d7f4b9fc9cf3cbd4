"""The pictures at the head of the README: ``python docs/showcase.py``, of the `bench` extra.

Makes a scene of splats by formulas, without training: a desk with a chess board, books, a clock
and mugs before a brick wall, each surface a grid of flat splats, coloured by a texture. Like a
capture it has what no camera sees: backs, undersides, what stands behind. 40 cameras in front of it
decide what goes; the pictures are those of one between them, before and after. Writes
``out/showcase.ply`` and its cameras, ``docs/before.jpg``, ``docs/after.jpg``, and prints what the
README says of them. The scene is in the public domain (CC0).
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageColor, ImageDraw, ImageFilter, ImageFont

PROJECT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(PROJECT))

from collections.abc import Callable

from numpy.typing import NDArray

from benchmarks.tables.million import write_cameras, write_ply
from refine_addon.core import Budget, Merge, Splats, View, ViewSet, prune
from refine_addon.core.pictures import compare
from refine_addon.core.splats import SH_C0, joined, opacity_logits

Array = NDArray[np.float64]
Texture = Callable[[Array, Array], Array]  # of u and v in 0..1, (n,) each: colours, (n, 3)

SHARE = 0.7
"""Of the splats, what goes."""

SIZE, FOCAL = (960, 640), 1050.0
"""Of the pictures, pixels."""

MIDDLE, DISTANCE = np.array([0.0, 0.05, 0.15]), 1.55
"""What the cameras look at and from how far away, metres."""

OPAQUE, FLAT, WIDE = 0.97, 0.1, 0.6
"""Opacity of a splat; its thickness and width, in distances to the next one."""

LIGHT = np.array([-0.45, -0.6, 0.66])
BRICK, MORTAR = (0.55, 0.27, 0.2), (0.72, 0.69, 0.64)


@dataclass(frozen=True, eq=False)
class Surface:
    """Splats on a surface.

    Attributes
    ----------
    points, normals : (n, 3) float64
        World, z up, metres.
    colors : (n, 3) float64
        Display-referred, lit.
    spacing : float
        Metres from one splat to the next.
    """

    points: Array
    normals: Array
    colors: Array
    spacing: float

    def splats(self) -> Splats:
        """Return them as splats without view-dependent colour."""
        count = len(self.points)
        x, y, z = self.normals.T
        quats = np.stack([1.0 + z, -y, x, np.zeros(count)], axis=1)  # from z to the normal
        quats[z < -0.999] = (0.0, 1.0, 0.0, 0.0)
        scales = np.log(np.array([WIDE, WIDE, FLAT]) * self.spacing)
        return Splats(
            means=self.points.astype(np.float32),
            log_scales=np.tile(scales, (count, 1)).astype(np.float32),
            quaternions=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
            opacity_logits=opacity_logits(np.full(count, OPAQUE)).astype(np.float32),
            sh_dc=((self.colors - 0.5) / SH_C0).astype(np.float32),
            sh_rest=np.zeros((count, 0, 3), np.float32),
        )


def lit(colors: Array, normals: Array) -> Array:
    """Return colours in the light of one lamp and the room."""
    lamp = np.maximum(normals @ (LIGHT / np.linalg.norm(LIGHT)), 0.0)
    return np.asarray(np.clip(colors * (0.62 + 0.42 * lamp)[:, None], 0.0, 1.0))


def patch(corner: Array, along: Array, up: Array, texture: Texture, spacing: float) -> Surface:
    """Return a parallelogram; its normal is ``along x up``."""
    sides = [float(np.linalg.norm(side)) for side in (along, up)]
    counts = [max(round(side / spacing), 1) for side in sides]
    steps = [(np.arange(count) + 0.5) / count for count in counts]
    u, v = (grid.ravel() for grid in np.meshgrid(*steps))
    normal = np.cross(along, up) / (sides[0] * sides[1])
    normals = np.tile(normal, (len(u), 1))
    points = corner + u[:, None] * along + v[:, None] * up
    return Surface(points, normals, lit(texture(u, v), normals), spacing)


def box(
    middle: Array,
    size: tuple[float, float, float],
    turn: float,
    texture: dict[str, Texture],
    spacing: float,
) -> list[Surface]:
    """Return the sides of a box that is turned about z, radians; `texture` by side, "" else."""
    c, s = np.cos(turn), np.sin(turn)
    x, y, z = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) * np.array(size)[:, None]
    low, high = middle - (x + y + z) / 2, middle + (x + y + z) / 2
    sides = {
        "front": (low, x, z), "right": (low + x, y, z), "back": (high - z, -x, z),
        "left": (low + y, -y, z), "top": (low + z, x, y), "bottom": (low + y, x, -y),
    }  # fmt: skip
    return [patch(*place, texture.get(side, texture[""]), spacing) for side, place in sides.items()]


def turned(
    foot: Array, profile: list[tuple[float, float]], texture: Texture, spacing: float
) -> Surface:
    """Return a body of revolution: its profile is radii over heights, joined by a smooth curve."""
    radii, heights = np.array(profile).T
    fine = np.linspace(0, len(profile) - 1, 400)
    r, z = (np.interp(fine, np.arange(len(profile)), each) for each in (radii, heights))
    r = np.convolve(np.pad(r, 10, mode="edge"), np.ones(21) / 21, "valid")
    length = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(r), np.diff(z)))])
    rows = np.linspace(0, length[-1], max(int(length[-1] / spacing), 2))
    r, z = np.interp(rows, length, r), np.interp(rows, length, z)
    dr, dz = np.gradient(r), np.gradient(z)
    counts = np.maximum((2 * np.pi * r / spacing).astype(int), 3)
    row = np.repeat(np.arange(len(r)), counts)
    first = np.cumsum(counts) - counts
    angle = 2 * np.pi * (np.arange(len(row)) - first[row] + 0.5 * (row % 2)) / counts[row]
    normals = np.stack([dz[row] * np.cos(angle), dz[row] * np.sin(angle), -dr[row]], axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    points = foot + np.stack([r[row] * np.cos(angle), r[row] * np.sin(angle), z[row]], axis=1)
    colors = texture(angle / (2 * np.pi), row / len(r))
    return Surface(points, normals, lit(colors, normals), spacing)


def plain(color: tuple[int, ...]) -> Texture:
    """Return a texture of one colour, 0 to 255."""
    return lambda u, _v: np.tile(np.array(color) / 255.0, (len(u), 1))


def drawn(picture: Image.Image) -> Texture:
    """Return a picture as a texture; v = 0 is its lowest row."""
    picture = picture.filter(ImageFilter.BoxBlur(2))  # a splat is some five pixels wide
    pixels = np.asarray(picture.convert("RGB"), np.float64)[::-1] / 255.0
    high, wide = pixels.shape[:2]
    return lambda u, v: pixels[
        np.minimum((v * high).astype(int), high - 1), np.minimum((u * wide).astype(int), wide - 1)
    ]


def wood(u: Array, v: Array) -> Array:
    """Return planks along u, with grain."""
    plank = np.floor(v * 7)
    shift = np.sin(plank * 12.9898) * 43758.5453 % 1.0
    along = u * 9 + shift * 31
    rings = np.sin(60 * (v * 7 % 1.0 - 0.5) + 3 * np.sin(along) + 9 * shift)
    fine = np.sin(260 * v + 5 * np.sin(2.3 * along))
    shade = 0.86 + 0.1 * shift + 0.07 * rings + 0.04 * fine
    shade = np.where((v * 7 % 1.0) < 0.018, 0.45, shade)
    return np.asarray(shade[:, None] * np.array([0.62, 0.43, 0.27]))


def bricks(u: Array, v: Array) -> Array:
    """Return a wall in running bond, 14 courses."""
    course = np.floor(v * 14)
    x = u * 13 + 0.5 * (course % 2)
    joint = ((v * 14 % 1.0) < 0.12) | ((x % 1.0) < 0.05)
    tone = 0.8 + 0.4 * (np.sin(np.floor(x) * 12.9898 + course * 78.233) * 43758.5453 % 1.0)
    speck = 1.0 + 0.06 * np.sin(u * 937) * np.sin(v * 811)
    stone = np.array(BRICK) * (tone * speck)[:, None]
    return np.where(joint[:, None], np.array(MORTAR), stone)


def chess(u: Array, v: Array) -> Array:
    """Return eight by eight fields in a frame."""
    i, j = np.floor((u - 0.06) / 0.11), np.floor((v - 0.06) / 0.11)
    frame = (np.minimum(i, j) < 0) | (np.maximum(i, j) > 7)
    light = ((i + j) % 2 == 1)[:, None]
    field = np.where(light, np.array([0.93, 0.87, 0.74]), np.array([0.28, 0.15, 0.1]))
    grain = 1.0 + 0.05 * np.sin(40 * v + 3 * np.sin(25 * u))
    return np.where(frame[:, None], np.array([0.4, 0.22, 0.13]), field) * grain[:, None]


def lettered(text: str, back: str, ink: str, size: tuple[int, int], height: int) -> Texture:
    """Return a texture with a word in its middle and a line at either end."""
    picture = Image.new("RGB", size, back)
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(height)
    draw.text((size[0] / 2, size[1] / 2), text, ink, font, "mm")
    for x in (0.04, 0.06, 0.94, 0.96):
        draw.line([(x * size[0], 0), (x * size[0], size[1])], ink, 3)
    return drawn(picture)


def dial() -> Texture:
    """Return the face of a clock at ten past ten."""

    def around(angle: float, radius: float) -> tuple[float, float]:
        """Return a place on a circle, clockwise from 12."""
        return 256 + radius * np.sin(angle), 256 - radius * np.cos(angle)

    picture = Image.new("RGB", (512, 512), "#2b3a4a")
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(56)
    draw.ellipse((16, 16, 496, 496), "#f4f0e4", "#b08d3c", 12)
    for minute in range(60):
        angle, inner = np.pi * minute / 30, 205 if minute % 5 else 195
        ends = [around(angle, radius) for radius in (inner, 222)]
        draw.line(ends, "#222222", 3 if minute % 5 else 8)
    for hour in range(1, 13):
        draw.text(around(np.pi * hour / 6, 160), str(hour), "#222222", font, "mm")
    for angle, length, width in ((np.radians(305), 110, 14), (np.radians(60), 165, 9)):
        draw.line([(256, 256), around(angle, length)], "#222222", width)
    draw.ellipse((242, 242, 270, 270), "#b08d3c")
    return drawn(picture)


def poster() -> Texture:
    """Return ellipses that grow larger outwards, as splats are drawn in papers."""
    picture = Image.new("RGB", (900, 640), "#f5efe2")
    draw, rng = ImageDraw.Draw(picture), np.random.default_rng(7)
    colors = ("#d1495b", "#edae49", "#00798c", "#30638e", "#003d5b", "#66a182")
    for number in range(170):
        x, y = rng.uniform(30, 870), rng.uniform(30, 520)
        wide, high = rng.uniform(6, 44, 2)
        draw.ellipse((x - wide, y - high, x + wide, y + high), colors[number % 6], "#222222", 2)
    draw.rectangle((0, 548, 900, 640), "#003d5b")
    draw.text((450, 594), "3D GAUSSIAN SPLATTING", "#f5efe2", ImageFont.load_default(58), "mm")
    return drawn(picture)


def squares() -> Texture:
    """Return a side of a puzzle cube."""
    colors = np.array([[0.8, 0.1, 0.12], [0.95, 0.8, 0.1], [0.1, 0.35, 0.75], [0.1, 0.6, 0.3],
                       [0.95, 0.95, 0.93], [0.95, 0.5, 0.1]])  # fmt: skip

    def texture(u: Array, v: Array) -> Array:
        """Return nine fields with black joints."""
        field = np.floor(u * 3) * 5 + np.floor(v * 3) * 7
        edge = (np.abs(u * 3 % 1.0 - 0.5) > 0.44) | (np.abs(v * 3 % 1.0 - 0.5) > 0.44)
        return np.where(edge[:, None], 0.06, colors[(field % 6).astype(int)])

    return texture


def stripes(first: str, second: str) -> Texture:
    """Return oblique stripes around a body."""
    colors = [np.array(ImageColor.getrgb(name)) / 255.0 for name in (first, second)]
    return lambda u, v: np.where(((u * 12 + v * 5) % 1.0 < 0.5)[:, None], *colors)


def pieces() -> list[Surface]:
    """Return chess pieces on the board, light ones in front."""
    pawn = [(0.0, 0.0), (0.019, 0.0), (0.019, 0.008), (0.013, 0.014), (0.008, 0.034),
            (0.013, 0.038), (0.012, 0.05), (0.008, 0.058), (0.0, 0.06)]  # fmt: skip
    king = [(0.0, 0.0), (0.022, 0.0), (0.022, 0.01), (0.014, 0.018), (0.009, 0.06), (0.017, 0.066),
            (0.011, 0.07), (0.019, 0.098), (0.012, 0.104), (0.004, 0.108), (0.004, 0.122),
            (0.0, 0.123)]  # fmt: skip
    kings = ((3, 0), (4, 7), (2, 7))
    pawns = ((0, 1), (1, 1), (2, 3), (4, 3), (5, 1), (6, 1), (1, 6), (3, 4), (4, 5), (6, 6), (7, 5))
    made = []
    for column, row in (*kings, *pawns):
        foot = BOARD + np.array([(column - 3.5) * 0.0495, (row - 3.5) * 0.0495, 0.0095])
        color = (235, 214, 173) if row < 4 else (51, 28, 23)
        made.append(turned(foot, king if (column, row) in kings else pawn, plain(color), 0.0026))
    return made


BOARD = np.array([-0.1, -0.1, 0.01])
"""The middle of the chess board."""


LEFT, WIDTH, BACK, DEPTH = -0.95, 2.3, 0.6, 1.2
"""Of the desk, metres."""

FEET = np.array([[-0.1, -0.1, 0.24], [0.42, 0.22, 0.2], [-0.52, 0.2, 0.1], [0.36, -0.16, 0.05],
                 [0.56, -0.08, 0.05], [-0.5, -0.16, 0.05]])  # fmt: skip
"""Where things stand on the desk, and how wide they are: x, y, half a width."""


def desk(u: Array, v: Array) -> Array:
    """Return wood, darker where light hardly gets: around what stands on it, away from the lamp."""
    x, y = LEFT - 0.02 + WIDTH * u, BACK - DEPTH - 0.02 + DEPTH * v  # shadows fall to the right
    light = np.ones(len(u))
    for foot_x, foot_y, half in FEET:
        away = np.maximum(np.abs(x - foot_x), np.abs(y - foot_y)) - half
        light *= 1.0 - 0.5 * np.exp(-np.maximum(away, 0.0) / 0.025)
    return wood(u, v) * light[:, None]


def books() -> list[Surface]:
    """Return a pile of books."""
    titles = (
        ("SPLATS AND RAYS", "#7a1f2b"),
        ("RENDERING", "#1d4e4a"),
        ("LIGHT FIELDS", "#2c3e70"),
        ("LINEAR ALGEBRA", "#8a5a16"),
    )
    made = []
    for number, (title, back) in enumerate(titles):
        cover = plain(ImageColor.getrgb(back))
        texture = {
            "": plain((240, 232, 214)),
            "front": lettered(title, back, "#f2e3b3", (760, 110), 74),
            "top": cover,
            "bottom": cover,
        }
        middle = np.array([0.42, 0.22, 0.022 + 0.044 * number])
        made += box(middle, (0.36, 0.25, 0.043), 0.06 * (-1) ** number, texture, 0.0021)
    return made


def scene() -> list[Surface]:
    """Return all surfaces."""
    wide, deep, high = np.diag([WIDTH, DEPTH, 0.85])
    low = np.array([LEFT, BACK, 0.0])
    mug = [(0.0, 0.0), (0.038, 0.0), (0.042, 0.01), (0.042, 0.1), (0.039, 0.1), (0.037, 0.015),
           (0.0, 0.012)]  # fmt: skip
    ball = [(0.06 * np.sin(t), 0.06 - 0.06 * np.cos(t)) for t in np.linspace(0, np.pi, 40)]
    dark, frame = plain((51, 36, 26)), plain((30, 26, 26))
    blue, orange = ("#f2f0e6", "#1a6b80"), ("#e67333", "#f5ebd1")
    return [
        patch(low - deep, wide, deep, desk, 0.0036),
        patch(low - deep + wide - 0.03 * high, -wide, deep, dark, 0.008),
        patch(low, wide, high, bricks, 0.0042),
        patch(low + wide + 0.1 * deep, -wide, high, bricks, 0.008),
        *box(BOARD, (0.45, 0.45, 0.019), 0.0, {"": plain((92, 51, 31)), "top": chess}, 0.0022),
        *pieces(),
        *books(),
        *box(np.array([-0.52, 0.2, 0.1]), (0.2, 0.07, 0.2), 0.25,
             {"": plain((43, 58, 74)), "front": dial()}, 0.0024),
        *box(np.array([-0.06, 0.58, 0.34]), (0.6, 0.02, 0.4), 0.0,
             {"": frame, "front": poster()}, 0.0028),
        *box(np.array([0.36, -0.16, 0.035]), (0.07, 0.07, 0.07), 0.5, {"": squares()}, 0.0018),
        turned(np.array([0.56, -0.08, 0.0]), mug, stripes(*blue), 0.0023),
        turned(np.array([-0.5, -0.16, 0.0]), mug, stripes(*orange), 0.0023),
        turned(np.array([0.4, 0.22, 0.176]), ball, stripes("#d12929", "#f7f2e6"), 0.0023),
    ]  # fmt: skip


def camera(azimuth: float, elevation: float, name: str) -> View:
    """Return the view from a direction, degrees: 0 from the front, 0 level with the desk."""
    a, e = np.radians([azimuth, elevation])
    away = np.array([np.sin(a) * np.cos(e), -np.cos(a) * np.cos(e), np.sin(e)])
    right = np.array([np.cos(a), np.sin(a), 0.0])
    rotation = np.stack([right, np.cross(-away, right), -away])
    width, height = SIZE
    center = MIDDLE + DISTANCE * away
    return View(rotation, center, FOCAL, FOCAL, width / 2, height / 2, width, height, name=name)


def main() -> None:
    """Make the scene, prune it, draw both, and say what came of it."""
    full = joined([surface.splats() for surface in scene()])
    cameras = ViewSet(
        tuple(
            camera(azimuth, elevation, f"{elevation}-{azimuth}")
            for elevation in (12, 24, 36, 48)
            for azimuth in range(-45, 46, 10)
        )
    )
    out = PROJECT / "out"
    out.mkdir(exist_ok=True)
    write_ply(out / "showcase.ply", full)
    write_cameras(out / "showcase.json", cameras)
    held_out = ViewSet((camera(-10, 25, "held out"),))
    if "--look" in sys.argv:
        (picture,) = compare(full, full, held_out)
        Image.fromarray(picture.before).save(out / "showcase.png")
        print(len(full))
        return
    result = prune(full, cameras, Budget(ratio=SHARE), Merge(40))
    (pictures,) = compare(full, result.splats, held_out)
    for name in ("before", "after"):
        Image.fromarray(getattr(pictures, name)).save(PROJECT / f"docs/{name}.jpg", quality=88)
    print(f"{len(full):,} splats, {int(result.keep.sum()):,} left: {pictures.psnr:.1f} dB held out")


if __name__ == "__main__":
    main()
