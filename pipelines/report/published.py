"""The thesis's published numbers (Orfanos 2023, Tables 4.1 and 4.2, text of chapter 4), as `published.csv` has them."""

import csv
import functools
from dataclasses import dataclass
from importlib import resources

# On discrete actions the tree goes on, below the hidden neurons' tests, with one test less than there are leaf actions
# to compare: the thesis's "depth-five" lander policy has 2 hidden neurons and 4 - 1 = 3 of these.
N_OUTPUT_TESTS = {"lunarlander": 3}
FOR_MANY_DEPTHS = {("lunarlander", "cdt"): ("4", "5", "6")}  # one number for several depths, in a row without a depth
FROM_NETWORKS = ("otr", "linear", "pid")  # their depth counts hidden neurons; other methods' depth is the tree's own


@dataclass(frozen=True)
class OnePolicy:
    """A result of one policy, not of several runs: its row's method in published.csv, and the figure that shows it."""

    method: str
    figure: str


OF_ONE_POLICY = {
    ("lunarlander", "augtree"): OnePolicy("augtree-fig4.7-original", "4.7"),
    ("pendulum", "pid"): OnePolicy("otr-pid", "4.4"),
}


@dataclass(frozen=True)
class Published:
    """One published result; numbers keep the digits they were printed with, and "" stands for what was not given."""

    mean: str
    std: str
    n_runs: str
    pruned_depth: str


@functools.cache
def published() -> dict[tuple[str, str, str, str], Published]:
    """Return every published result under (table, task, method, tree depth); table is 4.1, 4.2 or text."""
    text = (resources.files("pipelines") / "published.csv").read_text(encoding="utf-8")
    return {
        (row["table"], row["task"], row["method"], row["tree_depth"]): Published(
            row["mean"], row["std"], row["runs"], row["pruned_depth"]
        )
        for row in csv.DictReader(text.splitlines())
    }


def published_cell(table: str, task: str, method: str, depth: str) -> Published | None:
    """Return what the thesis has for a cell, `depth` being its tree's; None where it has nothing."""
    one = OF_ONE_POLICY.get((task, method))
    name = one.method if one else method
    if depth in FOR_MANY_DEPTHS.get((task, method), ()):
        depth = ""
    return published().get((table, task, name, depth))


def tree_depth(task: str, method: str, depth: str) -> str:
    """Return the depth under which the thesis counts a run's tree; `depth` is the run's, as its folder has it (8-8)."""
    tests = sum(int(width) for width in depth.split("-"))  # hidden neurons, or CDT's two trees, one below the other
    return str(tests + N_OUTPUT_TESTS.get(task, 0) if method in FROM_NETWORKS else tests)
