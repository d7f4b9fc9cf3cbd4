"""Find what documents promise: examples in docstrings, and fenced blocks in Markdown."""

import doctest
import importlib
import re
from pathlib import Path
from typing import NamedTuple

_BLOCK = re.compile(r"(<!-- not run: [^\n]+ -->\n)?^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


class Block(NamedTuple):
    """A fenced block; excused where ``<!-- not run: REASON -->`` stands on the line before."""

    place: str
    language: str
    text: str
    excused: bool


def broken_promises(package: Path, name: str, *, but: str = " ") -> list[str]:
    """Return the modules below a package's folder whose examples give something else."""
    found = sorted(
        ".".join((name, *path.relative_to(package).with_suffix("").parts))
        for path in package.rglob("*.py")
        if ">>> " in path.read_text(encoding="utf-8")
    )
    tried = [module for module in found if but not in module]
    assert tried
    results = {module: doctest.testmod(importlib.import_module(module)) for module in tried}
    return [module for module, done in results.items() if done.failed or not done.attempted]


def blocks(document: Path) -> list[Block]:
    """Return the fenced blocks of a Markdown file, in order."""
    text = document.read_text(encoding="utf-8")
    return [
        Block(
            f"{document.name}:{text.count(chr(10), 0, at.start(2)) + 1}", at[2], at[3], bool(at[1])
        )
        for at in _BLOCK.finditer(text)
    ]
