"""Scoring and pruning of 3D Gaussian splats on NumPy arrays, without Blender.

In short::

    splats = read_splats("scene.ply")
    result = prune(splats, read_cameras("cameras.json"), Budget(ratio=0.5), method=Merge())
    result.write("pruned.spz")
"""

from .cameras.read import read_cameras
from .cleaning.clean import REASONS, Cleaned, Cleaning, clean
from .errors import RefineError
from .execute import Cancelled
from .formats.ply import SplatFile, read_ply
from .formats.registry import read_splats, write_splats
from .lod import Level, Levels, lod, lod_file
from .methods import METHODS, ClosedForm, Merge, Method, Occlusion, Refit
from .operations import Move, clean_file, convert_files, prune_file, score_file
from .prune import prune, score
from .result import Result
from .scores import Scores
from .selection import Budget, rank, select
from .splats import Splats
from .tiles.prune import prune_tiles
from .views import View, ViewSet
from .volumes import Box, MovedVolume, Solid, Sphere, Zone, forced

__all__ = [
    "METHODS",
    "REASONS",
    "Box",
    "Budget",
    "Cancelled",
    "Cleaned",
    "Cleaning",
    "ClosedForm",
    "Level",
    "Levels",
    "Merge",
    "Method",
    "Move",
    "MovedVolume",
    "Occlusion",
    "RefineError",
    "Refit",
    "Result",
    "Scores",
    "Solid",
    "Sphere",
    "SplatFile",
    "Splats",
    "View",
    "ViewSet",
    "Zone",
    "clean",
    "clean_file",
    "convert_files",
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
    "score",
    "score_file",
    "select",
    "write_splats",
]
