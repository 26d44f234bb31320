"""The numbers in prose are those of the committed runs and fits: a page that has fallen behind them fails here."""

import re

import numpy as np
import pandas as pd
import pytest

from pipelines.engine.store import read_bytes
from pipelines.report import load_fits, load_runs
from tests.committed import RESULTS

ROOT = RESULTS.parent
NUMBER = r"-?(?:\d{1,3}(?:,\d{3})+(?:\.\d+)?|\d*\.?\d+)"
SPREAD = re.compile(rf"({NUMBER}) ± ({NUMBER})")
TASKS = ("reacher", "walker2d", "hopper", "halfcheetah", "ant", "swimmer", "bipedalwalker", "pendulum")


@pytest.fixture(scope="module")
def runs():
    """Return the runs of one setting, a row each: mean, std (n - 1), min and max over runs of the mean return."""
    keys = ["env", "method", "depth", "budget", "trainer", "settings", "oracle.hidden_widths", "form", "polished by"]
    every = load_runs(RESULTS)
    own = every.assign(**{"polished by": every["polish.by"].where(every["form"] == "polished")})
    alike = (keys, [*keys, "polish.by"])  # the second: before the polish, those alone that then were polished
    returns = [own.groupby(each, dropna=False)["return_mean"].agg(["mean", "std", "min", "max"]) for each in alike]
    return pd.concat([each.reset_index()[[*keys, *each]] for each in returns])


@pytest.fixture(scope="module")
def spreads(runs):
    """Return the pairs of a mean and a standard deviation in the results, over runs or seeds, of trees and of networks.

    The published ones count among the trees'; those of one run, over its episodes, do not.
    """
    fits = load_fits(RESULTS).groupby(["data", "split", "method", "settings"], dropna=False)
    published = pd.read_csv(RESULTS / "tables/table_4_1.csv")[["published_mean", "published_std"]]
    tables = {
        "tree": [runs[["mean", "std"]], published, fits["test"].agg(["mean", "std"])],
        "network": [fits["whole_test"].agg(["mean", "std"])],
    }
    return {form: np.concatenate([each.dropna().to_numpy(float) for each in tables[form]]) for form in tables}


def is_rounded(told: str, number: float) -> bool:
    """Return whether what is told, such as 1,234.5, is the number, rounded to as many digits; a tie goes both ways."""
    decimals = len(told.partition(".")[2])
    return abs(float(told.replace(",", "")) - number) <= 0.5 * 10**-decimals + 1e-9


@pytest.mark.parametrize(
    "page",
    [
        page.relative_to(ROOT).as_posix()
        for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
        if SPREAD.search(page.read_text()) and page.stem not in ("benchmarks", "tutorial")  # their own measurements
    ],
)
def test_means_and_spreads_on_a_page_are_of_committed_results(page, spreads):
    """A line that gives the score of a fit's network, not of the tree that is counted, says `network`."""
    text = re.sub(r"```.*?```", "", (ROOT / page).read_text(), flags=re.DOTALL)
    told = [(match, line) for line in text.splitlines() for match in SPREAD.findall(line)]
    assert told

    def is_known(mean, std, forms):
        return any(is_rounded(mean, m) and is_rounded(std, s) for form in forms for m, s in spreads[form])

    forms = {True: list(spreads), False: ["tree"]}
    assert [(pair, line) for pair, line in told if not is_known(*pair, forms["network" in line])] == []


def test_the_note_under_table_4_1_names_the_tasks_whose_actors_are_dense():
    cells = pd.read_csv(RESULTS / "tables/table_4_1.csv").query("table == '4.1' and method == 'otr'")
    dense, layered, shrunk_tasks = set(), set(), set()
    shrunk = cells["trainer"] == "shrink"
    for cell in cells.assign(folder=np.where(shrunk, "distilled_otr", "otr")).itertuples():
        for run in (RESULTS / f"runs/{cell.task}/{cell.folder}/depth-{cell.depth}/{cell.budget}").glob("seed-?"):
            is_dense = "dense: input" in read_bytes(run / "config.yaml").decode()
            assert is_dense or cell.trainer != "shrink"
            (shrunk_tasks if cell.trainer == "shrink" else dense if is_dense else layered).add(cell.task)
    assert not dense & layered
    named = re.search(r"OTR: on (.*) a linear map", (RESULTS / "tables/table_4_1.md").read_text())[1]
    assert re.split(", | and ", named.lower()) == [task for task in TASKS if task in (dense | shrunk_tasks) - layered]
