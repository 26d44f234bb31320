"""The thesis's published numbers (Orfanos 2023, Tables 4.1 and 4.2, text of chapter 4), as `published.csv` has them.

Where the thesis counts a tree's depth or names its method differently from a run's folder, the columns
`run_method` and `run_depths` say which runs the number belongs to. On discrete actions its trees go on, below the
hidden neurons' tests, with one test less than there are actions: its "depth-five" lander policy has 2 hidden neurons.
"""

import csv
import functools
import math
from importlib import resources
from typing import NamedTuple

TASKS_OF_3M = ("reacher", "swimmer", "bipedalwalker", "pendulum")
TASKS_OF_4M = ("walker2d", "hopper", "halfcheetah", "ant")


class Published(NamedTuple):
    """One published result; numbers keep the digits they were printed with, and "" stands for what was not given."""

    mean: str = ""
    std: str = ""
    n_runs: str = ""
    pruned_depth: str = ""
    note: str = ""

    def __str__(self) -> str:
        spread = f" ± {self.std}" if self.std else ""
        pruned = f" [{self.pruned_depth}]" if self.pruned_depth else ""
        return f"{self.mean}{spread}{pruned}" or "-"


def best_published(task: str) -> float:
    """Return the highest return that the thesis gives for a control task, by whatever method; NaN where it has none."""
    returns = [float(found.mean) for (table, of, _, _), found in published().items() if of == task and table != "4.2"]
    return max(returns, default=math.nan)


def published_steps(task: str, method: str) -> float:
    """Return the environment steps of OTR's trainings in Table 4.1 (section 4.1 there); it gives no others'."""
    if method != "otr" or task not in TASKS_OF_3M + TASKS_OF_4M:
        return math.nan
    return 4e6 if task in TASKS_OF_4M else 3e6


def published_elsewhere() -> list[dict[str, str]]:
    """Return what others than the thesis have published of its tasks, a row a policy, as text."""
    text = (resources.files("pipelines") / "published_elsewhere.csv").read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))


@functools.cache
def published() -> dict[tuple[str, str, str, str], Published]:
    """Return every published result under (table, task, method, depth) of our runs; table is 4.1, 4.2 or text."""
    text = (resources.files("pipelines") / "published.csv").read_text(encoding="utf-8")
    return {
        (row["table"], row["task"], row["run_method"] or row["method"], depth): Published(
            row["mean"], row["std"], row["runs"], row["pruned_depth"], row["note"]
        )
        for row in csv.DictReader(text.splitlines())
        for depth in (row["run_depths"] or row["tree_depth"]).split(" ")
    }
