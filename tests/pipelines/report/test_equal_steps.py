"""The table of equal steps: what is counted, and what a longer training had returned on its way."""

import numpy as np
import pandas as pd
import pytest

from pipelines.engine.store import read_csv
from pipelines.report.equal_steps import _lines, equal_cells
from tests.committed import RESULTS


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return cells of runs that differ in what they have spent, and in how it is known."""
    folder = tmp_path_factory.mktemp("results")
    common = {"env": "hopper", "task": "hopper", "method": "otr", "budget": "standard-ars", "trainer": "ars", "seed": 0,
              "form": "tree", "settings": "", "changes": "", "return_mean": 9.0, "steps": 2e6, "pruned_depth": 3,
              "oracle.hidden_widths": ""}  # fmt: skip
    own = [
        {"depth": "1", "steps": 1e6},
        {"depth": "2", "run": "curve"},
        {"depth": "3", "run": "short curve", "steps": 1.2e6},
        {"depth": "4", "form": "polished", "polish.by": "search", "steps": 8e5, "polish.n_steps": 3e5},
        {"depth": "5", "form": "polished", "polish.by": "search", "steps": 8e5, "polish.n_steps": 5e5},
        {"depth": "6", "steps": 1e5, "budget": "quick-ars"},
        {"depth": "1", "steps": 3e6, "seed": 1},
    ]
    for run, steps in (("curve", (7e5, 8.5e5, 9.5e5, 1.1e6)), ("short curve", (8.5e5, 1e6))):
        (folder / "runs" / run / "train").mkdir(parents=True)
        lines = [f"{at:.0f},{i}" for i, at in enumerate(steps)]
        (folder / "runs" / run / "train" / "evaluations.csv").write_text("\n".join(["steps,return_mean", *lines]))
        (folder / "runs" / run / "train" / "manifest.json").write_text("{}")
    runs = pd.DataFrame([common | {"run": "none"} | each for each in own])
    return equal_cells(runs, folder).set_index(["method", "depth"])


@pytest.mark.parametrize(
    ("cell", "mean", "how", "steps"),
    [
        (("otr", "1"), 9.0, "final", 1e6),
        (("otr", "2"), 1.5, "on the way", 9.5e5),
        (("otr", "3"), 9.0, "over", 1.2e6),  # its training ended at a million: another policy than that one
        (("otr-polished", "4"), 9.0, "over", 1.1e6),
    ],
)
def test_a_cell_counts_all_steps(made, cell, mean, how, steps):
    assert tuple(made.loc[cell, ["mean", "how", "steps"]]) == (mean, how, steps)


def test_runs_that_took_more_are_counted(made):
    assert made.loc[("otr", "1"), ["n_runs", "n_known_of"]].tolist() == [1, 2]
    assert "| 9.0 (1 of 2) |" in " ".join("| " + " | ".join(line) + " |" for line in _lines(made.reset_index()))


def test_what_took_more_or_a_quick_budget_has_no_cell(made):
    assert made.index.tolist() == [("otr", "1"), ("otr", "2"), ("otr", "3"), ("otr-polished", "4")]


def test_the_committed_searches_are_read_on_their_way():
    cells = pd.read_csv(RESULTS / "tables/equal_steps.csv", dtype={"depth": str}).set_index(
        ["task", "method", "depth", "trainer"]
    )
    found = []
    for seed in (6, 7, 8):
        rows = read_csv(RESULTS / f"runs/hopper/otr/depth-6/standard-ars/seed-{seed}/train/evaluations.csv")
        found.append(np.mean([float(row["return_mean"]) for row in rows if 8e5 < float(row["steps"]) <= 1e6]))
    assert cells.loc[("hopper", "otr", "6", "ars"), "mean"] == pytest.approx(np.mean(found), abs=1e-6)
