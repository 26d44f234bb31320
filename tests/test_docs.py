"""What the documentation names exists: files, folders, names of `otr` and `pipelines`; the site has every page."""

import ast
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from statistics import median

import pytest

import otr

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("benchmarks/*.md")])
MODULES = sorted([*ROOT.glob("otr/**/*.py"), *ROOT.glob("pipelines/**/*.py"), *ROOT.glob("benchmarks/*.py")])
FOLDERS = "otr|pipelines|tests|conf|benchmarks|results|docs"
PATH = re.compile(rf"(?<![\w./~-])(?:{FOLDERS})/[\w./-]*[\w/]")
NAME = re.compile(r"(?<![\w./`-])`?((?:otr|pipelines|benchmarks)(?:\.[A-Za-z_]\w*)+)")
LINK = re.compile(r"\]\(([^)#\s]+)\)")
# Written when commands run.
MADE = ("results/runs/", "results/local", "results/sweeps", "results/failures", "results/checkpoints", "results/smoke",
        "results/tensorboard", "results/data", "results/benchmarks/quick", "results/tables/runs",
        "results/tables/fits", "results/page.html")  # fmt: skip


# What is no prose: code, tables, headings, pictures, footnotes' marks.
NO_PROSE = re.compile(r"^```.*?^```|^[ \t]*(?:[|#<]|!\[|:::)[^\n]*", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"(?<![\w.])-?(?:\d[\d,]*(?:\.\d+)?|\.\d+)")


def paragraphs(page: Path) -> list[str]:
    """Return a page's paragraphs and items of lists, without what stands in code and where links lead."""
    text = re.sub(r"`[^`]*`", "`", re.sub(r"\]\([^)]*\)", "]", NO_PROSE.sub("\n", page.read_text(encoding="utf-8"))))
    parts = re.split(r"\n\s*\n|\n(?=\s*[*-] |\d+\. )", text)
    return [" ".join(part.split()).lstrip("*- ") for part in parts if part.strip()]


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if page.is_relative_to(ROOT / "docs")] + [ROOT / "README.md"],
    ids=lambda path: path.relative_to(ROOT).as_posix(),
)
def test_sentences_are_short_and_numbers_are_in_tables(page):
    """A sentence has 20 words in the median, and a paragraph at most six numbers."""
    sentences = [each for part in paragraphs(page) for each in re.split(r"(?<=[.!?])\**\s+(?=[A-Z`*\[(])", part)]
    assert median(len(re.findall(r"[\w`]\S*", sentence)) for sentence in sentences) <= 20
    assert [part for part in paragraphs(page) if len(NUMBER.findall(part)) > 6] == []


def docstrings(module: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield ast.get_docstring(node) or ""


def text_of(file: Path) -> str:
    if file.suffix == ".md":
        return file.read_text(encoding="utf-8")
    return "\n".join(docstrings(file))


def exists(name: str) -> bool:
    """Return whether a dotted name leads somewhere: a module, or an attribute of one, as far down as it goes."""
    module, *rest = name.split(".")
    found = import_module(module)
    for i, part in enumerate(rest):
        if not hasattr(found, part):
            try:
                found = import_module(".".join([module, *rest[: i + 1]]))
                continue
            except ImportError:
                annotations = getattr(found, "__annotations__", {})  # a dataclass's field has no value on the class
                return part in annotations and i == len(rest) - 1
        found = getattr(found, part)
    return True


@pytest.mark.parametrize("file", [*PAGES, *MODULES], ids=lambda path: path.relative_to(ROOT).as_posix())
def test_what_is_named_exists(file):
    text = re.sub(r"otr([./])pipelines", r"pipelines", text_of(file))  # as a wheel has it
    named = [path for path in PATH.findall(text) if not path.startswith(MADE) and "..." not in path]
    named = [path for path in named if not re.search("[*<{]|/[0-9]$", path)]
    assert [path for path in named if not any(True for _ in ROOT.glob(path.rstrip("/.")))] == []
    if file.suffix == ".md":
        links = [link for link in LINK.findall(text) if "://" not in link]
        assert [link for link in links if not (file.parent / link).exists()] == []
    names = {re.sub(r"\.(py|md|yaml|json|toml|csv)$", "", name) for name in NAME.findall(text)}
    assert [name for name in sorted(names) if not exists(name)] == []


def test_the_api_reference_has_every_public_name_once():
    named = re.findall(r"^::: otr\.([\w.]+)$", (ROOT / "docs/api.md").read_text(encoding="utf-8"), re.MULTILINE)
    learners = [f"learners.{otr.learners._MODULES[name]}.{name}" for name in otr.learners.__all__]
    assert sorted(named) == sorted([*otr.__all__, *learners])


def test_the_site_leads_to_every_page():
    nav = re.findall(r": ([\w/.-]+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    pages = [page.relative_to(ROOT / "docs").as_posix() for page in ROOT.glob("docs/**/*.md")]
    assert sorted(page for page in nav if not page.startswith("repository/")) == sorted([*pages, "index.md"])
