"""The verdicts of docs/findings.md: on which control tasks a tree returns more than linear policies, by one rule.

`python -m pipelines.report.verdicts` writes each task's, and the table of shrinking, between
the page's marks for it.
"""

import re
from pathlib import Path

import pandas as pd

from pipelines.report.cells import METHOD_NAMES, TASK_NAMES, table_runs, with_pruned_trees
from pipelines.report.frames import load_runs
from pipelines.report.headline import spread
from pipelines.report.shrunk import shrunk_table
from pipelines.report.statistics import difference_interval, probability_of_improvement

CELL = ["method", "depth", "budget", "trainer"]
MIN_RUNS = 3
FORMS = {"tree": "", "polished": "-polished"}  # soft trees are no trees yet
HEAD = ["the best of each kind", "return", "leaves", "runs", "pairs with linear that it wins"]
BLOCK = re.compile(r"(?s)(<!-- (?!end)(\w+) -->\n).*?(?=<!-- end -->)")


def verdicts(results_dir: Path) -> dict[str, str]:
    """Return `all`, `shrunk` and each task's table as Markdown: the cells with the highest means, of any budget."""
    every = load_runs(results_dir)
    runs = with_pruned_trees(table_runs(every, FORMS), every)
    found, answers_of = {}, []
    for task, name in TASK_NAMES.items():
        own = runs[runs["task"] == task]
        is_linear, is_otr = own["depth"] == "0", own["method"].isin(["otr", "otr-polished"])
        linear = _best(own[is_linear])
        small = _best(own[is_otr & own["depth"].isin(["1", "2", "6"])])
        trees = _best(own[~is_linear])
        answers = ["yes" if _is_higher(each, linear) else "no" for each in (small, trees)]
        answers_of.append([name, *answers])
        kinds = {"linear": linear, "a small OTR": small, "any tree": trees}
        lines = [HEAD, ["---"] * len(HEAD), *(_line(kind, each, linear) for kind, each in kinds.items())]
        verdict = f"Higher than linear policies: a small OTR **{answers[0]}**, the best tree **{answers[1]}**."
        found[task] = f"{verdict}\n\n{_table(lines)}"
    head = [["higher than linear policies?", "a small OTR", "any tree"], ["---"] * 3]
    return found | {"all": _table(head + answers_of), "shrunk": shrunk_table(results_dir)}


def _table(lines: list[list[str]]) -> str:
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _best(runs: pd.DataFrame) -> pd.DataFrame:
    cells = [cell for _, cell in runs.groupby(CELL) if len(cell) >= MIN_RUNS]
    return max(cells, key=lambda cell: float(cell["return_mean"].mean()))


def _line(kind: str, runs: pd.DataFrame, linear: pd.DataFrame) -> list[str]:
    first, returns = runs.iloc[0], runs["return_mean"]
    n_leaves = sorted({int(runs["leaves_pruned"].min()), int(runs["leaves_pruned"].max())})
    name = METHOD_NAMES[first["method"]] + ("" if first["depth"] == "0" else f" ({first['depth']})")
    name = name.replace("OTR, distilled", "Linear, imitating") if kind == "linear" else name
    share = "" if kind == "linear" else f"{100 * probability_of_improvement(returns, linear['return_mean']):.0f} %"
    leaves = " to ".join(f"{n:,}" for n in n_leaves)
    return [f"{kind}: {name}", spread(returns.mean(), returns.std()), leaves, str(len(runs)), share]


def _is_higher(runs: pd.DataFrame, linear: pd.DataFrame) -> bool:
    ours, theirs = runs["return_mean"], linear["return_mean"]
    low, _ = difference_interval(ours, theirs)
    return bool(probability_of_improvement(ours, theirs) == 1 if pd.isna(low) else low > 0)


if __name__ == "__main__":
    page, found = Path("docs/findings.md"), verdicts(Path("results"))
    text = page.read_text(encoding="utf-8")
    page.write_text(BLOCK.sub(lambda match: match[1] + found[match[2]] + "\n", text), encoding="utf-8")
