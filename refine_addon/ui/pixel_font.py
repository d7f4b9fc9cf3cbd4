"""Letters for pictures made of arrays: the few that the chart needs, 7 pixels high.

A chart in a panel is an image, and Blender 4.2 to 4.5 hand out no pixels of text that they draw.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

HEIGHT = 9
"""Rows of a line of text: 7 above the baseline and 2 below."""

_SPACE = 3  # columns

_SHAPES = (
    """
    0     1   2    3    4    5    6    7    8    9    %     .
    .##.  .#  .##. ###. ..#. #### .##. #### .##. .##. ##..# .
    #..#  ##  #..# ...# .##. #... #... ...# #..# #..# ##..# .
    #..#  .#  ...# ...# #.#. ###. ###. ..#. #..# #..# ...#. .
    #..#  .#  ..#. .##. #.#. ...# #..# ..#. .##. #..# ..#.. .
    #..#  .#  .#.. ...# #### ...# #..# .#.. #..# .### .#... .
    #..#  .#  #... ...# ..#. #..# #..# .#.. #..# ...# #..## .
    .##.  .#  #### ###. ..#. .##. .##. .#.. .##. .##. #..## #
    ....  ..  .... .... .... .... .... .... .... .... ..... .
    ....  ..  .... .... .... .... .... .... .... .... ..... .
    """,
    """
    B    a    b    c    d    e    f   g    i l m     n    o
    ###. .... #... .... ...# .... .## .... # # ..... .... ....
    #..# .... #... .... ...# .... #.. .... . # ..... .... ....
    #..# .##. ###. .##. .### .##. ### .### # # ##.#. ###. .##.
    ###. ...# #..# #... #..# #..# #.. #..# # # #.#.# #..# #..#
    #..# .### #..# #... #..# #### #.. #..# # # #.#.# #..# #..#
    #..# #..# #..# #... #..# #... #.. #..# # # #.#.# #..# #..#
    ###. .### ###. .##. .### .##. #.. .### # # #.#.# #..# .##.
    .... .... .... .... .... .... ... ...# . . ..... .... ....
    .... .... .... .... .... .... ... .##. . . ..... .... ....
    """,
    """
    p    r   s    t   v     w     y    -   h    u    z    +
    .... ... .... .#. ..... ..... .... ... #... .... .... ...
    .... ... .... .#. ..... ..... .... ... #... .... .... ...
    ###. #.# .### ### #...# #...# #..# ... ###. #..# #### ...
    #..# ##. #... .#. #...# #.#.# #..# ### #..# #..# ...# .#.
    #..# #.. .##. .#. .#.#. #.#.# #..# ... #..# #..# .##. ###
    #..# #.. ...# .#. .#.#. #.#.# #..# ... #..# #..# #... .#.
    ###. #.. ###. .## ..#.. .#.#. .### ... #..# .### #### ...
    #... ... .... ... ..... ..... ...# ... .... .... .... ...
    #... ... .... ... ..... ..... .##. ... .... .... .... ...
    """,
)


def drawn(text: str) -> NDArray[np.bool_]:
    """Return a line of text, (HEIGHT, W), upper row first: which pixels are set.

    Examples
    --------
    >>> drawn("1").sum(), drawn("11").shape
    (8, (9, 5))
    """
    gap = np.zeros((HEIGHT, 1), np.bool_)
    pieces = [piece for letter in text for piece in (_letters()[letter], gap)]
    return np.concatenate(pieces[:-1] or [gap[:, :0]], axis=1)


@cache
def _letters() -> dict[str, NDArray[np.bool_]]:
    """Return each character's pixels, (HEIGHT, its own width)."""
    letters = {" ": np.zeros((HEIGHT, _SPACE), np.bool_)}
    for band in _SHAPES:
        names, *rows = (line.split() for line in band.strip().splitlines())
        for name, cells in zip(names, zip(*rows, strict=True), strict=True):
            letters[name] = np.array([[mark == "#" for mark in cell] for cell in cells])
    return letters
