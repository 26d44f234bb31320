"""Figure 4.6: return of imitating trees on the lander against their depth, a panel for each oracle, and linear ones."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd

import otr
from pipelines.engine.store import corrupt
from pipelines.report.cells import DECIMALS, METHOD_NAMES, changes_but_oracle, method_name, summarise, table_runs
from pipelines.report.figures.style import return_against_depth
from pipelines.report.text import csv_text, write_file

EXPERIMENT = "figure_4_6"  # whose runs Figures 4.6 and 4.7 show
ENVIRONMENT = "lunarlander"
BUDGETS = ("thesis", "quick")
IMITATOR = "distilled_otr"  # of depth 0 a linear policy
KEY = ["oracle", "method", "depth"]
COLUMNS = [*KEY, "mean", "std", "ci_low", "ci_high", "n_runs", "n_episodes", "budget", "oracle_mean", "note"]
SOLVED = 200.0  # the thesis: an average return above it over 100 consecutive episodes


class Planned(NamedTuple):
    """A run of the experiment, finished or not: its oracle's hidden widths as `[64,64]`, and its folder below runs."""

    oracle: str
    method: str
    depth: int
    run: str


def budget_of_runs(runs: pd.DataFrame) -> str:
    """Return the first of BUDGETS under which a tree has imitated an oracle on the lander; the last where none has."""
    imitating = runs[(runs["env"] == ENVIRONMENT) & runs["oracle.hidden_widths"].notna()]
    return next((budget for budget in BUDGETS if (imitating["budget"] == budget).any()), BUDGETS[-1])


def write_figure_4_6(runs: pd.DataFrame, planned: Sequence[Planned], budget: str, results_dir: Path) -> list[Path]:
    """Write Figure 4.6 from those of the experiment's runs, planned under one budget, that are finished.

    Linear policies of the same budget are at depth 0: those without an oracle in each panel, and imitating ones in
    that of their oracle.

    Returns:
        The CSV, the PNG and the SVG file; the CSV alone where nothing was run.
    """
    cells = make_cells(runs, planned, results_dir).assign(budget=budget)
    linear, imitators = linear_cells(runs, budget), linear_imitators(runs, cells, budget)
    folder = results_dir / "figures"
    table = pd.concat([part for part in (linear, imitators, cells) if len(part)])[COLUMNS]
    paths = [write_file(folder / "figure_4_6.csv", csv_text(table.round(DECIMALS)))]
    played = cells[cells["n_runs"] > 0]
    if len(played):
        in_each = [linear.assign(oracle=oracle) for oracle in dict.fromkeys(played["oracle"]) if len(linear)]
        points = pd.concat([played, *in_each, *([imitators] if len(imitators) else [])])
        points = points.assign(panel="oracle " + points["oracle"], label=points["method"].map(_label))
        counts = sorted(set(points["n_runs"]))
        number = " to ".join(str(count) for count in dict.fromkeys((counts[0], counts[-1])))
        text = f"mean ± standard deviation over {number} run{'' if counts == [1] else 's'}"
        figure = return_against_depth(points, SOLVED, f"LunarLander: {text}, budget {budget}")
        paths += [folder / "figure_4_6.png", folder / "figure_4_6.svg"]
        for path in paths[1:]:
            otr.save_picture(figure, path)
    return paths


def make_cells(runs: pd.DataFrame, planned: Sequence[Planned], results_dir: Path) -> pd.DataFrame:
    """Return a row an oracle, method and depth in the order of the experiment's runs, unfinished ones included."""
    experiment = pd.DataFrame(planned, columns=Planned._fields)
    trees, oracles = (runs[runs["form"] == form] for form in ("tree", "oracle"))
    trees = trees[["run", "return_mean", "n_episodes", "oracle.hidden_widths"]]
    played = experiment.merge(trees, on="run").merge(
        oracles[["run", "return_mean"]], on="run", suffixes=("", "_oracle")
    )
    for run in played[played["oracle"] != played["oracle.hidden_widths"]].itertuples():
        summary = results_dir / "runs" / run.run / "summary.json"
        raise corrupt(summary, ValueError(f"its oracle is not the expected one, {run.oracle}"))
    cells = summarise(played, KEY, "return_mean", n_episodes=("n_episodes", "min"))
    cells = experiment.groupby(KEY, sort=False).size().rename("n_planned").reset_index().merge(cells, "left", KEY)
    # Every method and depth of a seed has the same oracle, on the same episodes.
    seeds = played.assign(seed=played["run"].str.extract(r"/seed-(\d+)", expand=False))
    means = seeds.drop_duplicates(["oracle", "seed"], keep="last").groupby("oracle")["return_mean_oracle"].mean()
    cells["oracle_mean"] = cells["oracle"].map(means)
    cells["n_runs"] = cells["n_runs"].fillna(0).astype(int)
    counts = zip(cells["n_runs"], cells["n_planned"], strict=True)
    cells["note"] = ["not run" if not n else "" if n == all_ else f"{n} of {all_} runs" for n, all_ in counts]
    return cells


def linear_cells(runs: pd.DataFrame, budget: str) -> pd.DataFrame:
    """Return the row of the lander's linear policies under a budget, of no oracle; no row where there are none."""
    own = table_runs(runs)
    own = own[(own["task"] == ENVIRONMENT) & (own["method"] == "linear") & (own["budget"] == budget)]
    cells = summarise(own.assign(oracle="", depth=0), KEY, "return_mean", n_episodes=("n_episodes", "min"))
    return cells.assign(budget=budget, oracle_mean=float("nan"), note="")


def linear_imitators(runs: pd.DataFrame, cells: pd.DataFrame, budget: str) -> pd.DataFrame:
    """Return rows of the linear policies that imitate the oracles of `cells` under a budget, in the cells' order."""
    is_plain = (runs["budget"] == budget) & (runs["form"] == "tree") & (changes_but_oracle(runs) == "")
    own = runs[(runs["env"] == ENVIRONMENT) & (runs["method"] == IMITATOR) & (runs["depth"] == "0") & is_plain]
    own = own.assign(oracle=own["oracle.hidden_widths"], method=method_name(own["method"]), depth=0)
    means = cells[cells["n_runs"] > 0].drop_duplicates("oracle").set_index("oracle")["oracle_mean"]
    rows = summarise(own, KEY, "return_mean", n_episodes=("n_episodes", "min")).set_index("oracle")
    rows = rows.loc[[oracle for oracle in means.index if oracle in rows.index]].reset_index()
    return rows.assign(budget=budget, oracle_mean=rows["oracle"].map(means), note="")


def _label(method: str) -> str:
    """Return a method's name in the legend; NDPS's depth leaves out the tests of the argmax below its affine leaves."""
    own = {
        "ndps": "NDPS (affine leaves)",
        "linear": "Linear (no oracle)",
        "distilled-otr": "Linear (imitating)",
    }
    return own.get(method, METHOD_NAMES[method])
