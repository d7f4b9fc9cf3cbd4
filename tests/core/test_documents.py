"""What the documents name is there: files, links, tests."""

import re

import pytest

from tests.places import ROOT

DOCUMENTS = sorted(
    path
    for folder in (ROOT, ROOT / "docs", ROOT / "benchmarks", ROOT / "tests/e2e")
    for path in folder.glob("*.md")
)
FILES = [
    "/" + path.relative_to(ROOT).as_posix()
    for folder in ("refine_addon", "benchmarks", "tests", "docs", ".ci")
    for path in (ROOT / folder).rglob("*")
    if path.is_file()
] + ["/" + path.name for path in ROOT.iterdir() if path.is_file()]
TESTS = {
    name
    for path in (ROOT / "tests").rglob("test_*.py")
    for name in re.findall(r"^def (test_\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)
}


PROSE = [path for path in DOCUMENTS if path.name not in {"trade.md", "CHANGELOG.md"}]
"""Documents but the generated one, and the one in which an entry is a line."""


def place(path):
    return path.relative_to(ROOT).as_posix()


@pytest.fixture(params=DOCUMENTS, ids=place)
def document(request):
    return request.param


def test_every_file_folder_name_and_test_that_is_named_exists(document):
    """In backquotes, from any folder on: ``core/views.py::View`` is defined in that file of ours.

    ``test_x_...`` stands for a test whose name begins so.
    """
    text = document.read_text(encoding="utf-8")
    files = re.findall(r"`([\w./-]+\.py|(?:refine_addon|benchmarks|tests)/[\w/]*)(?:::\w+)?`", text)
    names = re.findall(r"`([\w./-]+\.py)::(\w+?)(_\.\.\.)?`", text)
    tests = re.findall(r"`(?:test_\w+\.py::)?(test_\w+?)(_\.\.\.)?`", text)

    assert [name for name in files if not any(_names(name, file) for file in FILES)] == []
    assert [name for name in names if not _defined(*name)] == []
    begun = [name for name, cut in tests if not (cut and any(t.startswith(name) for t in TESTS))]
    assert [name for name in begun if name not in TESTS] == []


def _names(name: str, file: str) -> bool:
    return file.endswith("/" + name) or (not name.endswith(".py") and file.startswith("/" + name))


def _defined(path: str, name: str, cut: str) -> bool:
    """Say whether a file defines a class, function, method, constant or test of that name."""
    pattern = rf"^\s*(?:def|class) {name}{'' if cut else chr(92) + 'b'}|^(?:\w+, )*{name}\b.* = "
    sources = [ROOT / file[1:] for file in FILES if file.endswith("/" + path)]
    return any(re.search(pattern, each.read_text("utf-8"), re.MULTILINE) for each in sources)


def test_every_class_that_the_architecture_names_is_defined():
    """In backquotes, as ``RowBlock`` or ``ViewSet.middle``."""
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    sources = "\n".join(path.read_text("utf-8") for path in (ROOT / "refine_addon").rglob("*.py"))
    defined = set(re.findall(r"^(?:class )?(\w+)(?: = |[(:\[])", sources, re.MULTILINE))

    named = set(re.findall(r"`([A-Z][a-z]+[A-Za-z]*)(?:\.\w+)?`", text))

    assert named
    assert named - defined == set()


def test_every_link_leads_somewhere(document):
    """To a file, and to a heading of it where one is named."""
    for target in re.findall(r"\]\(([^)]+)\)", document.read_text(encoding="utf-8")):
        if re.match(r"https?:", target):
            continue
        path, _, heading = target.partition("#")
        file = document.parent / path if path else document
        assert file.exists(), target
        if heading:
            lines = file.read_text(encoding="utf-8").splitlines()
            headings = [line.lstrip("# ").lower() for line in lines if line.startswith("#")]
            assert heading in [re.sub(r"[^\w -]", "", line).replace(" ", "-") for line in headings]


@pytest.mark.parametrize("document", PROSE, ids=place)
def test_lines_end_where_sentences_do(document):
    """So a change of a sentence is a change of its line. Tables and fenced blocks are as they are.

    A bold heading, a date or a list's number may stand before a sentence.
    """
    text = document.read_text(encoding="utf-8")
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    lines = [line for line in text.splitlines() if not line.startswith(("|", "#", "    ", "!["))]
    begun = re.compile(r"^\s*(?:- |\d+\. )?(?:\*\*[^*]+\*\*|\d{4}-\d\d-\d\d\.)?")
    plain = [re.sub(r"`[^`]*`", "x", begun.sub("", line)) for line in lines]

    assert [line for line in plain if re.search(r'(?<!Eq)[.!?][)"*]* +["(*[]*[A-Z]', line)] == []
