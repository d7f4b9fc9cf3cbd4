"""Where the tests find the repository, and the scenes in it."""

from pathlib import Path

ROOT = Path(__file__).parents[1]
DATA = ROOT / "tests/data"
ROOM = DATA / "room_small"
