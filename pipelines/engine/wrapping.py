"""Text wrapped to the width of a terminal; other outputs get whole lines."""

import re
import shutil
import sys
import textwrap
from typing import TextIO

TOGETHER = "\x1f"  # for a space at which no line ends
UNLIMITED = 10_000  # columns, of what is no terminal


def columns(stream: TextIO | None = None) -> int:
    """Return the columns of the terminal that a stream, by default stdout, is; UNLIMITED where it is none."""
    return shutil.get_terminal_size().columns if (stream or sys.stdout).isatty() else UNLIMITED


def fitted(text: str, width: int) -> str:
    """Return a text with its lines wrapped to a width.

    Continuation lines are indented more than their line, so that a program stays readable.
    """
    return "\n".join(_cut(line, len(line) - len(line.lstrip()) + 4, width) for line in text.split("\n"))


def fitted_help(text: str, width: int) -> str:
    """Return a command's help for a width: paragraphs and descriptions are refilled, examples cut between words."""
    if max(map(len, text.split("\n"))) <= width:
        return text
    entries: list[tuple[str, int, bool]] = []  # an entry, the indentation of what goes on, whether lines go on in it
    for line in text.split("\n"):
        indent = len(line) - len(line.lstrip())
        described = re.match(r" *\S+(?: \S+)*  +(?=\S)", line)
        if line and not described and entries and entries[-1][1:] == (indent, True):
            entries[-1] = (f"{entries[-1][0]} {line.strip()}", indent, True)
        elif described:
            entries.append((line, described.end(), True))
        else:
            entries.append((line, indent if indent == 0 else indent + 4, indent == 0 and bool(line)))
    return "\n".join(_cut(line, indent, width) for line, indent, _ in entries)


def _cut(line: str, indent: int, width: int) -> str:
    """Return a wrapped line, the rest indented; a number stays with its unit and its factor."""
    if len(line) <= width:
        return line
    own = line[: len(line) - len(line.lstrip())]
    if indent > width // 2:  # too little would be left
        indent = len(own) + 4
    return textwrap.fill(
        re.sub(r"(?<![^\s(])([\d.,]+) (?=[A-Za-z_`])", rf"\g<1>{TOGETHER}", line.strip()),
        max(width, 20),
        initial_indent=own,
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
    ).replace(TOGETHER, " ")
