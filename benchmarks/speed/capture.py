"""A scene that looks like a capture, of any number of splats, and its cameras.

    python -m benchmarks.speed.capture FOLDER --splats 2200000

Nothing is trained. A square with a bumpy floor, objects that stand on it and hide each other, and
what lies far around them. As in captures, nearly all splats are small flat discs that lie on
surfaces, smaller where a surface is detailed; some are thin and some nearly transparent; a few lie
within objects, where no camera sees them, or float in the air; and one in fifty is vast and far
away. Cameras walk round the objects at two heights, and look at them.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from refine_addon.core.splats import SH_C0, Splats
from refine_addon.core.views import View, ViewSet

from ..tables.million import write_cameras, write_ply

Array = NDArray[np.float64]

OBJECTS = 40
SIZE = 10.0
"""Edge of the square, units."""

FAR, INSIDE, FLOATING, FLOOR = 0.02, 0.08, 0.003, 0.3
"""Shares of the splats that are far away, within objects, in the air, and on the floor."""

COVER = 1.0
"""Radius of a splat on a surface, as a part of the distance to the next one."""

UNEVEN = 0.5
"""Standard deviation of the logarithm of that."""

VAST = 0.06
"""Radius of what is far away, as a part of its distance."""


def make(count: int, degree: int = 3) -> Splats:
    """Return a scene of `count` splats, always the same."""
    random = np.random.default_rng(7)
    far, inside, floating, floor = (int(share * count) for share in (FAR, INSIDE, FLOATING, FLOOR))
    on_objects = count - far - inside - floating - floor
    floor_means, floor_normals = _floor(floor, random)
    means, normals, area = _objects(on_objects, random)
    within = means[random.integers(on_objects, size=inside)]
    within = within - random.uniform(0.05, 0.4, (inside, 1)) * _unit(within - [0.0, 0.0, 0.5])
    air = random.uniform(
        [-0.3 * SIZE, -0.3 * SIZE, 0.3], [0.3 * SIZE, 0.3 * SIZE, 2.0], (floating, 3)
    )
    around = _unit(random.normal(size=(far, 3)) * [1.0, 1.0, 0.5])
    around *= SIZE * random.uniform(3.0, 12.0, (far, 1))
    around[:, 2] = np.abs(around[:, 2])
    every = np.concatenate([floor_means, means, within, air, around])
    apart = np.sqrt(np.array([SIZE**2 / max(floor, 1), area / max(on_objects, 1)]))
    size = np.concatenate([
        np.full(floor, apart[0]), np.full(on_objects + inside, apart[1]),
        np.full(floating + far, apart[1]),
    ])  # fmt: skip
    size *= COVER * np.exp(UNEVEN * random.normal(size=count).clip(-2.5, 2.5))
    size[count - far :] = VAST * np.linalg.norm(around, axis=1)
    facing = np.concatenate(
        [floor_normals, normals, _unit(random.normal(size=(count - floor - on_objects, 3)))]
    )
    shape = np.exp(0.4 * random.normal(size=(count, 2)).clip(-2.5, 2.5))  # of a disc: its two radii
    scales = np.column_stack([size[:, None] * shape, 0.05 * size])
    # Most are nearly opaque, a third nearly transparent.
    thin = random.random(count) < 1 / 3
    logits = np.where(thin, random.normal(-3.0, 1.0, count), random.normal(2.5, 1.5, count))
    order = random.permutation(count)
    rest = random.normal(scale=0.03, size=(count, (degree + 1) ** 2 - 1, 3))
    columns = (
        every, np.log(scales), _turns(facing), logits, (_colors(every, random) - 0.5) / SH_C0, rest
    )  # fmt: skip
    return Splats(*(np.asarray(values[order], np.float32) for values in columns))


def cameras(count: int = 48, width: int = 640) -> ViewSet:
    """Return cameras on two rings around the objects, of which one is higher."""
    views = []
    for number in range(count):
        angle, high = 2.0 * np.pi * number / count, number % 2
        place = SIZE * (0.62 - 0.12 * high)
        center = np.array([place * np.cos(angle), place * np.sin(angle), 1.6 + 1.6 * high])
        forward = _unit(np.array([0.0, 0.0, 0.6]) - center)
        right = _unit(np.cross(forward, [0.0, 0.0, 1.0]))
        rotation = np.stack([right, np.cross(forward, right), forward])
        height = width * 9 // 16
        views.append(
            View(
                rotation, center, 0.8 * width, 0.8 * width, width / 2, height / 2, width, height,
                name=f"{number:03}",
            )
        )  # fmt: skip
    return ViewSet(tuple(views))


def _floor(count: int, random: np.random.Generator) -> tuple[Array, Array]:
    """Return points of a bumpy floor and its normals, (count, 3) each."""
    x, y = random.uniform(-SIZE / 2, SIZE / 2, (2, count))
    height = 0.05 * np.sin(3.0 * x) * np.cos(2.0 * y)
    slopes = -0.15 * np.cos(3.0 * x) * np.cos(2.0 * y), 0.1 * np.sin(3.0 * x) * np.sin(2.0 * y)
    return np.column_stack([x, y, height]), _unit(np.column_stack([*slopes, np.ones(count)]))


def _objects(count: int, random: np.random.Generator) -> tuple[Array, Array, float]:
    """Return points on the surfaces of boxes and ellipsoids, their normals, and their area.

    Some have many more points than their area is: what a capture has seen from near.
    """
    middles = random.uniform(-0.35 * SIZE, 0.35 * SIZE, (OBJECTS, 2))
    radii = random.uniform(0.15, 0.8, (OBJECTS, 3))
    areas = 4.0 * np.pi * np.mean(radii**2, axis=1)
    detail = np.exp(random.normal(scale=0.6, size=OBJECTS))
    of_object = random.choice(OBJECTS, count, p=areas * detail / np.sum(areas * detail))
    normals = _unit(random.normal(size=(count, 3)))
    boxes = of_object % 2 == 0
    points = normals.copy()
    faces = normals / np.abs(normals).max(axis=1, keepdims=True)
    points[boxes] = faces[boxes]
    normals[boxes] = np.where(np.abs(faces) >= 1.0, faces, 0.0)[boxes]
    points = points * radii[of_object]
    normals = _unit(normals / radii[of_object])
    points[:, :2] += middles[of_object]
    points[:, 2] += radii[of_object, 2]
    return points, normals, float(areas.sum())


def _colors(points: Array, random: np.random.Generator) -> Array:
    """Return colours that change smoothly, with a grain, (n, 3) in 0 to 1."""
    waves = random.normal(size=(3, 3))
    smooth = 0.5 + 0.35 * np.sin(points @ waves + random.uniform(0.0, 6.0, 3))
    return np.clip(smooth + random.normal(scale=0.05, size=points.shape), 0.0, 1.0)


def _turns(normals: Array) -> Array:
    """Return quaternions, w x y z, that turn the third axis onto normals, (n, 4)."""
    x, y, z = normals.T
    return _unit(np.column_stack([1.0 + z + 1e-9, -y, x, np.zeros(len(x))]))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def main(arguments: Sequence[str] | None = None) -> None:
    """Write a scene into a folder."""
    parser = argparse.ArgumentParser(description="Make a scene that looks like a capture.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--splats", type=int, default=160_000)
    parser.add_argument("--degree", type=int, choices=range(4), default=3)
    options = parser.parse_args(arguments)
    options.folder.mkdir(parents=True, exist_ok=True)
    write_ply(options.folder / "point_cloud.ply", make(options.splats, options.degree))
    write_cameras(options.folder / "cameras.json", cameras())


if __name__ == "__main__":
    main()
