"""Tables and pages as files: Markdown, CSV and LaTeX. The text around the tables is in `pages`."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import pandas as pd

from pipelines.engine.store import write_text
from pipelines.errors import PipelineError

SYMBOLS = {"±": "pm", "π": "pi", "↑": "uparrow", "↓": "downarrow", "○": "circ", "†": "dagger"}  # and LaTeX's names


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


def markdown_grid(head: Sequence[str], rows: Mapping[str, pd.DataFrame], lines: Mapping[str, str]) -> str:
    """Return a table of several lines a row, as `grid` has them."""
    return markdown_table([list(head), *([name, label, *texts] for name, label, texts in grid(rows, lines))])


def latex_grid(head: Sequence[str], rows: Mapping[str, pd.DataFrame], lines: Mapping[str, str]) -> str:
    """Return the same as a `tabular` (it needs booktabs)."""
    text = [rf"\begin{{tabular}}{{ll{'r' * (len(head) - 2)}}}", r"\toprule", _latex_row(map(tex, head)), r"\midrule"]
    for i, (name, label, texts) in enumerate(grid(rows, lines)):
        text += [r"\addlinespace"] if name and i else []
        text.append(_latex_row(map(tex, (name, label, *texts))))
    return "\n".join([*text, r"\bottomrule", r"\end{tabular}"]) + "\n"


def latex_notes(advice: str, markdown: str) -> str:
    """Return the notes below a page's first table as comments of LaTeX, the advice first."""
    notes = [advice, *re.findall(r"^\* (.*)", markdown.partition("\n## ")[0], re.M)]
    return "\n".join(f"% {note}" for note in notes) + "\n"


def grid(rows: Mapping[str, pd.DataFrame], lines: Mapping[str, str]) -> Iterator[tuple[str, str, list[str]]]:
    """Yield a row's name (on its first line alone), a line's label, and its texts, one a cell.

    Args:
        rows: the cells of each row, by its name.
        lines: the column of cells that a line shows, by its label; a line after the first is left out where it has
            nothing but empty texts and dashes.
    """
    for name, cells in rows.items():
        shown = {label: list(cells[column]) for label, column in lines.items()}
        for i, (label, texts) in enumerate(shown.items()):
            if not i or not {*texts} <= {"", "-"}:
                yield "" if i else name, label, texts


def tex(text: str) -> str:
    """Return plain text as LaTeX: special characters escaped, a minus sign before a number, symbols as mathematics."""
    text = re.sub(r"([&%$#_{}])", r"\\\1", text)
    text = re.sub(r"(?<!\w)-(?=\d)", "$-$", text)
    return "".join(f"$\\{SYMBOLS[each]}$" if each in SYMBOLS else each for each in text)


def _latex_row(texts: Iterable[str]) -> str:
    return " & ".join(texts) + r" \\"
