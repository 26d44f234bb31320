"""What a finished fit shows in a terminal."""

from pathlib import Path
from typing import Any

from rich.table import Table

from pipelines.datasets.dataset import PARTS
from pipelines.engine.console import show_finished
from pipelines.engine.store import exists, read_bytes
from pipelines.supervised.metrics import METRICS


def show_fit(summary: dict[str, Any], run_dir: Path) -> None:
    """Print the scores, the size and the time of a fit, where its artefacts are, and its program if that is short."""
    program = run_dir / "score" / "program.txt"
    n_labels = summary["n_labels"]
    over = f", mean over {n_labels} labels" if n_labels > 1 else ""
    split = f", split {summary['split']}" if "split" in summary else ""
    named = f"{summary['data']}, {summary['method']}{split}, seed {summary['seed']}"
    title = f"{named}: {METRICS[summary['metric']]}{over}"
    table = Table()
    for name in fit_row(summary):
        table.add_column(name, justify="right")
    table.add_row(*fit_row(summary).values())
    left_out = ", ".join(f"{n} in {part}" for part, n in summary["labels_left_out"].items() if n)
    lines = [f"labels left out, for they have one class: {left_out}"] if left_out else []
    if summary["whole_test"] != summary["test"]:
        lines.append(
            f"scored and counted is the tree that training rows reach; the whole tree has {summary['whole_test']:.4f} "
            "on the test part"
        )
    text = read_bytes(program).decode() if exists(program) else ""
    show_finished(text, program, title, table, lines, summary["seconds"], run_dir, picture=run_dir / "fit" / "tree.png")


def fit_row(summary: dict[str, Any]) -> dict[str, str]:
    """Return a fit's scores on each part and its size as tables show them."""
    scores = {part: "-" if summary[part] is None else f"{summary[part]:.4f}" for part in PARTS}
    return scores | {name: f"{summary[name]:,.1f}".removesuffix(".0") for name in ("leaves", "depth")}
