"""Write the tutorials as notebooks next to this file: `python docs/notebooks/make.py`."""

import json
import re
from pathlib import Path

HERE = Path(__file__).parent
PAGES = ("tutorial", "tutorial-data")
BLOCK = re.compile(r"^```(\w*)\n(.*?)\n```\n", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\((?=[\w/-]+\.(md|ipynb|png))")  # pages are one folder up
KERNEL = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}


def notebook(page: Path) -> str:
    """Return a page as a notebook: blocks of Python as they are, of commands with a `!` a line, of text as prose."""
    parts = BLOCK.split(page.read_text(encoding="utf-8"))  # prose, language, block, prose, ...
    cells = [_cell(len(parts), "markdown", LINK.sub("](../", parts[-1].strip()))]
    for i in reversed(range(0, len(parts) - 1, 3)):
        prose, language, block = parts[i : i + 3]
        code = block if language == "python" else re.sub("^", "!", block, flags=re.MULTILINE)
        shown = _cell(i + 1, "markdown", f"```text\n{block}\n```") if language == "text" else _cell(i + 1, "code", code)
        cells += [shown, _cell(i, "markdown", LINK.sub("](../", prose.strip()))]
    cells = [cell for cell in reversed(cells) if cell["source"]]
    return json.dumps({"cells": cells, "metadata": KERNEL, "nbformat": 4, "nbformat_minor": 5}, indent=1) + "\n"


def _cell(i: int, kind: str, source: str) -> dict[str, object]:
    cell: dict[str, object] = {"cell_type": kind, "id": f"cell-{i}", "metadata": {}}
    return cell | ({"execution_count": None, "outputs": []} if kind == "code" else {}) | {"source": source}


if __name__ == "__main__":
    for name in PAGES:
        (HERE / f"{name}.ipynb").write_text(notebook(HERE.parent / f"{name}.md"), encoding="utf-8")
