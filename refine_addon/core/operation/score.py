"""Scoring a file."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..report import scoring_notes, seen_by
from ..score_splats import score
from ..task import DEFAULTS, Settings
from ..whole_file import expanded
from ..work import Progress, silent
from .files import FileSink, FileSource
from .run import DECIDED, Request, run

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from ..scores import Scores
    from ..views import ViewSet
    from ..volumes import Zone
    from .files import Choice
    from .loaded import Loaded
    from .run import Runtime

PROPERTY = "refine_score"
"""The property of a PLY that holds the scores."""


@dataclass(frozen=True, eq=False)
class Scored:
    """All splats, with their scores.

    Attributes
    ----------
    scores : Scores
    report : dict
    """

    scores: Scores
    report: dict[str, Any]

    @property
    def keep(self) -> NDArray[np.bool_]:
        """All splats stay, (N,)."""
        return np.ones(len(self.scores.values), np.bool_)

    @property
    def absorbed(self) -> None:
        """Nothing is absorbed."""
        return


@dataclass(frozen=True, eq=False)
class ScoreRequest(Request["Loaded", Scored]):
    """What is asked of a scoring.

    Attributes
    ----------
    views : ViewSet
        Those that decide.
    settings : Settings
        How to score.
    zones : sequence of Zone
        Volumes that say which splats must go: these score 0.
    overwrite : bool
        Whether a file may be replaced.
    """

    views: ViewSet
    settings: Settings = DEFAULTS
    zones: Sequence[Zone] = ()
    overwrite: bool = False

    def decide(self, loaded: Loaded, runtime: Runtime) -> Scored:
        """Return the scores.

        Raises
        ------
        RefineError, Cancelled
            See `score_splats.score`.
        """
        forced = loaded.forced
        scores = score(
            loaded.splats, self.views, self.settings,
            protected=forced.protected, removed=forced.removed,
            progress=runtime.part(0.0, DECIDED).progress, threads=runtime.threads,
        )  # fmt: skip
        runtime.clock.lap("score_s")
        facts: dict[str, Any] = seen_by(scores)
        facts["splats"]["forced"] = forced.counts()["forced"]
        facts["splats"]["unseen"] -= facts["splats"]["forced"]
        facts |= {
            "settings": asdict(self.settings),
            "volumes": loaded.volumes,
            "weights": scores.facts,
            "notes": scoring_notes(scores),
        }
        return Scored(scores, facts)


@dataclass(frozen=True)
class ScoreSink(FileSink):
    """A PLY with the property `PROPERTY`."""

    def columns(self, _loaded: Loaded, scored: Choice) -> dict[str, NDArray[Any]]:
        """Return the scores."""
        assert isinstance(scored, Scored)  # noqa: S101 - for the type checker
        return {PROPERTY: scored.scores.values}


def score_file(
    source: Path | str,
    output: Path | str,
    request: ScoreRequest,
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> Scored:
    """Score a file of splats, and write a PLY of them with their scores.

    Parameters
    ----------
    source, output, progress, threads
        See `prune_file`.
    request : ScoreRequest
        What is asked.

    Raises
    ------
    RefineError, Cancelled
        See `run`; also if `output` is no PLY.
    """
    sink = ScoreSink(expanded(output), source=expanded(source), overwrite=request.overwrite)
    return run(FileSource(source, request.zones), request, sink, progress=progress, threads=threads)
