"""Cells of tables and points of figures: runs or fits grouped by what made them, under the names that tables print."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pandas as pd

from pipelines.config.methods import METHODS
from pipelines.config.recipe import recipe
from pipelines.config.trainer import SHRINK
from pipelines.report.published import Published, best_published, published
from pipelines.report.statistics import mean_interval
from pipelines.runs.below_random import random_returns

CSV_COLUMNS = ("table", "task", "method", "depth", "mean", "std", "ci_low", "ci_high", "n_runs", "n_episodes", "budget",
               "trainer", "published_mean", "published_std", "note")  # fmt: skip
LINES = {"ours": "ours", "thesis": "thesis"}  # of a row of a table, and the columns of cells that they show
TASK_NAMES = {"reacher": "Reacher", "walker2d": "Walker2d", "hopper": "Hopper", "halfcheetah": "HalfCheetah",
              "ant": "Ant", "swimmer": "Swimmer", "bipedalwalker": "BipedalWalker", "pendulum": "Pendulum",
              "mountaincar": "MountainCar", "lunarlander": "LunarLander"}  # fmt: skip
# The forms of a policy that have rows of their own, and what these append to the method's name: the tree, the soft tree
# before it was hardened, its authors' own discretisation of it, a PID policy with its gains averaged, and
# the polished policy.
FORMS = {
    "tree": "", "soft": "-soft", "discretised": "-discrete", "constant_gains": "-constant", "polished": "-polished",
}  # fmt: skip
BY_CRITICS = "-critic"  # what comes before the form of a policy that critics polished, other than a shrunk one
METHOD_NAMES = {
    f"{name.replace('_', '-')}{FORMS[form]}": f"{config.label}, {text}" if text else config.label
    for name, config in METHODS.items()
    for form, text in {"tree": "", **config.forms, "polished": "polished"}.items()
} | {
    f"{name.replace('_', '-')}{BY_CRITICS}{FORMS['polished']}": f"{config.label}, polished by critics"
    for name, config in METHODS.items()
}  # fmt: skip
SHRUNK = "distilled-otr-polished"  # the method's name of a shrunk network
ORACLE = "oracle"  # the method's name of the networks that others imitate; their depth is empty
METHOD_NAMES[ORACLE] = "Oracle"
KEY, SOURCE = ["task", "method", "depth"], ["budget", "trainer"]
# fmt: off
# Of tasks, budgets and trainers: shrunk networks, the thesis's algorithms, searches
ORDER = (*TASK_NAMES, "thesis", "thesis-fleet", "standard-shrink", "standard", "standard-fleet", "standard-ars",
         "quick", "quick-fleet", "quick-ars", "sb3")
# fmt: on
DECIMALS = 6  # of a CSV file's means and deviations: more would show how a platform adds up


def reported(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of `load_runs` that tables are made of: no smoke budgets, no settings but the budget's."""
    return runs[(runs["settings"] == "") & ~_is_smoke(runs)]


def _is_smoke(runs: pd.DataFrame) -> pd.Series:
    return runs["budget"].str.split("-").str[0] == "smoke"


def run_in_words(budget: str, seed: object) -> str:
    """Return a run's budget, without its trainer, and its seed in words: `budget standard, seed 2`."""
    return f"budget {budget.partition('-')[0]}, seed {seed}"


def method_name(methods: pd.Series) -> pd.Series:
    """Return methods as tables name them, from their folders' names."""
    return methods.str.replace("_", "-")


def table_runs(runs: pd.DataFrame, forms: Mapping[str, str] = FORMS) -> pd.DataFrame:
    """Return the runs of control tables, a row for each of these forms, from `load_runs`, its order kept.

    Versions of a task's environment (env=hopper_v5) are left out. OTR of depth 0 is the linear policy; where both names
    hold a seed it counts once. A policy that is shrunk is OTR where that is the task's recipe (`conf/recipe`), and
    the imitation that it begins with has no row.
    """
    return _in_tables(reported(runs), [], forms)


def variant_runs(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the runs that change settings of their budget, as `table_runs` does those that do not.

    Another oracle does not count as a change: `changes` is empty where there is no other. Programs and imported
    policies are left out.
    """
    changes = runs["changes"].fillna("")
    own = runs.assign(changes=changes_but_oracle(runs))
    is_given = runs["method"].isin([name for name, method in METHODS.items() if not method.is_trained])
    return _in_tables(own[(changes != "") & ~is_given & ~_is_smoke(runs)], ["changes", "oracle.hidden_widths"])


def other_runs(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the runs, of whatever settings and budget, in environments that no table has, pruned and polished."""
    return runs[(runs["env"] != runs["task"]) & runs["form"].isin(["pruned_tree", "polished"])]


def changes_but_oracle(runs: pd.DataFrame) -> "pd.Series[str]":
    """Return what settings each run changes, its oracle apart."""
    changes = runs["changes"].fillna("")
    return changes.str.replace(r"(^|, )oracle=\[[\d,]*\]", "", regex=True).str.removeprefix(", ")


def oracle_runs(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the oracles of the runs in `table_runs`, in the same form: one a task, budget, trainer and seed.

    Those of shrunk policies are a fleet's. Of those of one budget that were trained for fewer steps than others, none.
    """
    own = reported(runs)
    own = own[(own["env"] == own["task"]) & (own["form"] == ORACLE)].assign(method=ORACLE, depth="")
    own = own.assign(
        budget=own["budget"].str.replace("-shrink", "-fleet"), trainer=own["trainer"].replace(SHRINK, "fleet")
    )
    most = own.groupby([*KEY, *SOURCE])["steps"].transform("max")
    return own[own["steps"] == most].drop_duplicates([*KEY, *SOURCE, "seed"])


def with_pruned_trees(runs: pd.DataFrame, every: pd.DataFrame) -> pd.DataFrame:
    """Return rows of `table_runs` with the return and the leaves of their pruned trees.

    `every` are all rows of `load_runs`. A polished policy has been pruned again, or was polished as a pruned tree,
    which it then is.
    """
    is_polished = runs["form"] == "polished"
    pruned = every[every["form"] == "pruned_tree"].set_index("run")["return_mean"]
    polished = runs.reindex(columns=["polish.return_mean_pruned", "polish.n_leaves"]).astype(float)
    returns = runs["run"].map(pruned).where(~is_polished, polished["polish.return_mean_pruned"])
    leaves = runs["pruned_leaves"].astype(float).where(~is_polished, polished["polish.n_leaves"])
    return runs.assign(return_pruned=returns.fillna(runs["return_mean"]), leaves_pruned=leaves)


def _in_tables(own: pd.DataFrame, further_keys: list[str], forms: Mapping[str, str] = FORMS) -> pd.DataFrame:
    own = own[(own["env"] == own["task"]) & own["form"].isin(forms)]
    linear = (own["method"] == "otr") & (own["depth"] == "0")
    names = method_name(own["method"].mask(linear, "linear")) + own["form"].map(forms)
    is_shrunk = own["trainer"] == SHRINK
    if "polish.by" in own:
        by_critics = (own["form"] == "polished") & own["polish.by"].eq("critic").fillna(False) & ~is_shrunk
        names = names.mask(by_critics, names.str.replace("-polished", f"{BY_CRITICS}-polished"))
    by_recipe = [
        f"trainer={SHRINK}" in recipe({"env": env, "depth": depth}, "default")
        for env, depth in zip(own["env"], own["depth"], strict=True)
    ]
    is_recipe = is_shrunk & (names == SHRUNK) & pd.Series(by_recipe, own.index, dtype=bool)
    own = own[~is_shrunk | (own["form"] == "polished")].assign(
        method=names.mask(is_recipe, "otr"),
        pruned_depth=own["pruned_depth"].where(own["form"] == "tree"),
    )
    return own.drop_duplicates([*KEY, *SOURCE, *further_keys, "seed"])


def summarise(frame: pd.DataFrame, by: Sequence[str], value: str, **further: tuple[str, Any]) -> pd.DataFrame:
    """Return a row a group: mean, sample standard deviation (n - 1), interval and number; NaN where there is none.

    Groups of a frame's rows (runs) stay in the order in which they first come. `further` has more columns, each with
    the column that it is made of and how, as pandas' `agg` takes them.
    """
    return (
        frame.groupby(list(by), sort=False)
        .agg(
            mean=(value, "mean"),
            std=(value, "std"),
            ci_low=(value, lambda values: mean_interval(values)[0]),
            ci_high=(value, lambda values: mean_interval(values)[1]),
            n_runs=(value, "size"),
            **further,
        )
        .reset_index()
    )


def in_order(frame: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """Return rows sorted by columns: tasks, budgets and trainers by ORDER, what that has not by name, depths by number.

    The thesis's own budget comes first, and sb3 before other trainers.
    """
    return frame.sort_values(list(by), key=_sort_key, kind="stable")


def _sort_key(column: pd.Series) -> pd.Series:
    if column.name == "depth":
        return column.map(lambda depth: re.sub(r"\d+", lambda width: f"{int(width[0]):06}", depth))
    return column.map(lambda name: f"{ORDER.index(name) if name in ORDER else len(ORDER):02} {name}")


def beside_the_thesis(cells: pd.DataFrame, keys: Iterable[tuple[str, str, str, str]]) -> pd.DataFrame:
    """Return cells with what `published` has under their keys, and with 0 runs where there are none."""
    found = [published().get(key, Published()) for key in keys]
    columns = {
        f"published_{name}": values for name, values in zip(Published._fields, zip(*found, strict=True), strict=True)
    }
    return cells.assign(n_runs=cells["n_runs"].fillna(0).astype(int), **columns, thesis=[str(each) for each in found])


def normalised(tasks: pd.Series, returns: pd.Series) -> pd.Series:
    """Return scores: 0 for the return of random actions, 1 for the best that the thesis gives for the task.

    Linear between and beyond: a ratio of returns would be turned around where they are negative. NaN where the thesis
    has none.
    """
    worst, best = (tasks.map(known).astype(float) for known in (random_returns(), best_published))
    return (returns.astype(float) - worst) / (best - worst)


def runs_text(cell: Any) -> str:
    """Return `3 runs, quick`, with the trainer where it is not the usual one and the budget does not name it."""
    if not cell.n_runs:
        return ""
    named = cell.trainer == "sb3" or cell.budget.endswith(f"-{cell.trainer}")
    return f"{cell.n_runs} run{'s' if cell.n_runs > 1 else ''}, {cell.budget}" + ("" if named else f", {cell.trainer}")
