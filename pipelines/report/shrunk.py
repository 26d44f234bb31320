"""The table of shrinking in docs/findings.md: polishes by critics compared with their oracles, and the cost of both."""

from pathlib import Path

import pandas as pd

from pipelines.engine.store import read_csv, read_json
from pipelines.report.cells import METHOD_NAMES, TASK_NAMES, in_order
from pipelines.report.frames import load_runs
from pipelines.report.headline import spread
from pipelines.report.published import published
from pipelines.report.sizes import steps_in_all
from pipelines.report.text import markdown_table

HEAD = ["", "runs", "oracle", "imitating", "polished", "from nothing", "thesis", "steps", "minutes: oracle, then"]
FROM_NOTHING = {"distilled_otr": "otr", "distilled_experts": "experts"}  # what makes such a policy without an oracle
NAMES = {"otr": "OTR", "experts": "experts", "linear": "linear"}
BY = ("standard-fleet", "standard-ars", "standard")  # from nothing: SAC; where it was not run, direct search, then PPO
POLICY = ["task", "method", "depth"]


def shrunk_table(results_dir: Path) -> str:
    """Return a line for each policy that critics polished, its seeds together, as Markdown.

    Minutes of oracle and imitation are those of the clock, of the polish of the CPU; steps are of all parts.
    """
    every = load_runs(results_dir)
    every = every[(every["env"] == every["task"]) & (every["settings"] == "")]
    own = every[(every["form"] == "polished") & every["polish.by"].eq("critic").fillna(False)]
    nothing = every[every["form"] == "tree"].groupby([*POLICY, "budget"])["return_mean"]
    lines = [HEAD]
    for (task, method, depth), runs in in_order(own, POLICY).groupby(POLICY, sort=False):
        forms = every[every["run"].isin(runs["run"])].groupby("form")["return_mean"]
        alone = "linear" if depth == "0" else FROM_NOTHING.get(method)
        by = next((by for by in BY if (task, alone, depth, by) in nothing.groups), None)
        theirs = published().get(("4.1", task, "otr" if alone == "otr" else method.replace("_", "-"), depth))
        after = runs["seconds.imitate"] + runs["polish.cpu_seconds"]
        oracle = [_oracle_minutes(results_dir, run) for run in runs["run"]]
        lines.append([
            f"{TASK_NAMES[task]}, {NAMES[alone] if alone else METHOD_NAMES.get(method)} ({depth})",
            str(len(runs)),
            *(_spread(forms.get_group(form)) for form in ("oracle", "pruned_tree", "polished")),
            _spread(nothing.get_group((task, alone, depth, by))) if by else "not run" if alone else "-",
            f"{float(theirs.mean):,.6g}" if theirs else "-",
            f"{sum(steps_in_all(run) for run in runs.to_dict('records')) / len(runs) / 1e6:.2f}M",
            f"{sum(oracle) / len(oracle):.0f} + {after.mean() / 60:.0f}",
        ])  # fmt: skip
    return markdown_table(lines)


def _spread(returns: "pd.Series[float]") -> str:
    return spread(returns.mean(), returns.std())


def _oracle_minutes(results_dir: Path, run: str) -> float:
    folder = results_dir / read_json(results_dir / "runs" / run / "oracle" / "oracle.json")["folder"]
    return sum(float(row["seconds"]) for row in read_csv(folder / "progress.csv")) / 60
