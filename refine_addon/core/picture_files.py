"""Files of pictures before and after a prune: ``NAME-CAMERA-before.png`` and so on."""

from __future__ import annotations

import contextlib
import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .errors import RefineError
from .execute import Progress, silent
from .images import png
from .pictures import AMPLIFIED, CAMERAS, compare
from .splats import Splats
from .views import ViewSet
from .whole_file import new_folder, refuse_existing, whole_file

KINDS = ("before", "after", "difference")
"""The three pictures of a view; each is the end of a file name."""

_IMAGE = re.compile(r"\.(png|jpe?g|webp|tiff?|exr|bmp)$", re.IGNORECASE)
"""The suffix of a photo, after which imported cameras are named."""

_LONGEST = 80
"""Bytes of a camera's name that its files have: its end. Systems take names of 255 bytes."""


@dataclass(frozen=True)
class PictureFiles:
    """Where the pictures of one prune go.

    Attributes
    ----------
    folder : Path
        Made if it is not there.
    name : str
        Of the splats: the first part of the files' names.
    overwrite : bool
        Whether files may be replaced.
    """

    folder: Path
    name: str
    overwrite: bool = False

    @contextlib.contextmanager
    def opened(self, views: ViewSet) -> Iterator[None]:
        """Make the folder, and refuse what could not be written, before the work.

        Raises
        ------
        RefineError
            See `refine_addon.core.whole_file.new_folder` and `refuse_existing`.
        """
        with new_folder(self.folder):
            for paths in self._paths(chosen(views)):
                for path in paths.values():
                    refuse_existing(path, overwrite=self.overwrite)
            yield

    def write(
        self,
        before: Splats,
        after: Splats,
        views: ViewSet,
        *,
        progress: Progress = silent,
        threads: int | None = None,
    ) -> dict[str, Any]:
        """Draw the `chosen` of the views and write their pictures.

        Parameters
        ----------
        before, after, progress, threads
            See `refine_addon.core.pictures.compare`.
        views : ViewSet
            Those that decided.

        Returns
        -------
        dict
            What the report says: the mean PSNR that was measured, and of each view its camera, its
            size, its PSNR and its files.

        Raises
        ------
        RefineError
            If a file cannot be written; by then the prune is done.
        Cancelled
            If `progress` answers ``False``.
        """
        drawn = chosen(views)
        comparisons = compare(before, after, drawn, progress=progress, threads=threads)
        facts = []
        try:
            for made, files in zip(comparisons, self._paths(drawn), strict=True):
                for kind, path in files.items():
                    with whole_file(path, overwrite=self.overwrite) as stream:
                        stream.write(png(getattr(made, kind)))
                size, names = [made.view.width, made.view.height], {k: str(files[k]) for k in files}
                camera = {"camera": made.view.name, "size": size, "psnr": round(made.psnr, 2)}
                facts.append(camera | names)
        except RefineError as error:
            raise RefineError(f"{error}; the pruning itself is done") from error
        mean = sum(comparison.psnr for comparison in comparisons) / len(comparisons)
        return {"psnr": round(mean, 2), "amplified": AMPLIFIED, "views": facts}

    def _paths(self, views: ViewSet) -> list[dict[str, Path]]:
        """Files of each view, by `KINDS`."""
        return [
            {kind: self.folder / f"{_plain(self.name)}-{label}-{kind}.png" for kind in KINDS}
            for label in _labels([view.name for view in views])
        ]


def chosen(views: ViewSet) -> ViewSet:
    """Views that are drawn: a few that are spread evenly over all."""
    return views.spread(CAMERAS)


def in_words(facts: dict[str, Any]) -> str:
    """What was measured in pictures, as one sentence.

    >>> views = [{"psnr": 38.0}, {"psnr": 36.0}]
    >>> in_words({"psnr": 37.0, "amplified": 8, "views": views})
    '37.0 dB measured in 2 views (36.0 to 38.0); differences are shown 8 times as large'
    """
    values = [view["psnr"] for view in facts["views"]]
    many = f"{len(values)} views ({min(values):.1f} to {max(values):.1f})"
    where = many if len(values) > 1 else "one view"
    return (
        f"{facts['psnr']:.1f} dB measured in {where}; differences are shown {facts['amplified']} "
        "times as large"
    )


def _labels(names: list[str]) -> list[str]:
    """A different part of a file name for each camera.

    >>> _labels(["left/0.png", "left/0.png", ""])
    ['left_0', 'left_0_2', 'view']
    """
    labels: list[str] = []
    for name in names:
        end = _plain(_IMAGE.sub("", name)).encode()[-_LONGEST:].decode(errors="ignore") or "view"
        numbered = (f"{end}_{number}" for number in itertools.count(2))
        labels.append(
            next(label for label in itertools.chain([end], numbered) if label not in labels)
        )
    return labels


def _plain(name: str) -> str:
    """A name with only what every system takes within the name of a file."""
    return re.sub(r"[^\w.() -]", "_", name)
