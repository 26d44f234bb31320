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
    if program.exists() and (text := program.read_text()).count("\n") <= SHORT_PROGRAM:
        console.print(f"\n{text}", markup=False)
    console.print(_table(summary))
    seconds = ", ".join(f"{stage} {duration(spent)}" for stage, spent in summary["seconds"].items())
    console.print(
        f"{summary['patterns']} activation patterns reached, estimated pruned depth {summary['pruned_depth']:.1f}; "
        f"the pruned tree acts as the network in {100 * summary['fidelity']:.2f} % of the states"
    )
    console.print(f"seconds: {seconds}", markup=False)
    console.print(f"artefacts: {run_dir}", markup=False)


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
    title = (
        f"{summary['env']} ({summary['env_id']}), depth {summary['depth']}, {summary['algorithm'].upper()}, "
        f"{summary['steps']:,} steps ({summary['budget']}), seed {summary['seed']}"
    )
    table = Table(title=title, title_justify="left")
    table.add_column("policy")
    table.add_column(f"return over {episodes} episodes", justify="right")
    table.add_column("leaves", justify="right")
    leaves = {"network": "", "tree": f"{summary['n_leaves']:,}", "pruned_tree": f"{summary['pruned_leaves']:,}"}
    for name, moments in summary["policies"].items():
        table.add_row(
            name.replace("_", " "), f"{moments['return_mean']:.1f} ± {moments['return_std']:.1f}", leaves[name]
        )
    return table
