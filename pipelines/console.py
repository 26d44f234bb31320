"""What a finished run shows in a terminal."""

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

SHORT_PROGRAM = 40  # lines


def show_result(summary: dict[str, Any], run_dir: Path) -> None:
    """Print the run's returns, sizes and times, where its artefacts lie, and its program when that is short."""
    console = Console(highlight=False, soft_wrap=True)
    program = run_dir / "prune" / "program.txt"
    text = program.read_text(encoding="utf-8") if program.exists() else ""
    n_lines = text.count("\n")
    if 0 < n_lines <= SHORT_PROGRAM:
        console.print(f"\n{text}", markup=False)
    console.print(_table(summary))
    seconds = ", ".join(f"{stage} {duration(spent)}" for stage, spent in summary["seconds"].items())
    plural = "" if summary["patterns"] == 1 else "s"
    console.print(
        f"{summary['patterns']} activation pattern{plural} reached, estimated pruned depth "
        f"{summary['pruned_depth']:.1f}; the pruned tree acts as the network in "
        f"{100 * summary['fidelity']:.2f} % of the states"
    )
    console.print(f"time: {seconds}", markup=False)
    if n_lines > SHORT_PROGRAM:
        console.print(f"program: {n_lines} lines, {program}", markup=False)
    console.print(f"artefacts: {run_dir}", markup=False)


def _leaves(n_leaves: int) -> str:
    """Return a number of leaves as people read it: 64, or 2^32."""
    return f"{n_leaves:,}" if n_leaves <= 2**20 else f"2^{n_leaves.bit_length() - 1}"


def duration(seconds: float) -> str:
    """Return seconds as people read them: 45 s, 12 min, 3.5 h."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 100:
        return f"{seconds:.0f} s"
    if seconds < 100 * 60:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def _table(summary: dict[str, Any]) -> Table:
    episodes = summary["n_episodes"]
    trainer = "" if summary["trainer"] == "sb3" else f", {summary['trainer']}"
    title = (
        f"{summary['env']} ({summary['env_id']}), depth {summary['depth']}, {summary['algorithm'].upper()}, "
        f"{summary['steps']:,} steps ({summary['budget']}{trainer}), seed {summary['seed']}"
    )
    table = Table(title=title, title_justify="left")
    table.add_column("policy")
    table.add_column(f"return over {episodes} episodes", justify="right")
    table.add_column("leaves", justify="right")
    leaves = {"network": "", "tree": _leaves(summary["n_leaves"]), "pruned_tree": f"{summary['pruned_leaves']:,}"}
    for name, moments in summary["policies"].items():
        table.add_row(
            name.replace("_", " "), f"{moments['return_mean']:z.1f} ± {moments['return_std']:.1f}", leaves[name]
        )
    return table
