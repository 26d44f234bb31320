"""What is committed under results: the table is that of the runs, and the runs reach what the README says."""

import json
from pathlib import Path

import pytest

from pipelines.stage import verified_manifest
from pipelines.tabulate import write_table

RESULTS = Path(__file__).parent.parent / "results"
SUMMARIES = sorted((RESULTS / "runs").glob("**/summary.json"))


def test_committed_table_is_that_of_the_committed_runs(tmp_path):
    (tmp_path / "runs").symlink_to(RESULTS / "runs")
    for path in write_table("4.1", tmp_path):
        assert path.read_bytes() == (RESULTS / "tables" / path.name).read_bytes(), f"run otr-tabulate: {path.name}"


@pytest.mark.parametrize("summary", SUMMARIES, ids=lambda path: "-".join(path.parts[-6:-1]))
def test_committed_artefacts_are_whole(summary):
    for stage in ("train", "map", "prune", "evaluate"):
        verified_manifest(summary.parent / stage)
    assert json.loads(summary.read_text())["n_episodes"] == 100


@pytest.mark.parametrize(
    ("run", "least"),
    [
        *((f"pendulum/otr/depth-6/quick/seed-{seed}", -165.0) for seed in range(3)),
        *((f"pendulum/otr/depth-32/quick/seed-{seed}", -165.0) for seed in range(3)),
        *((f"mountaincar/otr/depth-1/quick/seed-{seed}", 90.0) for seed in range(3)),
        ("lunarlander/otr/depth-2/thesis/seed-0", 200.0),
        ("swimmer/otr/depth-6/thesis/seed-0", 350.0),
    ],
)
def test_committed_runs_have_learnt(run, least):
    assert json.loads((RESULTS / "runs" / run / "summary.json").read_text())["return_mean"] >= least
