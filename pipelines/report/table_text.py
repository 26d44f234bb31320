"""Tables as Markdown and LaTeX."""

import re
from collections.abc import Iterable, Sequence


def markdown_table(lines: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table of a head and rows, its columns padded so that it reads well as plain text too."""
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    padded = [[text.ljust(width) for text, width in zip(line, widths, strict=True)] for line in lines]
    padded.insert(1, ["-" * max(width, 3) for width in widths])
    return "\n".join(f"| {' | '.join(line)} |" for line in padded)


def latex_row(texts: Iterable[str]) -> str:
    """Return a row of a `tabular`."""
    return " & ".join(texts) + r" \\"


def tex(text: str) -> str:
    """Return plain text as LaTeX: special characters escaped, a minus sign before a number, ± and π as mathematics."""
    text = re.sub(r"([&%$#_{}])", r"\\\1", text)
    text = re.sub(r"(?<!\w)-(?=\d)", "$-$", text)
    return text.replace("±", r"$\pm$").replace("π", r"$\pi$")
