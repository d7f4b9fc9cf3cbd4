"""Scoring and pruning of 3D Gaussian splats on NumPy arrays, without Blender.

In short::

    splats = read_splats("scene.ply")
    result = prune(splats, read_cameras("cameras.json"), Budget(ratio=0.5), method=Merge())
    result.write("pruned.spz")
"""

from .cameras.read import read_cameras as read_cameras
from .cleaning.clean import REASONS as REASONS
from .cleaning.clean import Cleaned as Cleaned
from .cleaning.clean import Cleaning as Cleaning
from .cleaning.clean import clean as clean
from .errors import RefineError as RefineError
from .execute import Cancelled as Cancelled
from .formats.ply import SplatFile as SplatFile
from .formats.ply import read_ply as read_ply
from .formats.registry import read_splats as read_splats
from .formats.registry import write_splats as write_splats
from .lod import Level as Level
from .lod import Levels as Levels
from .lod import lod as lod
from .lod import lod_file as lod_file
from .methods import METHODS as METHODS
from .methods import ClosedForm as ClosedForm
from .methods import Merge as Merge
from .methods import Method as Method
from .methods import Occlusion as Occlusion
from .methods import Refit as Refit
from .operations import clean_file as clean_file
from .operations import convert_files as convert_files
from .operations import prune_file as prune_file
from .operations import score_file as score_file
from .prune import prune as prune
from .prune import score as score
from .result import Result as Result
from .scores import Scores as Scores
from .selection import Budget as Budget
from .selection import rank as rank
from .selection import select as select
from .splats import Splats as Splats
from .tiles.prune import prune_tiles as prune_tiles
from .views import View as View
from .views import ViewSet as ViewSet
from .volumes import Box as Box
from .volumes import MovedVolume as MovedVolume
from .volumes import Solid as Solid
from .volumes import Sphere as Sphere
from .volumes import Zone as Zone
from .volumes import forced as forced
