"""The verdicts of docs/findings.md: on which control tasks a tree returns more than linear policies, by one rule.

`python -m pipelines.report.verdicts` writes them between the page's two marks.
"""

import re
from pathlib import Path

import pandas as pd

from pipelines.report.cells import METHOD_NAMES, TASK_NAMES, table_runs, with_pruned_trees
from pipelines.report.frames import load_runs
from pipelines.report.headline import spread
from pipelines.report.statistics import difference_interval, probability_of_improvement

CELL = ["method", "depth", "budget", "trainer"]
MIN_RUNS = 3
FORMS = {"tree": "", "polished": "-polished"}  # soft trees are no trees yet
HEAD = ["", "the best linear policies", "OTR: ahead?", "the best trees: ahead?"]
BLOCK = re.compile(r"(?s)(<!-- verdicts -->\n).*(?=<!-- end -->)")


def verdicts(results_dir: Path) -> str:
    """Return the table as Markdown: of each task the cells with the highest means, of whatever budget and trainer."""
    every = load_runs(results_dir)
    runs = with_pruned_trees(table_runs(every, FORMS), every)
    lines = [HEAD, ["---"] * len(HEAD)]
    for task, name in TASK_NAMES.items():
        own = runs[runs["task"] == task]
        is_linear, is_otr = own["depth"] == "0", own["method"].isin(["otr", "otr-polished"])
        linear = _best(own[is_linear])
        small = _best(own[is_otr & own["depth"].isin(["1", "2", "6"])])
        trees = _best(own[~is_linear])
        lines.append([name, _cell(linear), _verdict(small, linear), _verdict(trees, linear)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _best(runs: pd.DataFrame) -> pd.DataFrame:
    cells = [cell for _, cell in runs.groupby(CELL) if len(cell) >= MIN_RUNS]
    return max(cells, key=lambda cell: float(cell["return_mean"].mean()))


def _cell(runs: pd.DataFrame) -> str:
    first, returns = runs.iloc[0], runs["return_mean"]
    depth = "" if first["depth"] == "0" else f" ({first['depth']})"
    n_leaves = sorted({int(runs["leaves_pruned"].min()), int(runs["leaves_pruned"].max())})
    leaves = f"{' to '.join(f'{n:,}' for n in n_leaves)} leaves, " if depth else ""
    what = f"{METHOD_NAMES[first['method']]}{depth}"
    return f"{spread(returns.mean(), returns.std())}, {what}, {leaves}{len(runs)} runs"


def _verdict(runs: pd.DataFrame, linear: pd.DataFrame) -> str:
    ours, theirs = runs["return_mean"], linear["return_mean"]
    low, _ = difference_interval(ours, theirs)
    share = probability_of_improvement(ours, theirs)
    is_ahead = share == 1 if pd.isna(low) else low > 0
    return f"**{'yes' if is_ahead else 'no'}**: {_cell(runs)}, higher in {100 * share:.0f} % of pairs"


if __name__ == "__main__":
    page = Path("docs/findings.md")
    text = page.read_text(encoding="utf-8")
    page.write_text(BLOCK.sub(lambda match: match[1] + verdicts(Path("results")) + "\n", text), encoding="utf-8")
