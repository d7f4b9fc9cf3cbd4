"""``python -m refine_addon``: the command without Blender."""

import sys

from .command import main

sys.exit(main(sys.argv[1:]))
