"""What may be asked of splats in memory, and how it is decided."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cleaning.clean import Cleaned, Cleaning, clean
from ..costs import Cost, Plan, joined
from ..formats.format import Format
from ..formats.registry import refuse_unknown_size
from ..pace import phases
from ..picture_files import PictureFiles, chosen
from ..pipeline import decide, planned, score, scoring_plans
from ..rendering import Model
from ..report import kept_and_removed, prices, scoring_notes, seen_by, what_was_seen
from ..selection import Budget
from ..survivor_choice import SurvivorChoice, refuse_unknown
from ..task import DEFAULTS, Result, Settings, Task, may_absorb
from ..views import ViewSet
from ..volumes import Zone
from .loaded import Loaded
from .run import Request, Runtime
from .written import written_facts, written_splats

PROPERTY = "refine_score"
"""The property of a PLY that holds the scores."""


@dataclass(frozen=True, eq=False)
class PruneRequest(Request["Loaded", "Result"]):
    """What is asked of a prune.

    Attributes
    ----------
    views : ViewSet
        Those that decide.
    budget : Budget
        How much goes.
    settings : Settings
        How to score.
    zones, overwrite, dry_run, model
        See `Request`.
    survivors : {"auto", "unchanged", "absorb", "refit"}
        What survivors may become; see `Task`.
    cleaning : Cleaning or None
        What to clean away first. The budget then counts what is left.
    pictures : PictureFiles or None
        Where pictures before and after go; none are drawn without it.
    """

    views: ViewSet
    budget: Budget
    settings: Settings = DEFAULTS
    zones: Sequence[Zone] = ()
    survivors: SurvivorChoice = "auto"
    cleaning: Cleaning | None = None
    pictures: PictureFiles | None = None
    overwrite: bool = False
    model: Model | None = None
    dry_run: bool = False

    def __post_init__(self) -> None:
        """Check what survivors may become."""
        refuse_unknown(self.survivors)

    @property
    def absorb(self) -> bool:
        """Whether survivors may absorb the splats that are removed."""
        return may_absorb(self.survivors, self.settings, self.budget)

    @property
    def compares_pictures(self) -> bool:
        """Whether colours as each view sees them are needed, for an estimate or for pictures."""
        estimates = self.settings.estimates or self.budget.psnr is not None
        return estimates or self.pictures is not None

    @contextlib.contextmanager
    def opened(self, form: Format | None) -> Iterator[None]:
        """Refuse a size in a format that has none beforehand, and pictures that cannot be written.

        Parameters
        ----------
        form : Format or None
            Of the output.

        Raises
        ------
        RefineError
        """
        if self.budget.max_mb is not None and form is not None:
            refuse_unknown_size(form)
        with contextlib.ExitStack() as held:
            if self.pictures is not None:
                held.enter_context(self.pictures.opened(self.views))
            yield

    def costs(self, loaded: Loaded) -> list[Plan]:
        """Return what the steps are expected to cost; see `Request.costs`."""
        cleaning, deciding = self._costs(loaded)
        pictures = []
        if self.pictures is not None:
            drawn = 2 * len(chosen(self.views))
            pictures = [Cost("drawing", len(loaded.splats), drawn)]
        writing = Cost("rewriting" if self.absorb else "writing", loaded.bytes)
        return [[*cleaning, *deciding], [writing], pictures]

    def _costs(self, loaded: Loaded) -> tuple[Plan, Plan]:
        """Return what cleaning and deciding are expected to cost."""
        deciding = planned(self._task(loaded))
        if self.cleaning is None:
            return [], deciding
        views = self.views.spread(self.cleaning.views)
        return [Cost("cleaning", len(loaded.splats), len(views))], deciding

    def decide(self, loaded: Loaded, runtime: Runtime) -> Result:
        """Return which splats stay, and what they become: clean, then `pipeline.decide`.

        Raises
        ------
        RefineError, Cancelled
            See `clean` and `pipeline.decide`.
        """
        if self.cleaning is None:
            return self._decide(loaded, runtime)
        forced = loaded.forced
        cleaning, deciding = (
            replace(runtime, progress=phase)
            for phase in phases(runtime.progress, *self._costs(loaded))
        )
        cleaned = _cleaned(loaded, self.views, self.cleaning, cleaning)
        # The budget counts what is forced out as removed, so that is not cleaned away.
        left = cleaned.keep if forced.out is None else cleaned.keep | forced.out
        result = self._decide(loaded.take(left), deciding).for_all(left)
        result.report["cleaned"] = cleaned.facts()
        return result

    def _task(self, loaded: Loaded) -> Task:
        """Return what is to be decided of what was loaded."""
        return Task(
            budget=self.budget,
            settings=self.settings,
            splats=loaded.splats,
            views=self.views,
            protected=loaded.forced.protected,
            forced_out=loaded.forced.out,
            survivors=self.survivors,
            row_bytes=loaded.sizes.row,
            fixed_bytes=loaded.sizes.fixed,
            reusable=loaded.reusable,
        )

    def _decide(self, loaded: Loaded, runtime: Runtime) -> Result:
        """Decide on what cleaning left."""
        result = decide(
            self._task(loaded),
            clock=runtime.clock,
            progress=runtime.progress,
            threads=runtime.threads,
        )
        result.report["volumes"] = loaded.volumes
        return result

    def compare(
        self, loaded: Loaded, result: Result, path: Path | None, runtime: Runtime
    ) -> dict[str, Any]:
        """Return what a lossy format costs, and what was measured in pictures.

        Parameters
        ----------
        loaded : Loaded
        result : Result
            What was decided of them.
        path : Path or None
            The file that holds what stays, if one was written.
        runtime : Runtime

        Raises
        ------
        RefineError, Cancelled
            See `PictureFiles.write`; by then the splats are written.
        """
        facts: dict[str, Any] = {}
        if path is not None:
            used = self.views.spread(self.settings.views)
            facts |= written_facts(
                path, result.scores, used, matrix=loaded.matrix, threads=runtime.threads
            )
        if self.pictures is not None:
            after = None if path is None else written_splats(path, loaded.matrix)
            after = result.survivors(loaded.splats) if after is None else after
            facts["pictures"] = self.pictures.write(
                loaded.splats, after, self.views,
                progress=runtime.progress, threads=runtime.threads,
            )  # fmt: skip
            runtime.clock.lap("pictures_s")
        return facts


def _cleaned(loaded: Loaded, views: ViewSet, cleaning: Cleaning, runtime: Runtime) -> Cleaned:
    """Clean what was loaded, but for what must stay and what must go."""
    cleaned = clean(
        loaded.splats, views, cleaning,
        protected=loaded.forced.protected, forced_out=loaded.forced.out,
        progress=runtime.progress, threads=runtime.threads,
    )  # fmt: skip
    runtime.clock.lap("clean_s")
    return cleaned


@dataclass(frozen=True, eq=False)
class Kept:
    """Which splats stay, all as they were.

    Attributes
    ----------
    keep : (N,) bool
    report : dict
    columns : dict of str to (N,)
        Properties that are written otherwise than they are stored.
    """

    keep: NDArray[np.bool_]
    report: dict[str, Any]
    columns: dict[str, NDArray[Any]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class CleanRequest(Request["Loaded", Kept]):
    """What is asked of a cleaning.

    Attributes
    ----------
    views : ViewSet
        Those that decide.
    cleaning : Cleaning
        What to clean away.
    zones, overwrite, model
        See `Request`.
    """

    views: ViewSet
    cleaning: Cleaning = field(default_factory=Cleaning)
    zones: Sequence[Zone] = ()
    overwrite: bool = False
    model: Model | None = None

    def costs(self, loaded: Loaded) -> list[Plan]:
        """Return what the steps are expected to cost; see `Request.costs`."""
        views = len(self.views.spread(self.cleaning.views))
        cleaning = Cost("cleaning", len(loaded.splats), views)
        return [[cleaning], [Cost("writing", loaded.bytes)], []]

    def decide(self, loaded: Loaded, runtime: Runtime) -> Kept:
        """Return what `clean` leaves.

        Raises
        ------
        RefineError, Cancelled
            See `clean`.
        """
        forced = loaded.forced
        cleaned = _cleaned(loaded, self.views, self.cleaning, runtime)
        facts: dict[str, Any] = what_was_seen(
            cleaned.seen, cleaned.undrawable, cleaned.views_given, cleaned.views_used
        )
        facts["splats"] |= kept_and_removed(cleaned.keep) | forced.counts()
        facts["splats"]["unseen"] -= facts["splats"]["forced"]
        facts |= {
            "settings": asdict(self.cleaning),
            "volumes": loaded.volumes,
            "cleaned": cleaned.facts(),
            "notes": cleaned.notes(),
        }
        return Kept(cleaned.keep, facts)


@dataclass(frozen=True, eq=False)
class ScoreRequest(Request["Loaded", Kept]):
    """What is asked of a scoring.

    Attributes
    ----------
    views : ViewSet
        Those that decide.
    settings : Settings
        How to score.
    zones, overwrite, model
        See `Request`. What must go scores 0.
    """

    views: ViewSet
    settings: Settings = DEFAULTS
    zones: Sequence[Zone] = ()
    overwrite: bool = False
    model: Model | None = None

    def costs(self, loaded: Loaded) -> list[Plan]:
        """Return what the steps are expected to cost; see `Request.costs`."""
        plans = scoring_plans(loaded.splats, self.views, self.settings, None, quality=False)
        return [joined(plans), [Cost("writing", loaded.bytes)], []]

    def decide(self, loaded: Loaded, runtime: Runtime) -> Kept:
        """Return all splats, with their scores as a property.

        Raises
        ------
        RefineError, Cancelled
            See `pipeline.score`.
        """
        forced = loaded.forced
        scores = score(
            loaded.splats, self.views, self.settings,
            protected=forced.protected, forced_out=forced.out,
            progress=runtime.progress, threads=runtime.threads,
        )  # fmt: skip
        runtime.clock.lap("score_s")
        facts: dict[str, Any] = seen_by(scores)
        facts["splats"]["forced"] = forced.counts()["forced"]
        facts["splats"]["unseen"] -= facts["splats"]["forced"]
        facts |= {
            "settings": asdict(self.settings),
            "volumes": loaded.volumes,
            "weights": scores.facts,
            "prices": prices(scores, runtime.clock.timings["score_s"]),
            "notes": scoring_notes(scores),
        }
        keep = np.ones(len(loaded.splats), np.bool_)
        return Kept(keep, facts, {PROPERTY: scores.values})


@dataclass(frozen=True)
class ConvertRequest(Request["Loaded", Kept]):
    """That all splats stay, in the format of the output.

    Attributes
    ----------
    overwrite, model
        See `Request`.
    """

    overwrite: bool = False
    model: Model | None = None

    def costs(self, loaded: Loaded) -> list[Plan]:
        """Return what the steps are expected to cost; see `Request.costs`."""
        return [[], [Cost("writing", loaded.bytes)], []]

    def decide(self, loaded: Loaded, _runtime: Runtime) -> Kept:
        """Return all splats."""
        count = len(loaded.splats)
        return Kept(np.ones(count, np.bool_), {"splats": {"before": count}, "notes": []})
