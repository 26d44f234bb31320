"""Tables and pages as files: Markdown, CSV and LaTeX. The text around the tables is in `pages`."""

import re
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import pandas as pd

from pipelines.engine.store import write_text
from pipelines.errors import PipelineError


def write_tables(results_dir: Path, name: str, frame: pd.DataFrame, markdown: str, latex: str = "") -> list[Path]:
    """Write a table under `results_dir/tables` and return its Markdown, its CSV and, where there is one, its LaTeX."""
    texts = {"md": markdown, "csv": csv_text(frame), "tex": latex}
    return [write_file(results_dir / "tables" / f"{name}.{ending}", text) for ending, text in texts.items() if text]


def write_file(path: Path, text: str) -> Path:
    """Write a text, making its folder, and return its path; PipelineError where it cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, text)
    except OSError as error:
        raise PipelineError(f"{path}: cannot be written ({error.strerror})") from error
    return path


def page(name: str, **parts: Any) -> str:
    """Return a page of `pages` with its parts filled in."""
    text = (resources.files("pipelines.report") / "pages" / name).read_text(encoding="utf-8")
    return text.format(**parts).rstrip("\n") + "\n"


def csv_text(frame: pd.DataFrame) -> str:
    """Return a frame as CSV; what there is not is empty, and floats keep every digit that they have."""
    return str(frame.to_csv(index=False, lineterminator="\n"))


def markdown_table(lines: Sequence[Sequence[str]], empty: str = "") -> str:
    """Return a Markdown table of a head and rows, its columns padded; `empty` where there are no rows."""
    if empty and len(lines) == 1:
        return empty
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    padded = [[text.ljust(width) for text, width in zip(line, widths, strict=True)] for line in lines]
    padded.insert(1, ["-" * max(width, 3) for width in widths])
    return "\n".join(f"| {' | '.join(line)} |" for line in padded)


def markdown_cell(cell: Any) -> str:
    """Return what is ours of a cell and its runs."""
    return f"{cell.ours} ({cell.runs})" if cell.runs else str(cell.ours)


def markdown_grid(head: Sequence[str], rows: Mapping[str, pd.DataFrame]) -> str:
    """Return a table of two lines a row, ours and the thesis's, which is left out where it has none of them."""
    lines = [head]
    for name, cells in rows.items():
        lines.append([name, "ours", *map(markdown_cell, cells.itertuples())])
        if (cells["thesis"] != "-").any():
            lines.append(["", "thesis", *cells["thesis"]])
    return markdown_table(lines)


def latex_grid(advice: str, markdown: str, head: Sequence[str], rows: Mapping[str, pd.DataFrame]) -> str:
    """Return the same as a `tabular` (it needs booktabs), the notes below the Markdown table as comments before it."""
    notes = [advice, *re.findall(r"^\* (.*)", markdown.partition("\n## ")[0], re.M)]
    lines = [*(f"% {note}" for note in notes), rf"\begin{{tabular}}{{ll{'r' * (len(head) - 2)}}}", r"\toprule"]
    lines.append(_latex_row([tex(name) for name in head]))
    for i, (name, cells) in enumerate(rows.items()):
        lines.append(r"\addlinespace" if i else r"\midrule")
        lines.append(_latex_row([tex(name), "ours", *map(tex, cells["ours"])]))
        if cells["runs"].any():
            lines.append(
                _latex_row(["", "", *(rf"{{\scriptsize {tex(runs)}}}" if runs else "" for runs in cells["runs"])])
            )
        if (cells["thesis"] != "-").any():
            lines.append(_latex_row(["", "thesis", *map(tex, cells["thesis"])]))
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def tex(text: str) -> str:
    """Return plain text as LaTeX: special characters escaped, a minus sign before a number, ± and π as mathematics."""
    text = re.sub(r"([&%$#_{}])", r"\\\1", text)
    return re.sub(r"(?<!\w)-(?=\d)", "$-$", text).replace("±", r"$\pm$").replace("π", r"$\pi$")


def _latex_row(texts: Iterable[str]) -> str:
    return " & ".join(texts) + r" \\"
