"""A scene that looks like a capture of a furnished house, and cameras in it; nothing is trained.

    python -m benchmarks.speed.house FOLDER --splats 2200000 --views 42 --held-out 6 --seed 1

Walls, doors and full shelves hide and show other things than the objects of `capture` do. All there
is are boxes and balls; each of their faces gets splats by its area and by how detailed it is. Half
of them are an even coat; the others are faint, small, or behind the surface.
"""

import argparse
import json
from collections.abc import Sequence
from itertools import pairwise, product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from refine_addon.core.splats import SH_C0, Splats
from refine_addon.core.views import View, ViewSet

from ..tables.million import write_cameras, write_ply

Array = NDArray[np.float64]
# Splats on an area; of its texture the contrast, waves along x and y (1/m) and how sharp they are;
# mean logit of the opacity, 0 for the usual; colour, none for any.
LOOKS = {
    "paint": (0.4, 0.3, 1, 1, 1, 0, (0.8, 0.78, 0.72)),
    "wood": (0.8, 0.7, 4, 40, 2, 0, (0.6, 0.4, 0.22)),
    "cloth": (0.8, 0.5, 40, 40, 1, 0, ()),
    "picture": (2, 1, 14, 14, 8, 0, ()),
    "leaf": (2, 0.4, 60, 60, 1, 0, (0.2, 0.45, 0.15)),
    "sheer": (0.6, 0.3, 60, 1, 1, -0.8, (0.95, 0.9, 0.75)),
    "glass": (0.2, 0, 1, 1, 1, -3.4, (0.8, 0.9, 0.95)),
    "haze": (0.02, 0, 1, 1, 1, -2.5, ()),
    "sky": (0.0005, 0.5, 0.3, 0.3, 4, 0, (0.6, 0.85, 0.95)),
}
# Name, look, middle and half size in cm, twice where x is not 0; walls are stretched along x.
PARTS = [
    ("door", "paint", (120, 0, 130), (80, 6, 130)),
    ("door", "paint", (0, 0, 235), (40, 6, 25)),
    ("door", "wood", (40, 0, 105), (4, 8, 105)),
    ("door", "picture", (120, 0, 150), (25, 8, 30)),
    ("window", "paint", (120, 6, 130), (80, 0, 130)),
    ("window", "paint", (0, 6, 235), (40, 0, 25)),
    ("window", "wood", (0, 6, 40), (40, 0, 40)),
    ("window", "wood", (40, 3, 145), (4, 5, 65)),
    ("window", "glass", (0, 3, 145), (40, 0, 65)),
    ("window", "sheer", (50, 15, 120), (20, 1, 110)),
    ("window", "picture", (120, 7, 150), (35, 1, 30)),
    ("sofa", "cloth", (0, 40, 24), (80, 40, 19)),
    ("sofa", "cloth", (0, 10, 60), (80, 10, 25)),
    ("sofa", "ball of picture", (50, 30, 60), (22, 10, 20)),
    ("table", "wood", (0, 40, 74), (80, 40, 2)),
    ("table", "wood", (76, 40, 36), (3, 36, 36)),
    ("table", "cloth", (40, 95, 45), (20, 20, 3)),
    ("table", "wood", (40, 95, 21), (3, 3, 21)),
    ("shelf", "wood", (78, 15, 100), (2, 15, 100)),
    ("shelf", "paint", (0, 1, 100), (77, 1, 100)),
    *(("shelf", "wood", (0, 16, z), (76, 14, 2)) for z in range(10, 190, 38)),
    ("plant", "ball of cloth", (0, 35, 17), (18, 18, 19)),
    ("plant", "wood", (0, 35, 60), (2, 2, 45)),
    *(("plant", "ball of leaf", (0, 35, 95), (30, 30, 50)) for _ in range(80)),
    ("plant", "wood", (60, 20, 70), (1, 1, 70)),
    ("plant", "ball of sheer", (60, 20, 150), (18, 18, 16)),  # lamps
]


class House:
    """Rooms (x, y, x, y) on a grid, faces of boxes and balls, and what cameras look at."""

    def __init__(self, random: np.random.Generator) -> None:
        self.random = random
        self.faces: list[tuple[bool, str, Sequence | Array, Array]] = []
        self.sights: list[Array] = []
        counts = random.permutation([2, random.integers(3, 5)])
        grid = [np.cumsum([0, *random.uniform(4, 5.2, count)]) for count in counts]
        self.rooms = [np.transpose(pairs).ravel() for pairs in product(*map(pairwise, grid))]
        for k in range(2):
            for at, (start, end) in product(grid[k], pairwise(grid[1 - k])):
                name = "window" if at in (0, grid[k][-1]) else "door"
                place = turned(k, at, (start + end) / 2, 0)
                self.stand(name, k, -1 if at else 1, place, (end - start) / 4)
        for room in self.rooms:
            middle, half = (room[:2] + room[2:]) / 2, (room[2:] - room[:2]) / 2
            self.put(random.choice(["wood", "cloth"]), [*middle, 0], [*half, 0])
            self.put("picture", [*middle, 0.01], [*half * 0.5, 0])
            self.put("paint", [*middle, 2.6], [*half, 0])
            for side, (x, y) in enumerate([(0, 1), (2, 1), (2, 3), (0, 3)]):  # of each wall one end
                name = random.choice(["sofa", "table", "shelf", "plant", "shelf"])
                inward = np.sign(middle - room[[x, y]])
                place = room[[x, y]] + inward * turned(side % 2, 0.1, 0.95, 0)[:2]
                self.stand(name, side % 2, inward[side % 2], np.array([*place, 0]))
        self.put("ball of sky", [0, 0, 0], [50, 50, 30])

    def put(self, look: str, middle: Sequence | Array, half: Sequence | Array) -> None:
        """Add the faces of a box or ball; of what is flat, one that faces inward."""
        axes = np.diag(np.maximum(half, 1e-4))
        flat = int(np.argmin(half))
        only = [(flat, 1 if middle[flat] < 1 else -1)]
        for axis, side in product(range(3), (-1, 1)) if half[flat] else only:
            face = np.roll(axes, -1 - axis, axis=0)
            face[1:] *= side  # the third axis points outward
            self.faces.append((look.startswith("ball"), look.split()[-1], middle, face))

    def stand(self, name: str, k: int, inward: float, place: Array, stretch: float = 1.0) -> None:
        """Put a wall or a piece of furniture, and small things onto its boards."""
        self.sights.append(place + np.array([0, 0, self.random.uniform(0.5, 1.5)]))
        for look, (x, y, z), half in [part[1:] for part in PARTS if part[0] == name]:
            size = turned(k, half[1], stretch * half[0], half[2]) / 100
            for mirrored in sorted({x, -x}):
                middle = place + turned(k, inward * y, stretch * mirrored, z) / 100
                if look == "ball of leaf":
                    middle += 0.5 * size * self.random.normal(size=3)
                    size = self.random.permutation([0.09, 0.04, 0.004])
                self.put(look, middle, size)
            for at in np.arange(6 - half[0], half[0] - 4, 8) if half[2] == 2 else ():
                size = self.random.uniform([0.03, 0.02, 0.03], [0.08, 0.035, 0.12])
                middle = place + turned(k, inward * y, at, z + 2 + 100 * size[2]) / 100
                look = self.random.choice(["ball of cloth", "paint", "picture", "cloth"])
                self.put(look, middle, turned(k, *size))


def turned(k: int, across: float, along: float, up: float) -> Array:
    """Return x, y, z of what is so far across and along a wall across axis `k`."""
    return np.array([across, along, up])[[k, 1 - k, 2]]


def unit(vectors: Array) -> Array:
    """Return vectors of length one."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def fill(house: House, count: int) -> Splats:
    """Return `count` splats on the faces."""
    random = house.random
    ball, names, middles, axes = (np.array(column) for column in zip(*house.faces, strict=True))
    density, contrast, *waves, sharp, logit = np.array([LOOKS[name][:6] for name in names]).T
    lengths = np.linalg.norm(axes, axis=2)
    extents = np.where(ball, 1.5, 2) * lengths[:, :2].T
    area = extents.prod(axis=0)
    share = np.cumsum(density * (area + 0.01 * extents.max(axis=0)))
    each = np.diff(np.rint(share / share[-1] * count).astype(int), prepend=0)
    of = np.repeat(np.arange(len(each)), each)
    number = np.arange(count) - (np.cumsum(each) - each)[of]
    # Those of the coat, faint ones, behind the surface, small ones.
    role = random.choice([1, 2, 3], count, p=[0.6, 0.15, 0.25]) * (number >= 0.45 * each[of])
    # The distance of splats of the coat, less across what is narrow, gives sizes.
    apart = np.sqrt(area / np.maximum(each, 1) / 0.45)
    other = np.minimum(apart, extents[::-1] / 4)
    spacing = np.minimum(apart**2 / other, extents / 4)[:, of]
    sizes = spacing * np.choose(role, [0.6, 0.8, 0.8, 0.35])
    sizes *= np.exp(np.choose(role, [0.15, 0.5, 0.5, 0.4]) * random.normal(size=count).clip(-2, 2))
    sizes = np.log([*sizes, np.minimum(0.08 * sizes.min(axis=0), 0.004)]).T
    mean = np.where(logit[of] < 0, logit[of], np.choose(role, [2.4, -2.5, 0, 0.5]))
    logits = random.normal(mean, np.choose(role, [1.4, 1.2, 2, 1.5]))
    # Places on a face, from -1 to 1, and the frame of the surface there.
    places = 2 * ((number * [[0.7548776662], [0.569840291]] + random.random((2, 1))) % 1) - 1
    places *= np.where(ball[of], 1, 1 - spacing / extents[:, of])
    weights = np.array([*places, np.ones(count)]).T
    weights[ball[of]] = unit(weights[ball[of]])
    spots = middles[of] + np.einsum("nk,nkd->nd", weights, axes[of])
    weights[~ball[of]] = [0, 0, 1]
    normals = unit(np.einsum("nk,nkd->nd", weights / lengths[of] ** 2, axes[of]))
    forward = axes[of, 0] - normals * np.sum(normals * axes[of, 0], axis=1, keepdims=True)
    matrices = np.stack([unit(forward), np.cross(normals, unit(forward)), normals], axis=2)
    turns = Rotation.from_matrix(matrices).as_quat()[:, [3, 0, 1, 2]]
    depth = random.normal(0, np.choose(role, [0.0015, 0.006, 0.01, 0.002])) + 0.03 * (role == 2)
    spots -= depth[:, None] * normals
    # Two colours in waves, and more light from above.
    tints = np.array([LOOKS[name][6] or random.uniform(0.1, 0.9, 3) for name in names])
    tints *= random.uniform(0.7, 1.2, (len(names), 1))
    others = np.where(contrast[:, None] == 1, random.random(tints.shape), 0.4 * tints)
    u, v = places * (lengths[:, :2].T * waves)[:, of] + 1.7 * of
    wave = np.sin(u + 2 * np.sin(0.6 * v)) * np.sin(v + 2 * np.sin(0.6 * u))
    mix = contrast[of] * (0.5 + 0.5 * np.tanh(sharp[of] * wave))
    colors = tints[of] + mix[:, None] * (others - tints)[of]
    colors *= (0.8 + normals @ [0.15, 0.08, 0.2])[:, None]
    colors += random.normal(0, np.choose(role, [0.015, 0.05, 0.08, 0.02])[:, None], (count, 3))
    colors = (colors.clip(0.01, 0.99) - 0.5) / SH_C0
    columns = spots, sizes, turns, logits, colors, np.zeros((count, 0, 3))
    order = random.permutation(count)
    return Splats(*(np.asarray(column[order], np.float32) for column in columns))


def walk(house: House, count: int, held_out: int) -> ViewSet:
    """Return views of somebody who stands in the rooms; those held out, the last, stand apart."""
    random, sights, focal = house.random, np.array(house.sights), 480 / np.tan(np.radians(35))
    made: list[View] = []  # those held out first
    while len(made) < held_out + count:
        others = made[:held_out] if len(made) >= held_out else []
        room = house.rooms[(len(made) - len(others)) % len(house.rooms)]
        center = random.normal(1.58, 0.05, 3)
        center[:2] = random.uniform(room[:2] + 0.7, room[2:] - 0.7)
        near = np.all((sights[:, :2] > room[:2] - 0.1) & (sights[:, :2] < room[2:] + 0.1), axis=1)
        target = random.choice(sights[near]) + random.normal(0, 0.2, 3)
        apart = all(np.linalg.norm(center - view.center) > 0.5 for view in others)
        if apart and np.linalg.norm(target - center) > 1.5:
            forward = unit(target - center)
            right = unit(np.cross(forward, [0, 0, 1]))
            rotation = np.stack([right, np.cross(forward, right), forward])
            name = f"{len(made):03}"
            made.append(View(rotation, center, focal, focal, 480, 270, 960, 540, name=name))
    return ViewSet((*made[held_out:], *made[:held_out]))


def main(arguments: Sequence[str] | None = None) -> None:
    """Write a scene into a folder."""
    parser = argparse.ArgumentParser(description="Make a furnished house, and cameras in it.")
    parser.add_argument("folder", type=Path)
    for name, number in {"splats": 2_200_000, "views": 42, "held-out": 6, "seed": 1}.items():
        parser.add_argument(f"--{name}", type=int, default=number)
    options = parser.parse_args(arguments)
    house = House(np.random.default_rng(options.seed))
    views = walk(house, options.views, options.held_out)
    for number in house.random.integers(options.views, size=300):  # faint blurs and floaters
        forward = views[number].rotation[2] + house.random.normal(0, 0.2, 3)
        place = views[number].center + house.random.uniform(0.8, 2) * forward
        house.put("ball of haze", place, house.random.uniform(0.03, 0.5, 3))
    options.folder.mkdir(parents=True, exist_ok=True)
    write_ply(options.folder / "point_cloud.ply", fill(house, options.splats))
    write_cameras(options.folder / "cameras.json", views)
    names = [view.name for view in views]
    split = {"train": names[: options.views], "test": names[options.views :]}
    (options.folder / "split.json").write_text(json.dumps(split), encoding="utf-8")


if __name__ == "__main__":
    main()
