"""Seconds of our methods by the size of the pictures: the cameras of a scene, scaled.

The splats are the same, and so is what each camera sees; only its pixels are finer or coarser, as
if the photos had been taken, or reduced, to another size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from refine_addon.core.views import ViewSet

from .cost import Cost
from .methods import Method, Task

WIDTHS = (480, 1920)
"""Widths measured beside that of the files, pixels."""


@dataclass(frozen=True)
class Timed:
    """Seconds of one method for each size of the pictures.

    Attributes
    ----------
    name : str
    costs : dict of str to Cost
        Size, such as "480 x 320" -> the cost of scoring and pruning.
    """

    name: str
    costs: dict[str, Cost]


def scaled(views: ViewSet, width: int) -> ViewSet:
    """Return the same cameras with pictures of another width, pixels; heights in proportion.

    Examples
    --------
    >>> import numpy as np
    >>> from refine_addon.core.views import View, ViewSet
    >>> view = View(np.eye(3), np.zeros(3), 200.0, 200.0, 120.0, 80.0, 240, 160)
    >>> larger = scaled(ViewSet((view,)), 480)[0]
    >>> larger.width, larger.height, larger.fx, larger.cy
    (480, 320, 400.0, 160.0)
    """
    made = []
    for view in views:
        height = max(round(view.height * width / view.width), 1)
        across, down = width / view.width, height / view.height
        made.append(
            replace(
                view,
                width=width,
                height=height,
                fx=view.fx * across,
                cx=view.cx * across,
                fy=view.fy * down,
                cy=view.cy * down,
            )
        )
    return replace(views, views=tuple(made))


def measure(
    chosen: Sequence[Method], task: Task, timed: Callable[[Method, Task], Cost]
) -> list[Timed]:
    """Time methods by the cameras as they are and by the same with other widths.

    Parameters
    ----------
    chosen : sequence of Method
    task : Task
    timed : callable
        ``(method, task) -> Cost``.
    """
    sizes = [task.views]
    sizes += [scaled(task.views, width) for width in WIDTHS if width != task.views[0].width]
    lines = []
    for method in chosen:
        found = {
            f"{views[0].width} x {views[0].height}": timed(method, replace(task, views=views))
            for views in sizes
        }
        lines.append(Timed(method.name, found))
        seconds = ", ".join(f"{size}: {cost.seconds:.2f} s" for size, cost in found.items())
        print(f"  {method.name} {seconds}", flush=True)
    return lines
