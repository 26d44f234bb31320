"""What a finished fit shows in a terminal."""

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from pipelines.console import SHORT_PROGRAM, duration
from pipelines.supervised.metrics import METRICS


def show_fit(summary: dict[str, Any], run_dir: Path) -> None:
    """Print the scores, the size and the time of a fit, where its artefacts lie, and its program if that is short."""
    console = Console(highlight=False, soft_wrap=True)
    program = _program(run_dir)
    if program:
        console.print(f"\n{program}", markup=False)
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
    picture = run_dir / "fit" / "tree.png"
    if picture.exists():
        console.print(f"picture: {picture}", markup=False)
    console.print(f"artefacts: {run_dir}", markup=False)


def _program(run_dir: Path) -> str:
    """Return the program that was written of a small tree, if it is short."""
    path = run_dir / "score" / "program.txt"
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    return text if text.count("\n") <= SHORT_PROGRAM else ""
