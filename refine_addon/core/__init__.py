"""Scoring and pruning of 3D Gaussian splats on NumPy arrays, without Blender.

In short::

    file = read_splats("scene.ply")
    result = prune(file.splats(), read_cameras("cameras.json"), Budget(ratio=0.5))
    columns = survivor_columns(file.rows, result.absorbed)  # what survivors became
    file.write("pruned.ply", result.keep, columns=columns)
"""

from .cameras.read import read_cameras
from .cleaning.clean import REASONS, Cleaned, Cleaning, clean
from .errors import RefineError
from .execute import Cancelled
from .formats.ply import SplatFile, read_ply
from .formats.registry import read_splats, write_splats
from .levels.files import LevelsRequest, lod_file
from .levels.lod import Level, Levels, lod
from .operation.arranged import Arrangement, Move, convert_files
from .operation.files import file_to_file, prune_file
from .operation.requests import CleanRequest, ConvertRequest, PruneRequest, ScoreRequest
from .pipeline import prune, score
from .refit.refit import Refitted, refit, refit_rounds
from .scores import Scores
from .selection import Budget, rank, select
from .solid import Solid
from .splats import Splats
from .survivor_choice import CHOICES, SURVIVORS
from .survivors import survivor_columns
from .task import METHODS, Occlusion, Result, Settings
from .tiles.prune import prune_tiles
from .views import View, ViewSet
from .views_between import with_views_between
from .volumes import Box, MovedVolume, Sphere, Zone, forced

__all__ = [
    "CHOICES",
    "METHODS",
    "REASONS",
    "SURVIVORS",
    "Arrangement",
    "Box",
    "Budget",
    "Cancelled",
    "CleanRequest",
    "Cleaned",
    "Cleaning",
    "ConvertRequest",
    "Level",
    "Levels",
    "LevelsRequest",
    "Move",
    "MovedVolume",
    "Occlusion",
    "PruneRequest",
    "RefineError",
    "Refitted",
    "Result",
    "ScoreRequest",
    "Scores",
    "Settings",
    "Solid",
    "Sphere",
    "SplatFile",
    "Splats",
    "View",
    "ViewSet",
    "Zone",
    "clean",
    "convert_files",
    "file_to_file",
    "forced",
    "lod",
    "lod_file",
    "prune",
    "prune_file",
    "prune_tiles",
    "rank",
    "read_cameras",
    "read_ply",
    "read_splats",
    "refit",
    "refit_rounds",
    "score",
    "select",
    "survivor_columns",
    "with_views_between",
    "write_splats",
]
