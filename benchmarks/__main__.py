"""Run benchmarks, compare them with their targets, and write results/benchmarks/<name>.json.

    python -m benchmarks                      all of them, about half an hour
    python -m benchmarks mapping prediction   the named ones
    python -m benchmarks --quick              smaller ones, about a minute; written to results/benchmarks/quick

A target that is missed is named at the end.
"""

import argparse
import difflib
import importlib
import os
import sys
import time
from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.measure import Entry, output_dir
from pipelines.engine.console import duration
from pipelines.engine.provenance import git_revision, versions
from pipelines.engine.store import write_json

NAMES = (
    "mapping", "prediction", "evaluation", "training", "fleet", "search", "polish", "shrink", "sweeps", "supervised",
    "control", "exact", "latency", "fixed_point", "tables", "pendulum_optimum",
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what the command line asks for and return the exit code."""
    parser = argparse.ArgumentParser(
        "benchmarks", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="name", help=f"{', '.join(NAMES)}; none for all")
    parser.add_argument("--quick", action="store_true", help="fewer sizes, rounds and episodes")
    given = list(sys.argv[1:] if arguments is None else arguments)
    asked = parser.parse_args(given)
    for name in asked.names:
        if name not in NAMES:
            parser.error(_unknown(name))
    folder = output_dir(asked.quick)
    folder.mkdir(parents=True, exist_ok=True)
    entries: list[Entry] = []
    for name in asked.names or NAMES:
        began = time.monotonic()
        print(f"{name}: measuring", flush=True)
        measured = importlib.import_module(f"benchmarks.{name}").measure(asked.quick)
        write_json(folder / f"{name}.json", document(measured, ["python", "-m", "benchmarks", *given]))
        print(f"{name}: {duration(time.monotonic() - began)}, {folder / name}.json", flush=True)
        entries += measured
    show(entries)
    missed = [entry.name for entry in entries if entry.met is False]
    print(f"missed: {'; '.join(missed)}" if missed else "every target is met")
    return 0  # a busy machine misses a target, too: a miss is reported, and is no failure


def document(entries: Sequence[Entry], command: Sequence[str]) -> list[dict[str, Any]]:
    """Return what a benchmark's JSON file holds: a list of measurements, each with where it comes from."""
    origin = {
        "command": " ".join(command),
        "git_revision": git_revision(),
        "versions": versions(),
        "machine": {"n_cores": os.cpu_count(), "load_average": round(os.getloadavg()[0], 2)},
    }
    return [entry.to_dict() | origin for entry in entries]


def show(entries: Sequence[Entry]) -> None:
    """Print the measurements as a table."""
    table = Table("measured", "ours", "peer's", "unit", "peer", "ratio", "target", "")
    for column in (1, 2, 5):
        table.columns[column].justify = "right"
    for entry in entries:
        table.add_row(
            entry.name,
            _number(entry.value),
            _number(entry.peer_value),
            entry.unit,
            entry.peer or "",
            _number(entry.ratio),
            entry.target or "",
            {True: "met", False: "[bold red]missed[/]", None: ""}[entry.met],
        )
    Console(highlight=False, width=None if sys.stdout.isatty() else 180).print(table)


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"


def _unknown(name: str) -> str:
    near = difflib.get_close_matches(name, NAMES, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]}?" if near else f"there are: {', '.join(NAMES)}"
    return f"there is no benchmark {name!r}; {hint}"


if __name__ == "__main__":
    sys.exit(main())
