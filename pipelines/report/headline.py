"""The table of README: linear policies, OTR and the thesis on the eight control tasks, from the committed runs.

`python -m pipelines.report.headline` writes it between README's two marks.
"""

import math
import re
from pathlib import Path

import pandas as pd

from pipelines.config.trainer import SHRINK
from pipelines.report.against_thesis import order_of_methods
from pipelines.report.cells import TASK_NAMES, table_runs, with_pruned_trees
from pipelines.report.frames import load_runs
from pipelines.report.published import best_published
from pipelines.report.sizes import steps_in_all
from pipelines.report.table_4_1 import make_cells

COLUMNS = (("linear", "0"), ("otr", "6"), ("otr", "32"))
HEAD = "| | linear | OTR (6) | OTR (32) | the thesis's best | leaves of OTR (6), (32) | their steps |\n|" + 7 * " --- |"
MARKS = {SHRINK: " ‡"}  # of cells whose runs were not trained from nothing
BLOCK = re.compile(r"(?s)(<!-- results -->\n).*(?=<!-- end -->)")


def headline_table(results_dir: Path) -> str:
    """Return the cells of Table 4.1 as Markdown, with means of leaves and steps, then the methods, best first."""
    every = load_runs(results_dir)
    runs = with_pruned_trees(table_runs(every), every)
    runs["total_steps"] = [steps_in_all(run) for run in runs.to_dict("records")]
    cells = make_cells(runs).query("table == '4.1'").set_index(["task", "method", "depth"])
    lines = [HEAD]
    for task in tuple(TASK_NAMES)[:8]:
        chosen = [cells.loc[(task, *column)] for column in COLUMNS]
        sources = [_runs_of(runs, task, *column, cell) for column, cell in zip(COLUMNS, chosen, strict=True)]
        leaves = ", ".join(f"{source['leaves_pruned'].mean():,.0f}" for source in sources[1:])
        best = best_published(task)
        steps = ", ".join(dict.fromkeys(f"{source['total_steps'].mean() / 1e6:.3g}M" for source in sources[1:]))
        returns = (spread(cell["mean"], cell["std"]) + MARKS.get(cell["trainer"], "") for cell in chosen)
        texts = [*returns, f"{best:,.{_decimals(best)}f}", leaves, steps]
        lines.append(f"| {TASK_NAMES[task]} | {' | '.join(texts)} |")
    head, *order = (f"| {' | '.join(line)} |" for line in order_of_methods(cells.reset_index()))
    return "\n".join([*lines, "", head, "| --- " * head.count(" | ") + "| --- |", *order])


def _runs_of(runs: pd.DataFrame, task: str, method: str, depth: str, cell: "pd.Series[str]") -> pd.DataFrame:
    own = {"task": task, "method": method, "depth": depth, "budget": cell["budget"], "trainer": cell["trainer"]}
    return runs[(runs[list(own)] == pd.Series(own)).all(axis=1)]


def spread(mean: float, std: float) -> str:
    """Return a mean and its deviation, such as 3,454 ± 144, with as many decimals as its size needs.

    Of one run there is no deviation, NaN.
    """
    digits = _decimals(mean)
    return f"{mean:,.{digits}f}" + ("" if math.isnan(std) else f" ± {std:,.{digits}f}")


def _decimals(number: float) -> int:
    return 0 if abs(number) >= 1000 else 1 if abs(number) >= 100 else 2


if __name__ == "__main__":
    readme = Path("README.md")
    text = readme.read_text(encoding="utf-8")
    readme.write_text(
        BLOCK.sub(lambda match: match[1] + headline_table(Path("results")) + "\n", text), encoding="utf-8"
    )
