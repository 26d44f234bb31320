"""Figure 4.6: return of imitating trees on the lander against their depth, a panel for each oracle, and linear ones."""

from pathlib import Path

import pandas as pd

import otr
from pipelines.report.cells import DECIMALS, METHOD_NAMES, changes_but_oracle, method_name, summarise, table_runs
from pipelines.report.figures.style import return_against_depth
from pipelines.report.text import csv_text, write_file

ENVIRONMENT = "lunarlander"
BUDGETS = ("thesis", "quick")
ORACLES = ("[32]", "[256]", "[64,64]", "[256,256]")  # the order of the panels; others come after
METHODS = ("augtree", "viper", "ndps")
IMITATOR = "distilled_otr"  # of depth 0 a linear policy
KEY = ["oracle", "method", "depth"]
COLUMNS = [*KEY, "mean", "std", "ci_low", "ci_high", "n_runs", "n_episodes", "budget", "oracle_mean", "note"]
SOLVED = 200.0  # the thesis: an average return above it over 100 consecutive episodes


def budget_of_runs(runs: pd.DataFrame) -> str:
    """Return the first of BUDGETS under which a tree has imitated an oracle on the lander; the last where none has."""
    imitating = runs[(runs["env"] == ENVIRONMENT) & runs["oracle.hidden_widths"].notna()]
    return next((budget for budget in BUDGETS if (imitating["budget"] == budget).any()), BUDGETS[-1])


def write_figure_4_6(runs: pd.DataFrame, budget: str, results_dir: Path) -> list[Path]:
    """Write Figure 4.6 from the finished runs under one budget.

    Linear policies of the same budget are at depth 0: those without an oracle in each panel, and imitating ones in
    that of their oracle.

    Returns:
        The CSV, the PNG and the SVG file; the CSV alone where nothing was run.
    """
    imitators = imitating_trees(runs, budget)
    cells = summarise(imitators, KEY, "return_mean", n_episodes=("n_episodes", "min"))
    # Every method and depth of a seed has the same oracle, on the same episodes.
    seeds = imitators[imitators["depth"] > 0].drop_duplicates(["oracle", "seed"], keep="last")
    cells["oracle_mean"] = cells["oracle"].map(seeds.groupby("oracle")["oracle_return"].mean())
    cells, linear = cells.assign(budget=budget, note=""), linear_cells(runs, budget)
    table = pd.concat([part for part in (linear, cells) if len(part)] or [cells])[COLUMNS]
    folder = results_dir / "figures"
    paths = [write_file(folder / "figure_4_6.csv", csv_text(table.round(DECIMALS)))]
    if (cells["depth"] > 0).any():
        in_each = [linear.assign(oracle=oracle) for oracle in dict.fromkeys(cells["oracle"]) if len(linear)]
        points = pd.concat([cells[cells["depth"] > 0], *in_each, cells[cells["depth"] == 0]])
        points = points.assign(panel="oracle " + points["oracle"], label=points["method"].map(_label))
        counts = sorted(set(points["n_runs"]))
        number = " to ".join(str(count) for count in dict.fromkeys((counts[0], counts[-1])))
        text = f"mean ± standard deviation over {number} run{'' if counts == [1] else 's'}"
        figure = return_against_depth(points, SOLVED, f"LunarLander: {text}, budget {budget}")
        paths += [folder / "figure_4_6.png", folder / "figure_4_6.svg"]
        for path in paths[1:]:
            otr.save_picture(figure, path)
    return paths


def imitating_trees(runs: pd.DataFrame, budget: str) -> pd.DataFrame:
    """Return the lander's runs of METHODS, and of linear imitators, that change nothing of a budget but the oracle.

    They come in the figure's order, with `oracle` (its hidden widths), `oracle_return` and `depth` as a number.
    """
    own = runs[(runs["env"] == ENVIRONMENT) & (runs["budget"] == budget) & runs["oracle.hidden_widths"].notna()]
    own = own[changes_but_oracle(own) == ""]
    own = own[own["method"].isin(METHODS) | ((own["method"] == IMITATOR) & (own["depth"] == "0"))]
    returns = own[own["form"] == "oracle"].set_index("run")["return_mean"]
    trees = own[own["form"] == "tree"]
    trees = trees.assign(
        oracle=trees["oracle.hidden_widths"],
        oracle_return=trees["run"].map(returns),
        depth=trees["depth"].astype(int),
        order=trees["method"].map({name: i for i, name in enumerate((IMITATOR, *METHODS))}),
        panel=trees["oracle.hidden_widths"].map({name: i for i, name in enumerate(ORACLES)}).fillna(len(ORACLES)),
        method=method_name(trees["method"]),
        is_tree=trees["method"] != IMITATOR,
    )
    return trees.sort_values(["is_tree", "panel", "oracle", "depth", "order", "seed"], kind="stable")


def linear_cells(runs: pd.DataFrame, budget: str) -> pd.DataFrame:
    """Return the row of the lander's linear policies under a budget, of no oracle; no row where there are none."""
    own = table_runs(runs)
    own = own[(own["task"] == ENVIRONMENT) & (own["method"] == "linear") & (own["budget"] == budget)]
    cells = summarise(own.assign(oracle="", depth=0), KEY, "return_mean", n_episodes=("n_episodes", "min"))
    return cells.assign(budget=budget, oracle_mean=float("nan"), note="")


def _label(method: str) -> str:
    """Return a method's name in the legend; NDPS's depth leaves out the tests of the argmax below its affine leaves."""
    own = {
        "ndps": "NDPS (affine leaves)",
        "linear": "Linear (no oracle)",
        "distilled-otr": "Linear (imitating)",
    }
    return own.get(method, METHOD_NAMES[method])
