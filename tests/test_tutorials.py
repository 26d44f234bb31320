"""The tutorials do what they say: their Python and their commands are executed, in order, in one folder a page."""

import json
import re
import runpy
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
import torch

import otr
from tests.pipelines.conftest import otr_succeeds

DOCS = Path(__file__).parents[1] / "docs"
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)

torch.set_num_threads(1)


def blocks(page: Path) -> list[tuple[str, str]]:
    """Return the language and the text of a page's blocks, but for output, or of a notebook's cells of code."""
    if page.suffix == ".md":
        return [block for block in BLOCK.findall(page.read_text(encoding="utf-8")) if block[0] != "text"]
    cells = json.loads(page.read_text(encoding="utf-8"))["cells"]
    code = [cell["source"] for cell in cells if cell["cell_type"] == "code"]
    return [("", re.sub("^!", "", each, flags=re.M)) if each[0] == "!" else ("python", each) for each in code]


def execute(page: Path, folder: Path) -> dict:
    """Execute a page's blocks: Python with the names of the blocks before, commands in the folder; return the names."""
    names: dict = {}
    for language, block in blocks(page):
        if language == "python":
            exec(compile(block, str(page), "exec"), names)
            continue
        for line in block.splitlines():
            program, *words = shlex.split(line, comments=True)
            if program.startswith("otr-"):
                otr_succeeds(program, *words, cwd=folder)
            elif shutil.which(program):
                subprocess.run([program, *words], cwd=folder, check=True)
    return names


PAGE_AND_NOTEBOOK = pytest.mark.parametrize(
    "page", ["{}.md", pytest.param("notebooks/{}.ipynb", marks=pytest.mark.slow)]
)


@PAGE_AND_NOTEBOOK
def test_from_a_zip_to_c(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = execute(DOCS / page.format("tutorial"), tmp_path)
    net, better, played = names["net"], names["better"], names["played"]
    assert names["full"].n_leaves == 128 > names["tree"].n_leaves
    before, after = (otr.evaluate("CartPole-v1", each).mean_return for each in (net, better))
    assert after > before and after > 400
    assert (names["tree"].predict(played.states) == better.predict(played.states)).all()
    assert names["proof"].max_error < 1e-9 and names["short"].n_leaves <= 8
    assert (tmp_path / "policy.html").stat().st_size > 10_000 and "return" in (tmp_path / "policy.c").read_text()


@PAGE_AND_NOTEBOOK
def test_from_a_csv_to_a_tree(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names = execute(DOCS / page.format("tutorial-data"), tmp_path)
    X, y = names["X"][450:], names["y"][450:]
    assert names["one"].score(X, y) > max(0.97, names["many"].score(X, y))
    assert names["one"].tree_.n_leaves < names["many"].tree_.n_leaves
    assert "width" in capsys.readouterr().out
    (shown,) = re.findall(r"```text\n(.*?)```", (DOCS / "tutorial-data.md").read_text(encoding="utf-8"), re.DOTALL)
    read = otr.parse_program(shown, ["width", "height", "weight"], output_names=["no", "yes"], labels=True)
    assert (read.predict(X) == y).mean() > 0.97


@pytest.mark.parametrize("name", ["tutorial", "tutorial-data"])
def test_the_notebook_is_the_page(name: str) -> None:
    """So what the page does is what the notebook does; links and commands are written as notebooks need them."""
    make = runpy.run_path(str(DOCS / "notebooks/make.py"))
    text = (DOCS / f"notebooks/{name}.ipynb").read_text(encoding="utf-8")
    assert text == make["notebook"](DOCS / f"{name}.md"), "run python docs/notebooks/make.py"
    cells = json.loads(text)["cells"]
    pages_blocks = [block.rstrip("\n") for _, block in blocks(DOCS / f"{name}.md")]
    assert [block for _, block in blocks(DOCS / f"notebooks/{name}.ipynb")] == pages_blocks
    assert [link for cell in cells for link in re.findall(r"\]\(([^)#:]+)", cell["source"])
            if not (DOCS / "notebooks" / link).exists()] == []  # fmt: skip
