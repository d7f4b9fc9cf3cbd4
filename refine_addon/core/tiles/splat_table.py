"""Splats as one table of numbers, as the folder of a job holds them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..splats import Splats

if TYPE_CHECKING:
    from numpy.typing import NDArray


def packed(splats: Splats) -> NDArray[np.float64]:
    """Return splats as one table, (n, 14 + 3 K), for harmonics of K coefficients a channel."""
    count = len(splats)
    columns = [splats.means, splats.log_scales, splats.quaternions]
    columns += [splats.opacity_logits[:, None], splats.sh_dc, splats.sh_rest.reshape(count, -1)]
    with np.errstate(invalid="ignore"):  # signalling NaN
        return np.concatenate([np.asarray(values, np.float64) for values in columns], axis=1)


def unpacked(table: NDArray[np.float64]) -> Splats:
    """Return the splats of a table, in float64."""
    means, scales, quaternions, logits, constant, rest = np.split(table, [3, 6, 10, 11, 14], axis=1)
    harmonics = rest.reshape(len(table), rest.shape[1] // 3, 3)
    return Splats(means, scales, quaternions, logits[:, 0], constant, harmonics)
