"""Splats that no memory holds at once, activated and stored so that a view loads what it shows.

They are activated source by source, and stored along a Z-shaped curve, so that a chunk of them is a
box in space. A view loads the chunks whose boxes may reach into its image, and has their footprints
together, as in memory: what it finds is the same to the bit, wherever the tiles were cut.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..operation.run import Runtime
from ..rendering import Model
from ..splats import drawable
from ..views import View, ViewSet
from ..visibility import projection
from ..visibility.measuring import Sampling
from ..visibility.projection import Gaussians
from ..visibility.scene import Scene, code_order, moments, spatial_code, splat_fingerprint
from .folder import Folder
from .units import Source
from .workers import Runner

CHUNK = 1 << 16
"""Splats of a chunk, 3.7 MB."""

_MEANS, _COVARIANCES, _LARGEST, _ALPHAS, _COLORS = slice(3), slice(3, 9), 9, 10, slice(11, 14)
"""Rows of a chunk, (14, n) float32: see `Gaussians`. Discs have their normals besides, (17, n), and
antialiased splats one row of no meaning, (15, n)."""

_ROWS: dict[Model, int] = {"default": 14, "antialiased": 15, "2dgs": 17}


@dataclass(frozen=True)
class SceneContext:
    """What all steps need that find out what views see; the folder is of these splats alone."""

    folder: Folder
    views: ViewSet
    sampling: Sampling
    scene: Scene

    def footprints(self, view: View) -> tuple[projection.Footprints, NDArray[np.float32]]:
        """Return the n footprints in a view, front to back, and their colours, (n, 3)."""
        pieces, colors = [], [np.empty((0, 3), np.float32)]
        with np.errstate(under="ignore"):
            for footprints, depth, of_each in self._of_chunks(view, view):
                colors.append(of_each)
                pieces.append((footprints, depth))
            sorted_footprints = projection.front_to_back(pieces)
        # Ascending, since chunks are.
        rows = np.concatenate([np.empty(0, np.int64), *(piece.index for piece, _ in pieces)])
        places = np.searchsorted(rows, sorted_footprints.index)
        return sorted_footprints, np.concatenate(colors)[places]

    def footprints_and_depths(
        self, view: View, window: View
    ) -> Iterator[tuple[projection.Footprints, NDArray[np.float32]]]:
        """Yield `projection.footprints_and_depths` of each chunk that a window may show."""
        for footprints, depth, _ in self._of_chunks(view, window):
            yield footprints, depth

    def _of_chunks(
        self, view: View, window: View
    ) -> Iterator[tuple[projection.Footprints, NDArray[np.float32], NDArray[np.float32]]]:
        """Yield `footprints_and_depths`, and the colours of the footprints, (n, 3)."""
        boxes = self.folder.noted("boxes")[1]
        touching = projection.boxes_touch(boxes, self.scene, view, window)
        for number in np.flatnonzero(touching).tolist():
            chunk = self.chunk(number)
            footprints, depth = projection.footprints_and_depths(chunk, self.scene, view, window)
            index = footprints.index + number * CHUNK
            yield replace(footprints, index=index), depth, chunk.colors[footprints.index]

    def chunk(self, number: int) -> Gaussians:
        """Return the Gaussians of a chunk."""
        table = self.folder.load(number, ["chunk"])["chunk"]
        model = next(model for model, rows in _ROWS.items() if rows == len(table))
        return Gaussians(
            np.arange(table.shape[1]), table[_MEANS], table[_COVARIANCES], table[_LARGEST],
            table[_ALPHAS], np.ascontiguousarray(table[_COLORS].T),
            table[14:] if model == "2dgs" else None, model,
        )  # fmt: skip


@dataclass(frozen=True)
class SumMoments:
    """Sums what the axes of the scene are made of over a source."""

    source: Source

    def run(self, context: SceneContext, _runtime: Runtime) -> NDArray[np.float64]:
        """Return `scene.moments` of the source, (pieces, 4, 3)."""
        splats = self.source.splats()
        with np.errstate(under="ignore"):
            pieces = [*moments(splats.means, drawable(splats), context.scene)]
        return np.reshape(pieces, (-1, 4, 3))


@dataclass(frozen=True)
class ActivateSplats:
    """Activates the splats of a source."""

    source: Source

    def run(self, context: SceneContext, runtime: Runtime) -> int:
        """Save the Gaussians, unless that is done; return how many there are."""
        name = f"{self.source.index:06d}.activated"
        return int(context.folder.once(name, lambda: self._activate(context, runtime)))

    def _activate(self, context: SceneContext, runtime: Runtime) -> NDArray[np.int64]:
        splats, scene = self.source.splats(), context.scene
        good, opaque = projection.classify(splats, threads=runtime.threads)
        with np.errstate(under="ignore"):
            rows, place = projection.near_scene(splats, opaque, scene)
            activated = projection.activate(
                splats, rows, place, scene, runtime.progress, runtime.threads
            )
            code = spatial_code(place)
        table = np.zeros((len(rows), _ROWS[splats.model]), np.float32)
        table[:, _MEANS], table[:, _COVARIANCES] = activated.means.T, activated.covariances.T
        table[:, _LARGEST], table[:, _ALPHAS] = activated.largest, activated.alphas
        table[:, _COLORS] = activated.colors
        if activated.normals is not None:
            table[:, 14:] = activated.normals.T
        arrays = {"good": good, "rows": rows, "code": code, "gaussians": table}
        arrays["ties"] = splat_fingerprint(splats, rows)
        context.folder.save(self.source.index, arrays)
        return np.array(len(rows))


@dataclass(frozen=True)
class GatherChunk:
    """Gathers the Gaussians of a chunk from those of all sources."""

    number: int
    starts: NDArray[np.int64]  # (sources + 1,): Gaussians of the sources before each, and of all

    def run(self, context: SceneContext, _runtime: Runtime) -> NDArray[np.float32]:
        """Save the chunk, unless that is done; return its box, (7,): `projection.boxes_touch`."""
        name = f"{self.number:06d}.gathered"
        box = context.folder.once(name, lambda: self._gathered(context.folder))
        return np.asarray(box, np.float32)

    def _gathered(self, folder: Folder) -> NDArray[np.float32]:
        order = folder.mapped("order")[self.number * CHUNK : (self.number + 1) * CHUNK]
        source = np.searchsorted(self.starts, order, side="right") - 1
        chunk = np.empty((14, len(order)), np.float32)
        for index in np.unique(source).tolist():
            here = np.flatnonzero(source == index)
            table = folder.map(index, "gaussians")
            if len(chunk) != table.shape[1]:  # of another model
                chunk = np.empty((table.shape[1], len(order)), np.float32)
            chunk[:, here] = table[order[here] - self.starts[index]].T
        folder.save(self.number, {"chunk": chunk})
        means = chunk[_MEANS]
        return np.concatenate([means.min(axis=1), means.max(axis=1), [chunk[_LARGEST].max()]])


class StoredGaussians:
    """All M splats that can contribute to a picture, in a folder; see `Gaussians`.

    Parameters
    ----------
    folder : Folder
    index : (M,) int64
        Rows of the splats, see `Gaussians`; also an attribute, and noted in the folder.
    """

    def __init__(self, folder: Folder, index: NDArray[np.int64]) -> None:
        self.index, self._folder = index, folder
        folder.note("count", np.array(len(index)))
        folder.note("index", index)

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.index)

    @property
    def alphas(self) -> NDArray[np.float32]:
        """Opacities of all, (M,)."""
        return np.concatenate([chunk[_ALPHAS] for chunk in self._chunks()])

    @property
    def colors(self) -> NDArray[np.float32]:
        """Colours of all, (M, 3)."""
        return np.concatenate([chunk[_COLORS].T for chunk in self._chunks()])

    def _chunks(self) -> Iterator[NDArray[np.float32]]:
        yield np.empty((14, 0), np.float32)
        for number in range(-(-len(self) // CHUNK)):
            yield self._folder.map(number, "chunk")


def store_gaussians(
    context: SceneContext, sources: Sequence[Source], runner: Runner
) -> tuple[StoredGaussians, NDArray[np.bool_]]:
    """Activate all splats, and store them along the curve.

    Returns
    -------
    gaussians : StoredGaussians
    good : (N,) bool
        Which splats can be drawn.
    """
    folder, sizes = context.folder, [*map(len, sources)]
    activate = [ActivateSplats(source) for source in sources]
    counts = [*runner.part(0.0, 0.6).run(context, activate, "reading", sizes)]
    of_all = functools.partial(folder.joined, [source.index for source in sources])
    order = folder.once(
        "order", lambda: code_order(of_all("code"), lambda rows: of_all("ties")[rows])
    )
    index = (np.repeat(np.cumsum([0, *sizes[:-1]]), counts) + of_all("rows"))[order]
    del order
    starts = np.cumsum([0, *counts])
    gather = [GatherChunk(number, starts) for number in range(-(-len(index) // CHUNK))]
    boxes = [*runner.part(0.6, 1.0).run(context, gather, "reading")]
    folder.note("boxes", np.reshape(np.array(boxes, np.float32), (-1, 7)))
    good = of_all("good")
    for source in sources:
        folder.drop(source.index, ("code", "ties", "gaussians"))
    return StoredGaussians(folder, index), good
