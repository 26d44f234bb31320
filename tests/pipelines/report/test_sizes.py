"""How large policies are and what they cost, of committed runs whose networks, trees and summaries are at hand."""

import numpy as np
import pytest

import otr
from pipelines.engine.archive import opened
from pipelines.report.cells import table_runs
from pipelines.report.frames import load_runs
from pipelines.report.sizes import with_sizes
from tests.committed import RESULTS


@pytest.fixture(scope="module")
def runs():
    return with_sizes(table_runs(load_runs(RESULTS)), RESULTS).set_index(["run", "form"])


@pytest.mark.parametrize(
    ("run", "form", "free", "steps"),
    [
        ("halfcheetah/otr/depth-6/standard-fleet/seed-0", "tree", 6 * 18 + 6 * (17 + 6 + 1), 1_000_000),
        ("hopper/otr/depth-32/standard-ars/seed-0", "tree", 32 * 12 + 3 * (11 + 32 + 1), 4_000_000),  # of its paths
        ("pendulum/otr/depth-6/standard-fleet/seed-0", "polished", 6 * 4 + 7, 30_000 + 104_542_400),
        ("pendulum/distilled_otr/depth-6/standard-shrink/seed-3", "polished", 6 * 4 + 7 + 3, 188_200),
        ("halfcheetah/ndps/depth-6/standard-fleet/seed-0", "tree", None, 1_000_000 + 1_638_000),
        ("lunarlander/augtree/depth-3/quick/seed-0", "tree", None, None),  # of labels
        ("halfcheetah/distilled_experts/depth-8/standard-shrink/seed-3", "polished", 8 * 18 * (6 + 1), 1_191_000),
    ],
)
def test_numbers_are_those_of_network_and_tree(run, form, free, steps, runs):
    row, stage = runs.loc[(run, form)], "polish" if form == "polished" else "prune"
    with opened(RESULTS / "runs" / run, [stage]) as whole:
        is_paths = (whole / stage / "paths.json").exists()
        tree = otr.load(whole / stage / "paths").to_tree() if is_paths else otr.load(whole / stage / "tree")
    leaves = [tree.labels] if tree.labels is not None else [tree.M, tree.c]
    counts = [len(each) if each.dtype.kind == "i" else np.count_nonzero(each) for each in (tree.P, tree.v, *leaves)]
    assert (row["leaves"], row["written_numbers"]) == (tree.n_leaves, sum(counts))
    assert row["free_numbers"] == (sum(counts) if free is None else free)
    assert steps in (None, row["total_steps"])


def test_a_summarys_steps_in_all_are_the_tables(runs):
    every = load_runs(RESULTS).set_index(["run", "form"])["total_steps"].dropna()
    polished = every[every.index.get_level_values("form") == "polished"].astype(float)
    own = runs["total_steps"].reindex(polished.index).dropna()
    assert len(own) > 3 and (own == polished[own.index]).all()
