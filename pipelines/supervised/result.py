"""What a finished fit shows in a terminal."""

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from pipelines.engine.console import SHORT_PROGRAM, duration
from pipelines.engine.store import exists, read_bytes
from pipelines.supervised.metrics import METRICS


def show_fit(summary: dict[str, Any], run_dir: Path) -> None:
    """Print the scores, the size and the time of a fit, where its artefacts lie, and its program if that is short."""
    console = Console(highlight=False, soft_wrap=True)
    program = run_dir / "score" / "program.txt"
    text = read_bytes(program).decode() if exists(program) else ""
    n_lines = text.count("\n")
    if 0 < n_lines <= SHORT_PROGRAM:
        console.print(f"\n{text}", markup=False)
    n_labels = summary["n_labels"]
    over = f", mean over {n_labels} labels" if n_labels > 1 else ""
    title = f"{summary['data']}, {summary['method']}, seed {summary['seed']}: {METRICS[summary['metric']]}{over}"
    table = Table(title=title, title_justify="left")
    for name in ("train", "valid", "test", "leaves reached", "depth"):
        table.add_column(name, justify="right")
    scores = ["-" if summary[part] is None else f"{summary[part]:.4f}" for part in ("train", "valid", "test")]
    table.add_row(*scores, f"{summary['leaves']:,.1f}".removesuffix(".0"), f"{summary['depth']:.1f}".removesuffix(".0"))
    console.print(table)
    left_out = {part: n for part, n in summary["labels_left_out"].items() if n}
    if left_out:
        parts = ", ".join(f"{n} in {part}" for part, n in left_out.items())
        console.print(f"labels left out, for they have one class: {parts}")
    seconds = ", ".join(f"{stage} {duration(spent)}" for stage, spent in summary["seconds"].items())
    console.print(f"time: {seconds}", markup=False)
    if n_lines > SHORT_PROGRAM:
        console.print(f"program: {n_lines} lines, {program}", markup=False)
    picture = run_dir / "fit" / "tree.png"
    if picture.exists():
        console.print(f"picture: {picture}", markup=False)
    console.print(f"artefacts: {run_dir}", markup=False)
