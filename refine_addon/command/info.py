"""What ``info`` does and says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..core import SplatFile, read_splats
from ..core.splats import drawable
from .run import Run


def info(run: Run) -> None:
    """Describe each input."""
    for source in run.options.inputs:
        run.attempt(str(source), lambda source=source: _info(run, source))


def _info(run: Run, source: Path) -> dict[str, Any]:
    facts = describe(read_splats(source))
    run.terminal.say(f"{source}")
    for name, value in facts.items():
        run.terminal.say(f"  {name.replace('_', ' '):18} {value}")
    return {"input": str(source), **facts}


def describe(file: SplatFile) -> dict[str, Any]:
    """Return what ``info`` says of a file: counts, degree, extent, rows that are not finite."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    whole = file.splats()
    broken = undrawable = 0
    for start in range(0, len(file), 1 << 16):
        piece = file.rows[start : start + (1 << 16)]
        splats = whole.take(slice(start, start + (1 << 16)))
        finite = np.ones(len(piece), np.bool_)
        for name in piece.dtype.names or ():
            finite &= np.isfinite(piece[name])
        broken += int(np.count_nonzero(~finite))
        undrawable += int(np.count_nonzero(~drawable(splats)))
        means = splats.means[np.isfinite(splats.means).all(axis=1)].astype(np.float64)
        low = np.minimum(low, means.min(axis=0, initial=np.inf))
        high = np.maximum(high, means.max(axis=0, initial=-np.inf))
    names = file.rows.dtype.names or ()
    average: float = file.row_bytes
    if file.origin is not None:
        average = round(file.stored_bytes / max(len(file), 1), 1)
    known = ("x", "y", "z", "nx", "ny", "nz", "opacity")
    extra = [n for n in names if n not in known and not n.startswith(("f_", "scale_", "rot_"))]
    return {
        "splats": len(file),
        "sh_degree": whole.sh_degree,
        "bytes": file.stored_bytes,
        "bytes_per_splat": average,
        "format": file.format,
        "model": file.model,
        "extent_low": low.tolist() if np.isfinite(low).all() else None,
        "extent_high": high.tolist() if np.isfinite(high).all() else None,
        "non_finite_rows": broken,
        "undrawable": undrawable,
        "extra_properties": extra,
        **({"notes": list(file.remarks)} if file.remarks else {}),
    }
