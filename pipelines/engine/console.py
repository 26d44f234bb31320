"""What commands show in a terminal: numbers, and how far a command has got."""

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from rich import box
from rich.console import Console
from rich.table import Table

from pipelines.engine.wrapping import columns, fitted

PATIENCE_S = 1.5
SHORT_PROGRAM = 40  # lines; a longer one is named, not shown
T = TypeVar("T")


def duration(seconds: float) -> str:
    """Return seconds in readable units: 45 s, 12 min, 3.5 h."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 100:
        return f"{seconds:.0f} s"
    if seconds < 100 * 60:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def counted(items: Sequence[T], what: str) -> Iterator[T]:
    """Yield the items; where that takes long, a terminal shows how many are done."""
    start, shown = time.monotonic(), False
    for number, item in enumerate(items):
        if sys.stderr.isatty() and time.monotonic() - start > PATIENCE_S:
            print(f"\r{what}: {number} of {len(items)}", end="", file=sys.stderr, flush=True)
            shown = True
        yield item
    if shown:
        print("\r\033[K", end="", file=sys.stderr, flush=True)


def show_rows(what: str, rows: Mapping[str, Mapping[str, str]]) -> None:
    """Print a table of a line for each key, which `what` heads; a column that a row lacks is empty there."""
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column(what, overflow="fold")
    names = list(dict.fromkeys(name for row in rows.values() for name in row))
    for name in names:
        table.add_column(name, justify="right", no_wrap=True)
    for key, row in rows.items():
        table.add_row(key, *(row.get(name, "") for name in names))
    Console(highlight=False, width=columns()).print(table)


def show_finished(
    program: str,
    where: Any,
    title: str,
    table: Table,
    lines: Sequence[str],
    seconds: Mapping[str, float],
    run_dir: Path,
    picture: Path | None = None,
) -> None:
    """Print what came out of a job, its time and where its files are; its program in full where that is short.

    Args:
        program: its text; empty where there is none.
        where: the file or the command that shows a long program.
        title, table, lines: what the results are of, the results, and the lines below them.
        seconds: of each stage.
        run_dir: the job's folder.
        picture: a file, named where it exists.
    """
    width, n_lines = columns(), program.count("\n")
    if 0 < n_lines <= SHORT_PROGRAM:
        print(f"\n{fitted(program.rstrip(), width)}")
    print(fitted(f"\n{title}", width))
    Console(highlight=False, width=width).print(table)
    shown = [*lines, f"time: {', '.join(f'{stage} {duration(spent)}' for stage, spent in seconds.items())}"]
    shown += [f"program: {n_lines} lines, {where}"] if n_lines > SHORT_PROGRAM else []
    shown += [f"picture: {picture}"] if picture and picture.exists() else []
    print(fitted("\n".join([*shown, f"artefacts: {run_dir}"]), width))
